"""Ligaments: a closed form, slack ones, limits, derivatives, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.shapes import beam
from softtwin.reference.data.inputs import Change
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.springs import Springs, springs_of
from softtwin.reference.derivatives.linearisation import Linearisation
from softtwin.reference.solve.problem import Ligament, NewtonOptions, Problem
from softtwin.reference.unloaded import unloaded

MATERIAL, TIGHT = NeoHookean(3000.0, 0.4), NewtonOptions(tolerance=1e-12)
BAR = beam((5, 2, 2), (0.3, 0.1, 0.1), "tetrahedron")
TOP = (0.3, 0.0, 0.05)
ABOVE = (0.3, 0.0, 0.35)


def pulled(newtons: float) -> Loading:
    forces = np.zeros_like(BAR.points)
    tip = BAR.node_sets["tip"]
    forces[tip, 2] = newtons / len(tip)
    return Loading(forces)


def test_length_and_pull_are_hookes() -> None:
    cord = Ligament((0.0, 0.0, 0.0), (0.0, 0.0, 0.2), 50.0, slack=0.15)
    energy, force, stiffness = cord.response(np.array([0.0, 0.0, -0.1]))
    assert energy == pytest.approx(0.5 * 50.0 * 0.15**2)
    np.testing.assert_allclose(force, [0.0, 0.0, -50.0 * 0.15])
    np.testing.assert_allclose(stiffness, np.diag([25.0, 25.0, 50.0]))
    assert cord.response(np.array([0.0, 0.0, 0.06]))[0] == 0.0
    assert Ligament((0.0, 0.0, 0.0), (0.0, 3.0, 4.0), 1.0).length == 5.0


def test_what_pulls_at_rest_is_in_balance_with_the_support() -> None:
    """No other load: the sum of the support's forces is the cord's pull, Hooke's law of the length that it has."""
    cord = Ligament(TOP, ABOVE, 40.0, slack=0.25)
    with Problem(BAR, MATERIAL, TIGHT, springs={"cord": cord}) as problem:
        state = problem.solve(Loading())
        support = problem.internal_forces(state)[BAR.fixed].sum(axis=0)
        moved = np.asarray(cord.carried("cord", BAR).displace(state.displacement)[0])
    apart = np.array(TOP) + moved - ABOVE
    length = np.linalg.norm(apart)
    assert 0.25 < length < 0.29
    np.testing.assert_allclose(support, 40.0 * (length - 0.25) * apart / length, atol=1e-7)
    assert state.is_stable


def test_a_slack_one_does_nothing_and_a_stiff_one_holds_its_place() -> None:
    load = pulled(-0.3)
    with Problem(BAR, MATERIAL, TIGHT) as problem:
        free = problem.solve(load).displacement
    with Problem(BAR, MATERIAL, TIGHT, springs={"cord": Ligament(TOP, ABOVE, 40.0, slack=1.0)}) as problem:
        np.testing.assert_allclose(problem.solve(load).displacement, free, atol=1e-9)
    cord = Ligament(TOP, ABOVE, 1e6)
    with Problem(BAR, MATERIAL, TIGHT, springs={"cord": cord}) as problem:
        state = problem.solve(load)
    moved = np.array(TOP) + cord.carried("cord", BAR).displace(state.displacement)[0]
    assert np.linalg.norm(moved - ABOVE) == pytest.approx(0.3, abs=1e-6)
    assert np.linalg.norm(moved - TOP) < 0.2 * np.linalg.norm(free, axis=1).max()


def test_derivatives_are_those_of_the_states(rng: np.random.Generator) -> None:
    cord = Ligament(TOP, ABOVE, 40.0, slack=0.27)
    load, step = pulled(-0.2), 1e-4
    way = np.zeros_like(BAR.points)
    way[BAR.node_sets["tip"]] = rng.standard_normal(3) / 10.0
    with Problem(BAR, MATERIAL, TIGHT, springs={"cord": cord}) as problem:
        state = problem.solve(load)
        at = Linearisation(problem, load, state)
        forces = np.asarray(load.forces)
        ahead, behind = (problem.solve(Loading(forces + s * step * way), state).displacement for s in (1.0, -1.0))
        wanted = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(at.tangent(Change(forces=way)), wanted, atol=1e-6 * np.abs(wanted).max())
        pushed = at.tangent(Change(springs={"cord": 1.0}))
        gradient = at.gradient(way).springs["cord"]
        assert gradient == pytest.approx(float((pushed * way).sum()), rel=1e-8)
        ends = []
        for sign in (1.0, -1.0):
            problem.set_springs({"cord": 1.0 + sign * step})
            ends.append(problem.solve(load, state).displacement)
        wanted = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(pushed, wanted, atol=1e-6 * np.abs(wanted).max())
        with pytest.raises(ValueError, match="expected a body without ligaments"):
            at.hessian_product(way, Change(forces=way))


def test_a_header_keeps_both_kinds() -> None:
    cord = {"place": [0, 0, 0], "end": [0, 0, 1], "stiffness": 2.0, "slack": None}
    assert springs_of({"springs": {"bed": {"normal": 1.0, "tangential": 0.0}, "cord": cord}}) == {
        "bed": Springs(1.0),
        "cord": Ligament((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 2.0),
    }


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"end": TOP}, "expected another point than the place"),
        ({"stiffness": 0.0}, "expected more than 0 N/m, got 0"),
        ({"slack": -0.1}, "expected a length of 0 m or more, got -0.1"),
        ({"place": (np.nan, 0.0, 0.0)}, "expected three finite coordinates"),
    ],
)
def test_what_is_none_is_refused(entries: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Ligament(**{"place": TOP, "end": ABOVE, "stiffness": 1.0, **entries})


def test_what_does_not_hold_is_refused() -> None:
    cord = Ligament(TOP, ABOVE, 40.0)
    with pytest.raises(ValueError, match=r"springs\['cord'\]\.place: expected a place on the organ, got one 50"):
        Problem(BAR, MATERIAL, springs={"cord": Ligament((0.35, 0.0, 0.0), ABOVE, 1.0)})
    with pytest.raises(ValueError, match="got ligaments alone"):
        Problem(BAR, MATERIAL, held={}, springs={"cord": cord})
    with pytest.raises(ValueError, match="expected springs on surfaces, got ligaments"):
        unloaded(BAR, MATERIAL, pulled(0.1), springs={"cord": cord})
