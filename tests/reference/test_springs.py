"""Supports that give way: closed form of a bar, limits, derivatives, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import LinearElastic, Material, NeoHookean
from softtwin.reference.derivatives.linearisation import Linearisation
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.solve.problem import NewtonOptions, Problem, Springs

MODULUS, SIZE = 3000.0, (0.3, 0.1, 0.1)
TIGHT = NewtonOptions(tolerance=1e-12)


def bar(cell: str = "tetrahedron", quadratic: bool = False) -> Body:
    """A bar along x with the surfaces and the nodes of its ends, and the nodes of two sides."""
    made = beam((5, 2, 2), SIZE, cell)
    made = made.quadratic() if quadratic else made
    x = made.points
    flat = {
        name: np.flatnonzero(np.isclose(x[:, axis], x[:, axis].min())) for axis, name in enumerate(("x0", "y0", "z0"))
    }
    ends = {"start": 0.0, "end": SIZE[0]}
    surfaces = {
        name: made.boundary[np.isclose(x[made.boundary][..., 0], where).all(axis=1)] for name, where in ends.items()
    }
    return Body(x, made.cells, {**flat, "fixed": flat["x0"]}, surfaces)


@pytest.mark.parametrize("material", [LinearElastic(MODULUS, 0.3), NeoHookean(MODULUS, 0.3)], ids=["linear", "neo"])
@pytest.mark.parametrize(("cell", "quadratic"), [("tetrahedron", False), ("hexahedron", False), ("tetrahedron", True)])
def test_a_bar_on_springs_moves_by_its_own_and_by_theirs(material: Material, cell: str, quadratic: bool) -> None:
    """Pulled by a traction t, the end on springs of k_n moves by t / k_n, and the bar is as long as on a track."""
    body, traction, stiffness = bar(cell, quadratic), 400.0, 2.0e4
    load = Loading(traction={"end": np.array([traction, 0.0, 0.0])})
    sides = {"y0": "y", "z0": "z"}
    with Problem(body, material, TIGHT, held={**sides, "x0": "x"}) as problem:
        on_a_track = problem.solve(load).displacement
    with Problem(body, material, TIGHT, held=sides, springs={"start": Springs(normal=stiffness)}) as problem:
        found = problem.solve(load)
    np.testing.assert_allclose(found.displacement[body.node_sets["x0"], 0], traction / stiffness, rtol=1e-8)
    np.testing.assert_allclose(
        found.displacement - on_a_track, [[traction / stiffness, 0.0, 0.0]] * len(body.points), atol=1e-9
    )
    assert found.negative_pivots == 0


def test_very_stiff_springs_hold_and_very_soft_ones_do_not() -> None:
    body, material = bar(), NeoHookean(MODULUS, 0.4)
    load = Loading(traction={"end": np.array([0.0, 0.0, -60.0])})
    with Problem(body, material, TIGHT) as problem:
        fixed = problem.solve(load).displacement
    scale = np.abs(fixed).max()
    assert scale > 0.01
    stiff = MODULUS / SIZE[0] * 1e8
    with Problem(body, material, TIGHT, held={}, springs={"start": Springs(stiff, stiff)}) as problem:
        np.testing.assert_allclose(problem.solve(load).displacement, fixed, atol=1e-6 * scale)
    soft = MODULUS / SIZE[0] * 1e-8
    with Problem(body, material, TIGHT, springs={"boundary": Springs(soft, soft)}) as problem:
        np.testing.assert_allclose(problem.solve(load).displacement, fixed, atol=1e-6 * scale)


def test_derivatives_are_those_of_the_states(rng: np.random.Generator) -> None:
    """A Taylor test: what is left falls with the square of the step; the transpose is the transpose."""
    body = bar()
    springs = {"start": Springs(3.0e4, 5.0e3), "end": Springs(normal=2.0e3)}
    forces, change = 0.01 * rng.standard_normal((2, *body.points.shape))
    with Problem(body, NeoHookean(MODULUS, 0.4), TIGHT, held={}, springs=springs) as problem:
        model = ReferenceModel(problem)
        state = model.solve(forces)
        pushed = state.jvp(change.reshape(-1, 1)).reshape(-1, 3)
        left = [
            np.abs(model.solve(forces + step * change, state).displacement - state.displacement - step * pushed).max()
            for step in (0.2, 0.1, 0.05)
        ]
        assert np.log2(left[0] / left[1]) > 1.8 and np.log2(left[1] / left[2]) > 1.8
        cotangent = rng.standard_normal(body.points.shape)
        assert np.sum(state.vjp(cotangent) * change) == pytest.approx(np.sum(cotangent * pushed), rel=1e-8)
        at = Linearisation(problem, Loading(forces), problem.solve(forces))
        with pytest.raises(ValueError, match="expected a body without springs"):
            at.gradient(cotangent, points=True)


def test_springs_all_over_let_a_body_slide(rng: np.random.Generator) -> None:
    """Normal springs alone hold a box, which a ball would turn in, and cost nothing along its faces."""
    body = bar()
    with Problem(body, LinearElastic(MODULUS, 0.3), TIGHT, held={}, springs={"boundary": Springs(1e4)}) as problem:
        moved = problem.solve(Loading(body_force=np.array([0.0, 0.0, -500.0])))
    weight = 500.0 * np.prod(SIZE)
    held = 1e4 * 2 * SIZE[0] * SIZE[1]  # by the top and the bottom
    assert -moved.displacement[:, 2].mean() == pytest.approx(weight / held, rel=0.02)


def test_what_holds_nothing_or_is_not_there_is_refused() -> None:
    body = bar()
    with pytest.raises(ValueError, match=r"no rigid motion to be left, got 3 of 6 .* springs on \['start'\]"):
        Problem(body, NeoHookean(MODULUS, 0.4), held={}, springs={"start": Springs(normal=1e4)})
    with pytest.raises(ValueError, match=r"Problem.springs: expected a surface among .*, got 'top'"):
        Problem(body, NeoHookean(MODULUS, 0.4), springs={"top": Springs(1.0)})
    for wrong in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"Springs.tangential: expected a stiffness of 0 N/m\^3 or more"):
            Springs(1.0, wrong)
    with pytest.raises(ValueError, match="expected a stiffness above 0"):
        Springs()
