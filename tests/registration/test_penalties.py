"""What forces cost in place of their Gaussian prior: derivatives, known integrals, what is preferred and refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import check_grad

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.shapes import beam
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import RegistrationOptions
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.nodal_forces import NodalForces, nodal_forces
from softtwin.registration.penalties import Amplitude, Divergence, Penalty
from softtwin.registration.registrar import Registrar
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, cloud_on, tip_forces

SCALE = LogNormalPrior(0.05, 2.0, minimum=1e-4)


def everywhere(body: Body, smoothness: float = 0.0) -> NodalForces:
    return nodal_forces(body, np.arange(len(body.points)), SCALE, smoothness)


@pytest.mark.parametrize("penalty", [Amplitude(0.3), Divergence(0.3)])
@pytest.mark.parametrize("smoothness", [0.0, 0.1])
def test_gradients_are_exact(body: Body, rng, penalty: Penalty, smoothness: float) -> None:
    forces = everywhere(body, smoothness)
    cost, at = penalty.of(body, forces), 0.05 * rng.standard_normal(forces.size)
    value, slope = cost(at)
    assert check_grad(lambda x: cost(x)[0], lambda x: cost(x)[1], at) < 1e-4 * np.linalg.norm(slope)
    assert value > 0.0 and cost(np.zeros(forces.size))[0] == 0.0


def test_the_amplitude_is_the_sum_of_the_forces(body: Body, rng) -> None:
    forces = everywhere(body)
    at = 0.05 * rng.standard_normal(forces.size)
    whole = 0.5 * 0.4 * np.linalg.norm(forces.forces(at), axis=1).sum() / SCALE.median
    rounded = 0.5 * 0.4 * 0.02 * len(forces.nodes)  # what is taken off where the root has its corner
    assert whole - rounded < Amplitude(0.4).of(body, forces)(at)[0] < whole


def test_the_divergence_is_that_of_a_linear_traction() -> None:
    """t = c (0, y, 0) over a box that is held nowhere near: its surface divergence is c but where y is the normal."""
    box = beam((6, 4, 4), (0.6, 0.2, 0.2), "tetrahedron")
    forces = nodal_forces(box, np.arange(len(box.points)), SCALE)
    areas = np.zeros(len(box.points))
    corners = box.points[box.boundary]
    own = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    np.add.at(areas, box.boundary.ravel(), np.repeat(own / 3.0, 3))
    nodal = np.zeros_like(box.points)
    nodal[:, 1] = 7.0 * box.points[:, 1] * areas
    at = nodal[forces.nodes].ravel()
    kept = ~np.isin(box.boundary, box.fixed).any(axis=1)  # fixed nodes bear no force: the triangles there differ
    flat = np.ptp(corners[:, :, 1], axis=1) > 1e-9
    expected = SCALE.median / areas[areas > 0.0].mean()
    least = 0.5 * 0.5 * (7.0 / expected) ** 2 * own[kept & flat].sum()
    held = 0.5 * 0.5 * (7.0 / expected) ** 2 * own[~kept].sum()
    value = Divergence(0.5).of(box, forces)(at)[0]
    assert least <= value < least + 40.0 * held
    constant = np.zeros_like(box.points)
    constant[:, 2] = areas  # the same traction everywhere diverges at the fixed end alone
    assert Divergence(0.5).of(box, forces)(constant[forces.nodes].ravel())[0] < 0.2 * value


@pytest.mark.parametrize("penalty", [Amplitude(0.02), Divergence(0.02)])
def test_a_pull_is_found_with_it(body: Body, rng, penalty: Penalty) -> None:
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    observed = SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"], SCALE)
    made = Registrar(Cantilever(body), observed, forces, RegistrationOptions(solver=LBFGS(penalty=penalty)))
    found = made.register(cloud_on(body, truth, 300, rng, 1e-4))
    assert found.outcome is Outcome.CONVERGED
    assert np.abs(found.displacement - truth).mean() < 1e-3
    np.testing.assert_allclose(found.net_force[1:], (0.3, -0.8), rtol=0.05)


def test_more_of_it_means_smaller_forces(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    observed = SurfaceDistance(body, body.surfaces["observed"])
    forces, cloud = nodal_forces(body, body.node_sets["tip"], SCALE), cloud_on(body, truth, 300, rng, 1e-4)
    sizes = []
    for alpha in (0.0, 1.0):
        options = RegistrationOptions(
            solver=LBFGS(penalty=Amplitude(alpha)), noise=LogNormalPrior(0.02, 0.0, minimum=0.02)
        )
        found = Registrar(Cantilever(body), observed, forces, options).register(cloud)
        sizes.append(np.linalg.norm(found.forces, axis=1).sum())
    assert sizes[1] < 0.98 * sizes[0]


@pytest.mark.parametrize("alpha", [-0.1, 1.1, np.nan])
@pytest.mark.parametrize("kind", [Amplitude, Divergence])
def test_weights_lie_between_none_and_all(kind: type, alpha: float) -> None:
    with pytest.raises(ValueError, match=rf"{kind.__name__}\.alpha: expected a number in \[0, 1\], got"):
        kind(alpha)


def test_a_skin_has_no_divergence(body: Body) -> None:
    skinned = replace(body, surfaces={}, skin=Surface(0.9 * body.points + 0.005, body.boundary))
    with pytest.raises(ValueError, match=r"Divergence\.body: expected a body whose nodes are its surface's"):
        Divergence(0.1).of(skinned, everywhere(body))
