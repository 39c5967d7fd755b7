"""Nonlinear elimination: a few cells have the tangent of the whole, and a tool's load needs fewer of the whole."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from scipy.sparse import csr_matrix
from verification_cases import PLANE, SPACE, box

from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.fem.discretisation import Discretisation
from softtwin.reference.fem.forms import DiscreteLoad, Forms
from softtwin.reference.solve.elimination import CellElimination
from softtwin.reference.solve.problem import NewtonOptions, Problem

MATERIAL = NeoHookean(4500.0, 0.45)


@pytest.mark.parametrize("kind", [*PLANE, *SPACE])
def test_the_step_of_a_patch_solves_the_rows_of_the_whole_tangent(kind: str, rng: np.random.Generator) -> None:
    body = box(kind, 4)
    cells = len(body.cells)
    space = Discretisation(body, False, {"x0": "xyz"[: body.dimension]})
    forms = Forms(space, NeoHookean(rng.uniform(1e3, 5e3, cells), 0.45), rng.uniform(0.5, 1.0, cells))
    unknowns = 0.01 * rng.standard_normal(space.owned)
    unknowns[space.fixed] = 0.0
    residual = rng.standard_normal(space.owned)
    residual[space.fixed] = 0.0

    elimination = CellElimination(space, forms.cells)
    patch = elimination.around(residual)
    step = patch.step(unknowns, residual)

    matrix = forms.create_matrix()
    forms.tangent(unknowns, DiscreteLoad(residual, np.zeros_like(residual), {}), matrix)
    indptr, columns, values = matrix.getValuesCSR()
    rows = csr_matrix((values, columns, indptr))[patch.unknowns]
    assert 0 < len(patch.unknowns) < space.owned - len(space.fixed)
    assert not np.isin(space.fixed, patch.unknowns).any()
    np.testing.assert_allclose(rows @ step, residual[patch.unknowns], rtol=0, atol=1e-9 * np.abs(residual).max())
    assert not np.delete(step, patch.unknowns).any()


def test_a_pull_at_one_node_takes_fewer_tangents_to_the_same_state() -> None:
    body = box("tetra", 8)
    forces = np.zeros_like(body.points)
    pulled = np.argmin(np.linalg.norm(body.points - [1.0, 0.5, 1.0], axis=1))
    forces[pulled] = [100.0, 0.0, 300.0]
    found = {}
    for elimination in (False, True):
        with Problem(body, MATERIAL, NewtonOptions(elimination=elimination), held={"x0": "xyz"}) as problem:
            found[elimination] = problem.solve(forces)
    plain, helped = found[False], found[True]
    assert plain.local_iterations == 0
    assert helped.local_iterations > 0
    assert helped.factorisations < plain.factorisations / 2
    assert helped.is_stable and plain.is_stable
    np.testing.assert_allclose(helped.displacement, plain.displacement, rtol=0, atol=1e-8)


def test_a_guess_is_followed_to_its_neighbour_without_elimination() -> None:
    body = box("tetra", 8)
    forces = np.zeros_like(body.points)
    forces[np.argmin(np.linalg.norm(body.points - [1.0, 0.5, 1.0], axis=1))] = [100.0, 0.0, 300.0]
    with Problem(body, MATERIAL, held={"x0": "xyz"}) as problem:
        state = problem.solve(forces, np.zeros_like(body.points), fallback=False)
    assert state.local_iterations == 0


@pytest.mark.liver
@pytest.mark.slow
def test_where_a_rough_load_has_several_states_careful_steps_find_the_same(liver_folder) -> None:
    """Without a limit on eliminations the whole load ends on another stable branch."""
    from liver import POISSON_RATIO, YOUNG_MODULUS, liver, sequence

    data, body = sequence("s3"), liver()
    mean = data.net_forces[15]
    noise = np.random.default_rng(4).standard_normal((len(data.tool), 3))
    forces = np.zeros_like(body.points)
    forces[data.tool] = (mean + 2.5 * np.linalg.norm(mean) * noise) / len(data.tool)
    careful = NewtonOptions(elimination=False, first_step=0.05)
    material = NeoHookean(YOUNG_MODULUS, POISSON_RATIO)
    with Problem(body, material) as problem, Problem(body, material, careful) as slow:
        found, followed = problem.solve(forces), slow.solve(forces)
    assert found.is_stable and followed.is_stable
    np.testing.assert_allclose(found.displacement, followed.displacement, rtol=0, atol=1e-8)
