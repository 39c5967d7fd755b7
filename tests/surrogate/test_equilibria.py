"""Equilibria in torch: the reference's states, whoever is solved beside them, and what is refused or not found."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import IncompressibleNeoHookean, Material, NeoHookean
from softtwin.surrogate.equilibria import Equilibria, NewtonSettings
from softtwin.surrogate.tangents import LayeredMatrices, layers_of

from .conftest import DEVICES
from .test_residual import LAWS, body_of

CELLS = {"tetrahedra": ("tetrahedron", 1), "hexahedra": ("hexahedron", 1), "quadratic": ("tetrahedron", 2)}
CELLS["gridded"] = ("gridded", 1)
PAIRS = [pytest.param(law, "hexahedra", id=f"{law}-hexahedra") for law in LAWS]
PAIRS += [pytest.param("Neo-Hookean", cells, id=f"Neo-Hookean-{cells}") for cells in CELLS if cells != "hexahedra"]


def some_loads(body: Body, count: int, size: float, rng: np.random.Generator) -> torch.Tensor:
    """Smooth loads on all free nodes, (count, n, 3), newtons."""
    free = ~np.isin(np.arange(len(body.points)), body.fixed)[:, None]
    fields = [free * np.sin(4.0 * body.points @ rng.standard_normal((3, 3))) for _ in range(count)]
    return torch.from_numpy(size * np.stack(fields) / len(body.points))


@pytest.mark.fenicsx
@pytest.mark.parametrize(("law", "cells"), PAIRS)
def test_states_are_the_references(law: str, cells: str, rng: np.random.Generator) -> None:
    """Bent by more than the beam is thick: 1e-8 of the largest displacement, what the reference's 1e-12 leaves less."""
    from softtwin.reference.solve.problem import NewtonOptions, Problem

    body = body_of(*CELLS[cells])
    loads = some_loads(body, 3, 15.0, rng)
    found = Equilibria(body, LAWS[law]).solve(loads)
    assert found.is_converged.all() and found.is_stable.all()
    with Problem(body, LAWS[law], NewtonOptions(tolerance=1e-12)) as problem:
        truth = np.stack([problem.solve(load.numpy()).displacement for load in loads])
    peak = np.abs(truth).max(axis=(1, 2))
    assert peak.max() > 0.1
    assert (np.abs(found.displacement.numpy() - truth).max(axis=(1, 2)) <= 1e-8 * peak).all()


@pytest.fixture(scope="module")
def bar() -> Body:
    return beam((6, 2, 2), (1.0, 0.25, 0.25))


@pytest.fixture(scope="module")
def solver(bar: Body) -> Equilibria:
    return Equilibria(bar, NeoHookean(4500.0, 0.45))


def test_a_state_does_not_depend_on_those_beside_it(bar: Body, solver: Equilibria, rng: np.random.Generator) -> None:
    loads = torch.cat([some_loads(bar, 3, 12.0, rng), torch.zeros(1, len(bar.points), 3)])
    together = solver.solve(loads)
    assert together.is_converged.all() and together.displacement[3].abs().max() == 0.0
    few = Equilibria(bar, solver.material, settings=NewtonSettings(chunk=2)).solve(loads)
    alone = torch.cat([solver.solve(load[None]).displacement for load in loads])
    for other in (few.displacement, alone):
        assert (other - together.displacement).abs().max() <= 1e-9 * together.displacement.abs().max()


def test_it_goes_on_from_a_state_nearby(bar: Body, solver: Equilibria, rng: np.random.Generator) -> None:
    loads = some_loads(bar, 2, 12.0, rng)
    cold = solver.solve(loads)
    warm = solver.solve(loads, cold.displacement + 1e-6 * torch.rand(cold.displacement.shape))
    assert (warm.iterations < cold.iterations).all()
    assert (warm.displacement - cold.displacement).abs().max() <= 1e-9 * cold.displacement.abs().max()


def test_what_is_not_found_is_said(bar: Body, rng: np.random.Generator) -> None:
    """One iteration is not enough for any of the loads, not even in load steps."""
    loads = some_loads(bar, 3, 20.0, rng)
    found = Equilibria(bar, NeoHookean(4500.0, 0.45), settings=NewtonSettings(iterations=1)).solve(loads)
    assert not found.is_converged.any() and (found.load_steps == 16).all()
    assert (found.residual > 1e-10).all() and torch.isfinite(found.displacement).all()


def test_load_steps_find_what_one_step_does_not(bar: Body, rng: np.random.Generator) -> None:
    loads = some_loads(bar, 3, 30.0, rng)
    whole = Equilibria(bar, NeoHookean(4500.0, 0.45)).solve(loads)
    settings = NewtonSettings(iterations=5)
    stepped = Equilibria(bar, NeoHookean(4500.0, 0.45), settings=settings).solve(loads)
    assert (whole.load_steps == 1).all() and (whole.iterations > 5).all()
    assert stepped.is_converged.all() and (stepped.load_steps > 1).all()
    off = (stepped.displacement - whole.displacement).abs().max()
    assert off <= 1e-8 * whole.displacement.abs().max()


@pytest.mark.parametrize("device", DEVICES)
def test_single_precision_is_near(device: str, bar: Body, solver: Equilibria, rng: np.random.Generator) -> None:
    loads = some_loads(bar, 3, 12.0, rng)
    exact = solver.solve(loads).displacement
    single = Equilibria(bar, solver.material, device, "single", NewtonSettings(1e-4)).solve(loads)
    assert single.is_converged.all() and single.displacement.dtype == torch.float32
    assert (single.displacement.cpu() - exact).abs().max() <= 1e-3 * exact.abs().max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"material": IncompressibleNeoHookean(1500.0)}, "compressible law"),
        ({"body": Body(beam((2, 1, 1)).points, beam((2, 1, 1)).cells, {})}, "something holds"),
        ({"precision": "half"}, "'double' or 'single', got 'half'"),
    ],
)
def test_what_it_cannot_solve_is_refused(change: dict[str, object], message: str, bar: Body) -> None:
    given: dict[str, object] = {"body": bar, "material": NeoHookean(4500.0, 0.45), **change}
    with pytest.raises(ValueError, match=message):
        Equilibria(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        (torch.zeros(2, 5, 3), r"forces: expected shape \(s, 63, 3\) with s >= 1, got \(2, 5, 3\)"),
        (torch.zeros(0, 63, 3), r"forces: expected shape \(s, 63, 3\) with s >= 1, got \(0, 63, 3\)"),
        (torch.full((1, 63, 3), torch.nan), "forces: expected finite numbers"),
        (torch.ones((1, 63, 3)), "forces: expected no force on held nodes"),
    ],
)
def test_loads_that_are_none_are_refused(loads: torch.Tensor, message: str, solver: Equilibria) -> None:
    with pytest.raises(ValueError, match=message):
        solver.solve(loads)


def test_a_gpu_that_is_not_there_is_said(bar: Body) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is one")
    with pytest.raises(ValueError, match="device: expected a GPU that torch can use, found none"):
        Equilibria(bar, NeoHookean(4500.0, 0.45), "cuda")


def test_arrays_are_taken(solver: Equilibria) -> None:
    assert solver.solve(np.zeros((2, 63, 3))).displacement.abs().max() == 0.0


@pytest.mark.parametrize("name", ["tolerance", "iterations", "load_steps", "chunk"])
def test_settings_out_of_range_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"NewtonSettings.{name}: expected .*, got 0"):
        NewtonSettings(**{name: 0})


# ---------------------------------------------------------------------- layers


@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron", "gridded"])
def test_cells_join_a_layer_to_its_neighbours_alone(kind: str) -> None:
    body = body_of(kind)
    is_free = ~np.isin(np.arange(len(body.points)), body.fixed)
    layers = layers_of(body.cells, is_free)
    assert ((layers >= 0) == is_free).all()
    inside = [cell[is_free[cell]] for cell in body.cells]
    assert max(np.ptp(layers[nodes]) for nodes in inside if len(nodes)) == 1
    assert (np.diff(np.unique(layers[is_free])) == 1).all()


def test_parts_that_no_free_node_joins_have_layers_of_their_own() -> None:
    """Held in the middle, a beam has two halves: one does not move under the other's load."""
    bar = beam((6, 1, 1))
    middle = np.flatnonzero(np.abs(bar.points[:, 0] - 0.5) < 1e-9)
    halves = Body(bar.points, bar.cells, {"fixed": middle})
    loads = torch.zeros(1, len(bar.points), 3, dtype=torch.float64)
    loads[0, -1, 2] = 0.5
    found = Equilibria(halves, NeoHookean(4500.0, 0.45)).solve(loads)
    assert found.is_converged.all() and found.displacement[0, -1, 2] > 0.01
    assert found.displacement[0, bar.points[:, 0] < 0.5].abs().max() == 0.0


def test_factors_solve_and_know_what_is_not_positive(bar: Body, rng: np.random.Generator) -> None:
    count = 4
    unknowns = torch.arange(6).reshape(3, 2)  # three cells on a line of four unknowns; the last two are held
    unknowns = torch.tensor([[0, 1], [1, 2], [2, 3], [3, count]])
    matrices = LayeredMatrices(unknowns, np.arange(count))
    squares = torch.from_numpy(rng.standard_normal((2, 4, 2, 2)))
    blocks = squares @ squares.mT
    blocks[1, 0] = -blocks[1, 0]
    dense = torch.zeros(2, count + 1, count + 1, dtype=torch.float64)
    for cell, numbers in enumerate(unknowns):
        dense[:, numbers[:, None], numbers] += blocks[:, cell]
    dense = dense[:, :count, :count]
    factors = matrices.factor(matrices.assembled(blocks))
    assert factors.is_positive.tolist() == [bool((torch.linalg.eigvalsh(each) > 0).all()) for each in dense]
    right = torch.from_numpy(rng.standard_normal((2, count, 3)))
    np.testing.assert_allclose(factors.solve(right)[0], torch.linalg.solve(dense[0], right[0]), rtol=1e-9)


@pytest.mark.parametrize("law", [LAWS["Neo-Hookean"]])
def test_an_indefinite_tangent_is_got_over(law: Material, bar: Body, solver: Equilibria) -> None:
    """Pushed together so far that it is no minimum, the beam finds the state of no load again."""
    squeezed = torch.zeros(1, len(bar.points), 3, dtype=torch.float64)
    squeezed[0, :, 0] = torch.from_numpy(-0.45 * bar.points[:, 0])
    _, is_stable, _ = solver._factored(squeezed, torch.zeros(len(squeezed), dtype=torch.int64))
    assert not is_stable.any()
    found = solver.solve(torch.zeros_like(squeezed), squeezed)
    assert found.is_converged.all() and found.displacement.abs().max() < 1e-6
