"""Algorithm 5 as the thesis prints it, a row of benchmarks/hybrid_newton.py: what it picks and where it ends."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
hybrid_newton = pytest.importorskip("hybrid_newton", reason="torch is absent")

from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import NewtonOptions, Problem


@pytest.fixture(scope="module")
def problem() -> Iterator[Problem]:
    body = beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron")
    with Problem(body, NeoHookean(5000.0, 0.4), NewtonOptions(tolerance=1e-10)) as made:
        yield made


def tip_force(problem: Problem, newtons: float) -> np.ndarray:
    forces = np.zeros_like(problem.body.points)
    tip = problem.body.node_sets["tip"]
    forces[tip, -1] = newtons / len(tip)
    return forces


class Says:
    """A network that says the same of each load."""

    def __init__(self, displacement: np.ndarray) -> None:
        self.displacement = displacement

    def solve(self, forces: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(displacement=self.displacement)


def test_a_prediction_in_balance_is_taken_as_it_is(problem: Problem) -> None:
    load = tip_force(problem, 3.0)
    truth = problem.solve(load).displacement
    found = hybrid_newton.printed_way(problem, Says(truth))(load)
    assert found.picked and found.iterations == 0
    np.testing.assert_allclose(found.displacement, truth, atol=1e-8)


@pytest.mark.parametrize(("wrong", "picked"), [(1.01, True), (-3.0, False)], ids=["near", "far"])
def test_the_better_of_prediction_and_first_step_goes_on_to_the_same_state(
    problem: Problem, wrong: float, picked: bool
) -> None:
    load = tip_force(problem, 3.0)
    truth = problem.solve(load).displacement
    found = hybrid_newton.printed_way(problem, Says(wrong * truth))(load)
    alone = hybrid_newton.printed_way(problem, None)(load)  # algorithm 4: the same full steps from rest
    assert found.picked is picked
    assert found.iterations < alone.iterations if picked else found.iterations == alone.iterations
    np.testing.assert_allclose(found.displacement, truth, atol=1e-7 * np.abs(truth).max())


def test_full_steps_that_lead_nowhere_are_told(problem: Problem) -> None:
    load = -tip_force(problem, 4e3)[:, [2, 0, 1]]
    found = hybrid_newton.printed_way(problem, None)(load)
    assert found.displacement is None and found.iterations > 0
