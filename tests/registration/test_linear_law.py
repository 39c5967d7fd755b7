"""What a linear law leaves out is in the margins of whoever registers with it."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import LinearElastic, NeoHookean
from softtwin.registration.linear_law import displacement_gradient_norm, linear_law_error
from softtwin.registration.options import expected_force, options_for
from softtwin.registration.registrar import prepare
from softtwin.registration.result import Registration
from softtwin.registration.uncertainty import uncertainty
from softtwin.registration.verdict import Code, Verdict
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.equilibria_model import EquilibriaModel

MODULUS, RATIO = 3000.0, 0.4


@pytest.fixture(scope="module")
def block() -> Body:
    return beam((8, 3, 3), (0.4, 0.15, 0.15), "tetrahedron")


def registered(block: Body, law: type, force: float, rng: np.random.Generator) -> tuple[Registration, np.ndarray]:
    """A cloud of a Neo-Hookean block that is pulled aside at its end, by a law; and how far off each free node is."""
    tip = np.flatnonzero(np.isclose(block.points[:, 0], 0.4))
    pull = np.zeros_like(block.points)
    pull[tip, 2] = force / len(tip)
    truth = EquilibriaModel(Equilibria(block, NeoHookean(MODULUS, RATIO))).solve(pull).displacement
    chosen = block.boundary[rng.integers(len(block.boundary), size=800)]
    cloud = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), size=800), (block.points + truth)[chosen])
    model = EquilibriaModel(Equilibria(block, law(MODULUS, RATIO)))
    registrar = prepare(
        model, tip, force_scale=expected_force(block, MODULUS), smoothness=0.05, options=options_for(model, True)
    )
    found = registrar.register(cloud + 2e-4 * rng.standard_normal(cloud.shape))
    is_free = ~np.isin(np.arange(len(block.points)), block.fixed)
    return found, np.linalg.norm(found.displacement - truth, axis=1)[is_free]


def test_it_is_half_of_the_gradient_of_the_largest_displacement(block: Body) -> None:
    turned = block.points @ np.array([[0.0, 0.1, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert displacement_gradient_norm(block, turned) == pytest.approx(0.1)
    largest = np.linalg.norm(turned, axis=1).max()
    assert linear_law_error(block, turned) == pytest.approx(0.05 * largest / np.sqrt(3.0))
    assert linear_law_error(block, 0.1 * turned) == pytest.approx(0.01 * linear_law_error(block, turned))
    assert linear_law_error(block, np.zeros_like(turned)) == 0.0


def test_margins_hold_what_a_linear_law_leaves_out(block: Body, rng: np.random.Generator) -> None:
    found, errors = registered(block, LinearElastic, 0.7, rng)
    is_free = ~np.isin(np.arange(len(block.points)), block.fixed)
    assert any(check.code is Code.LINEAR_LAW and not check.is_passed for check in found.judgement.checks)
    without = uncertainty(found.problem, found.evaluation, found.posterior, found.prepared.unseen)
    assert np.mean(errors < without.margin(confidence=0.9)[is_free]) < 0.5
    for frame in (found.uncertainty, found.camera_uncertainty):
        assert np.mean(errors < frame.margin(confidence=0.9)[is_free]) > 0.85
        np.testing.assert_allclose(frame.rest, linear_law_error(block, found.displacement))


def test_a_body_that_may_be_inside_out_is_refused(block: Body, rng: np.random.Generator) -> None:
    found, _ = registered(block, LinearElastic, 4.0, rng)
    (check,) = (each for each in found.judgement.checks if each.code is Code.LINEAR_LAW)
    assert check.statistic > 1.0 and check.verdict is Verdict.REFUSED
    assert found.judgement.verdict is Verdict.REFUSED


def test_a_law_that_is_not_linear_has_its_own_margins(block: Body, rng: np.random.Generator) -> None:
    found, errors = registered(block, NeoHookean, 0.35, rng)
    is_free = ~np.isin(np.arange(len(block.points)), block.fixed)
    assert errors.mean() < 3e-4 and found.uncertainty.margin()[is_free].mean() < 2e-3
