"""Registration on a forward model with a closed form: gradients, one-sidedness, recovery of known forces, doubt."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.shapes import beam
from softtwin.reference.outcome import NotConverged
from softtwin.registration.control import nodal_control
from softtwin.registration.minimise import Registrar, RegistrationOptions
from softtwin.registration.objective import CloudObjective
from softtwin.registration.sequence import register_sequence


class Cantilever:
    """A smooth nonlinear forward model: u = w(x) g(A f), with A a mean over the nodes and g odd and saturating."""

    def __init__(self, body: Body, refuse_above: float = np.inf) -> None:
        self.body = body
        self.refuse_above = refuse_above
        span = body.points[:, 0] / body.points[:, 0].max()
        self._shape = span**2
        self._shape[body.fixed] = 0.0
        self.reset()

    def reset(self) -> None:
        self._mean = np.zeros(3)

    def solve(self, forces: ArrayLike) -> np.ndarray:
        mean = self._shape @ np.asarray(forces)
        if np.abs(mean).max() > self.refuse_above:
            raise NotConverged("too large a step for the test model")
        self._mean = mean
        return 0.2 * self._shape[:, None] * np.tanh(self._mean)

    def pullback(self, cotangent: ArrayLike) -> np.ndarray:
        slope = 0.2 * (1.0 - np.tanh(self._mean) ** 2)
        return self._shape[:, None] * slope * (self._shape @ np.asarray(cotangent))

    def sensitivity(self, columns: ArrayLike) -> np.ndarray:
        moved = np.asarray(columns).reshape(-1, 3, np.shape(columns)[1])
        slope = 0.2 * (1.0 - np.tanh(self._mean) ** 2)
        mean = np.einsum("n,nik->ik", self._shape, moved)
        return np.einsum("n,i,ik->nik", self._shape, slope, mean).reshape(-1, moved.shape[2])


@pytest.fixture(scope="module")
def body() -> Body:
    made = beam((8, 3, 3), (0.8, 0.2, 0.2), "tetrahedron")
    top = made.boundary[(made.points[made.boundary][:, :, 2] > 0.199).all(axis=1)]
    return Body(made.points, made.cells, made.node_sets, {"observed": top})


def cloud_on(
    body: Body, displacement: np.ndarray, count: int, rng: np.random.Generator, noise: float = 0.0
) -> np.ndarray:
    triangles = body.surfaces["observed"][rng.integers(len(body.surfaces["observed"]), size=count)]
    weights = rng.dirichlet(np.ones(3), size=count)
    points = np.einsum("pk,pki->pi", weights, (body.points + displacement)[triangles])
    return points + noise * rng.standard_normal(points.shape)


def tip_forces(body: Body, net: tuple[float, float, float]) -> np.ndarray:
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"]] = np.array(net) / len(body.node_sets["tip"])
    return forces


def test_distance_gradient_passes_the_taylor_test(body: Body, rng) -> None:
    objective = CloudObjective(body, body.surfaces["observed"])
    cloud = cloud_on(body, np.zeros_like(body.points), 80, rng, noise=5e-3)
    u = 1e-3 * rng.standard_normal(body.points.shape)
    direction = rng.standard_normal(u.shape)
    value = lambda h: objective.match((u + h * direction)[objective.nodes], cloud).value  # noqa: E731
    slope = float((objective.gradient(objective.match(u[objective.nodes], cloud)) * direction).sum())
    steps = 2e-4 * 0.5 ** np.arange(5)
    errors = [abs(value(h) - value(0.0) - h * slope) for h in steps]
    assert np.median(np.log2(np.divide(errors[:-1], errors[1:]))) > 1.9


def test_closest_points_are_the_closest(body: Body, rng) -> None:
    objective = CloudObjective(body, body.surfaces["observed"])
    cloud = cloud_on(body, np.zeros_like(body.points), 40, rng, noise=2e-2)
    found = np.abs(objective.match(np.zeros((len(objective.nodes), 3)), cloud).distances)
    weights = rng.dirichlet(np.ones(3), size=4000)
    dense = np.einsum("qk,tki->tqi", weights, body.points[body.surfaces["observed"]]).reshape(-1, 3)
    brute = np.linalg.norm(cloud[:, None] - dense[None], axis=2).min(axis=1)
    assert (found <= brute + 1e-12).all() and (brute - found).max() < 5e-3  # sampling finds nothing nearer


def test_what_is_not_seen_pulls_nothing(body: Body, rng) -> None:
    """Points of one corner of the observed side leave the gradient of all other nodes exactly zero."""
    objective = CloudObjective(body, body.surfaces["observed"])
    corner = cloud_on(body, np.zeros_like(body.points), 400, rng, noise=1e-3)
    corner = corner[corner[:, 0] < 0.15]
    gradient = objective.gradient(objective.match(np.zeros((len(objective.nodes), 3)), corner))
    assert np.abs(gradient[body.points[:, 0] > 0.3]).max() == 0.0
    assert np.abs(gradient).max() > 0.0


@pytest.mark.parametrize("method", ["gauss-newton", "l-bfgs"])
def test_a_known_force_is_recovered(body: Body, rng, method: str) -> None:
    model = Cantilever(body)
    true = tip_forces(body, (0.0, 0.3, -0.8))
    truth = model.solve(true)
    cloud = cloud_on(body, truth, 300, rng)
    control = nodal_control(body, body.node_sets["tip"], force_scale=1.0)
    options = RegistrationOptions(noise=1e-4, method=method, max_iterations=200)
    result = Registrar(model, CloudObjective(body, body.surfaces["observed"]), control, options).register(cloud)
    # Across its own normal a flat patch slides freely: the seen component is what must be found.
    assert result.net_force[2] == pytest.approx(-0.8, rel=5e-3)
    assert np.abs(result.displacement - truth)[:, 2].max() < 5e-4
    assert np.abs(result.forces[np.setdiff1d(np.arange(len(body.points)), control.nodes)]).max() == 0.0
    assert result.rms_distance < 2e-4


def test_the_trace_never_rises_at_equal_noise(body: Body, rng) -> None:
    model = Cantilever(body)
    cloud = cloud_on(body, model.solve(tip_forces(body, (0.0, 0.5, -1.5))), 200, rng)
    registrar = Registrar(
        model,
        CloudObjective(body, body.surfaces["observed"]),
        nodal_control(body, body.node_sets["tip"]),
        RegistrationOptions(noise=1e-3),
    )
    distances = [step.rms_distance for step in registrar.register(cloud).trace]
    assert len(distances) > 2 and (np.diff(distances) < 1e-4).all()


def test_a_model_that_refuses_large_steps_is_led_by_small_ones(body: Body, rng) -> None:
    model = Cantilever(body)
    cloud = cloud_on(body, model.solve(tip_forces(body, (0.0, 0.0, -0.5))), 200, rng)
    timid = Cantilever(body, refuse_above=1.2)
    control = nodal_control(body, body.node_sets["tip"], force_scale=10.0)
    options = RegistrationOptions(noise=1e-4, max_step=10.0)
    result = Registrar(timid, CloudObjective(body, body.surfaces["observed"]), control, options).register(cloud)
    assert result.rms_distance < 1e-3


def test_doubt_of_the_net_force_grows_with_the_noise_and_covers_the_error(body: Body) -> None:
    model = Cantilever(body)
    truth = model.solve(tip_forces(body, (0.0, 0.0, -0.6)))
    control = nodal_control(body, body.node_sets["tip"], force_scale=0.2)
    objective = CloudObjective(body, body.surfaces["observed"])
    deviations, scores = [], []
    for noise in (5e-4, 2e-3):
        registrar = Registrar(model, objective, control, RegistrationOptions(noise=noise))
        for seed in range(20):
            result = registrar.register(cloud_on(body, truth, 200, np.random.default_rng(seed), noise))
            scores.append((result.net_force[2] + 0.6) / result.net_force_deviation[2])
        deviations.append(result.net_force_deviation[2])
    assert deviations[1] > 2.0 * deviations[0]
    # 40 scores of about unit variance: their rms is 1 within 0.11 (one sigma); 2 and 0.4 are far outside that.
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 2.0


def test_smooth_controls_correlate_and_keep_their_scale(body: Body) -> None:
    control = nodal_control(body, body.node_sets["tip"], force_scale=0.3, smoothness=0.1)
    covariance = (control.basis @ control.basis.T).reshape(len(body.points), 3, len(body.points), 3)
    first, second = control.nodes[:2]
    assert covariance[first, 0, first, 0] == pytest.approx(0.09, rel=2e-3)
    assert covariance[first, 0, second, 1] == 0.0
    assert covariance[first, 2, second, 2] > 0.5 * 0.09


def test_zones_inside_or_fixed_are_refused(body: Body) -> None:
    with pytest.raises(ValueError, match=r"nodal_control\.nodes: expected nodes on the free boundary"):
        nodal_control(body, body.fixed)
    with pytest.raises(ValueError, match=r"force_scale: expected a positive force"):
        nodal_control(body, body.node_sets["tip"], force_scale=0.0)


def test_sequences_start_warm_and_refuse_bad_clouds(body: Body, rng) -> None:
    model = Cantilever(body)
    clouds = [cloud_on(body, model.solve(tip_forces(body, (0.0, 0.0, f))), 150, rng) for f in (-1.0, -1.02)]
    registrar = Registrar(
        model, CloudObjective(body, body.surfaces["observed"]), nodal_control(body, body.node_sets["tip"])
    )
    cold, warm = register_sequence(registrar, clouds)
    assert warm.evaluations < cold.evaluations
    bad = clouds[0].copy()
    bad[3, 1] = np.nan
    with pytest.raises(CloudError):
        list(register_sequence(registrar, [bad]))
    with pytest.raises(CloudError):
        list(register_sequence(registrar, [clouds[0] + 1.0]))


@pytest.mark.parametrize("name", ["noise", "step", "max_step"])
def test_options_that_cannot_be_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"RegistrationOptions\.{name}: expected a positive length"):
        RegistrationOptions(**{name: 0.0})
