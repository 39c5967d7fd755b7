"""The best coefficients for one cloud: Gauss-Newton in a trust region, or L-BFGS with the adjoint."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from softtwin.reference.outcome import NotConverged

from .control import Control
from .forward import ForwardModel, Restricted, restrict
from .objective import CloudObjective, Match

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RegistrationOptions:
    """How a cloud is trusted and when to stop.

    Args:
        noise: standard deviation expected of a point's distance to the surface, metres.
        method: `gauss-newton` with sensitivities, or `l-bfgs` with the adjoint.
        max_iterations: iterations for one cloud.
        step: mean movement of the observed nodes below which a step is the last one, metres.
        max_step: first limit on the movement of any observed node in one step, metres.
    """

    noise: float = 5e-4
    method: Literal["gauss-newton", "l-bfgs"] = "gauss-newton"
    max_iterations: int = 40
    step: float = 1e-5
    max_step: float = 8e-3

    def __post_init__(self) -> None:
        for name in ("noise", "step", "max_step"):
            if not getattr(self, name) > 0.0:
                raise ValueError(
                    f"RegistrationOptions.{name}: expected a positive length in metres, got {getattr(self, name)}."
                )
        if self.method not in ("gauss-newton", "l-bfgs"):
            raise ValueError(f"RegistrationOptions.method: expected 'gauss-newton' or 'l-bfgs', got {self.method!r}.")


@dataclass(frozen=True)
class Step:
    """One iteration: rms distance (m), objective, largest and mean movement (m), gain over what was predicted."""

    rms_distance: float
    objective: float
    largest_movement: float
    mean_movement: float
    gain: float


@dataclass(frozen=True, eq=False)
class Registration:
    """One registered cloud.

    Args:
        coefficients: of the control, (k,).
        forces: nodal forces, (n, 3), newtons.
        displacement: of all nodes, (n, 3), metres.
        net_force: (3,), newtons.
        net_force_deviation: standard deviation of the net force given the noise and the prior, (3,), newtons.
        rms_distance: of the cloud to the registered surface, metres.
        evaluations: forward solves.
        seconds: wall time.
        reason: why the iteration stopped.
        trace: one entry an iteration.
    """

    coefficients: Floats
    forces: Floats
    displacement: Floats
    net_force: Floats
    net_force_deviation: Floats
    rms_distance: float
    evaluations: int
    seconds: float
    reason: str
    trace: tuple[Step, ...]


class Registrar:
    """Registers clouds to one body with one model; what does not depend on the cloud is prepared once.

    Args:
        model: forward model.
        objective: the observed side.
        control: the unknown forces.
        options: noise, method, stopping.
    """

    def __init__(
        self,
        model: ForwardModel,
        objective: CloudObjective,
        control: Control,
        options: RegistrationOptions | None = None,
    ) -> None:
        self.model = model
        self.objective = objective
        self.control = control
        self.options = options or RegistrationOptions()
        self._restricted = restrict(model, objective.nodes, control.basis)

    def register(self, cloud: Floats, start: Floats | None = None) -> Registration:
        """The forces and the displacement that bring the surface to a cloud.

        Minimises sum d^2 / (2 noise^2) + |c|^2 / 2 over the coefficients c.

        Args:
            cloud: observed points, (p, 3), metres.
            start: coefficients to start from, (k,); no force if not given.
        """
        begin = time.perf_counter()
        first = np.zeros(self.control.basis.shape[1]) if start is None else np.array(start, dtype=np.float64)
        search = _gauss_newton if self.options.method == "gauss-newton" else _lbfgs
        found = search(self._restricted, self, np.asarray(cloud, dtype=np.float64), first)
        return Registration(
            coefficients=found.coefficients,
            forces=self.control.forces(found.coefficients),
            displacement=self._restricted.full(found.coefficients),
            net_force=self.control.net_force(found.coefficients),
            net_force_deviation=self._deviation(found.jacobian),
            rms_distance=_rms(found.match),
            evaluations=found.evaluations,
            seconds=time.perf_counter() - begin,
            reason=found.reason,
            trace=found.trace,
        )

    def _deviation(self, jacobian: Floats) -> Floats:
        """Laplace's approximation: the covariance of the coefficients is the inverse of the Gauss-Newton matrix."""
        scaled = jacobian / self.options.noise
        hessian = scaled.T @ scaled + np.eye(scaled.shape[1])
        net = self.control.net_basis
        return np.sqrt(np.einsum("ik,ki->i", net, np.linalg.solve(hessian, net.T)))


@dataclass(frozen=True, eq=False)
class _Found:
    coefficients: Floats
    match: Match
    jacobian: Floats  # of the distances, (p, k)
    evaluations: int
    reason: str
    trace: tuple[Step, ...]


def _rms(match: Match) -> float:
    return float(np.sqrt(np.mean(match.distances**2)))


def _gauss_newton(model: Restricted, registrar: Registrar, cloud: Floats, start: Floats) -> _Found:
    """Trust-region Gauss-Newton. The noise falls with the residual, so that a far start does not overfit its way."""
    options, objective = registrar.options, registrar.objective
    coefficients, limit = start, options.max_step
    match = objective.match(model.solve_coefficients(coefficients), cloud)
    trace: list[Step] = []
    evaluations, reason = 1, "most iterations reached"
    distances_by_coefficients = np.empty((0, 0))
    for _ in range(options.max_iterations):
        noise = max(options.noise, 0.1 * _rms(match))
        movement = model.jacobian(coefficients)
        distances_by_coefficients = objective.jacobian(match) @ movement
        quadratic = _Quadratic(distances_by_coefficients / noise, match.distances / noise, coefficients, movement)
        value = _value(match, coefficients, noise)
        accepted = None
        while accepted is None and limit > 0.1 * options.step:
            change = quadratic.step(limit)
            evaluations += 1
            accepted, gain = _try(
                model, objective, cloud, coefficients + change, noise, value, quadratic.decrease(change)
            )
            limit = _next_limit(limit, quadratic.largest_movement(change), gain)
        if accepted is None:
            reason = "no step lowers the objective further"
            break
        coefficients, match = coefficients + change, accepted
        step = Step(
            _rms(match),
            _value(match, coefficients, noise),
            quadratic.largest_movement(change),
            quadratic.mean_movement(change),
            gain,
        )
        trace.append(step)
        settled = noise == options.noise and step.mean_movement < options.step
        if settled or (noise == options.noise and value - step.objective < 1e-4 * value):
            reason = "the surface moves no more" if settled else "the objective falls no more"
            break
    if distances_by_coefficients.size == 0:
        distances_by_coefficients = objective.jacobian(match) @ model.jacobian(coefficients)
    return _Found(coefficients, match, distances_by_coefficients, evaluations, reason, tuple(trace))


def _value(match: Match, coefficients: Floats, noise: float) -> float:
    return 0.5 * float(match.distances @ match.distances) / noise**2 + 0.5 * float(coefficients @ coefficients)


def _try(
    model: Restricted,
    objective: CloudObjective,
    cloud: Floats,
    trial: Floats,
    noise: float,
    value: float,
    expected: float,
) -> tuple[Match | None, float]:
    """The match at a trial and its gain over the prediction; None where the objective does not fall."""
    try:
        match = objective.match(model.solve_coefficients(trial), cloud)
    except NotConverged:
        return None, -1.0
    gain = (value - _value(match, trial, noise)) / expected
    return (match, gain) if gain > 0.0 else (None, gain)


def _next_limit(limit: float, taken: float, gain: float) -> float:
    if gain <= 0.0:
        return min(limit, taken) / 3.0
    if gain < 0.3:
        return limit / 2.0
    return max(limit, 2.0 * taken) if gain > 0.7 else limit


class _Quadratic:
    """The Gauss-Newton model of the objective about the coefficients, with steps limited by what they move."""

    def __init__(self, jacobian: Floats, residual: Floats, coefficients: Floats, movement: Floats) -> None:
        self._jacobian = jacobian
        self._movement = movement
        self._gradient = jacobian.T @ residual + coefficients
        curvatures, self._vectors = np.linalg.eigh(jacobian.T @ jacobian)
        self._curvatures = np.maximum(curvatures, 0.0) + 1.0
        self._rotated = self._vectors.T @ self._gradient

    def step(self, limit: float) -> Floats:
        """The best change of the coefficients that moves no observed node further than the limit, metres."""
        damping = 0.0
        while True:
            change = -self._vectors @ (self._rotated / (self._curvatures + damping))
            if self.largest_movement(change) <= 1.05 * limit:
                return change
            damping = max(1.6 * damping, 1e-8 * self._curvatures[-1], 0.1)

    def decrease(self, change: Floats) -> float:
        """Decrease of the objective that the model predicts."""
        along = self._jacobian @ change
        return -float(self._gradient @ change + 0.5 * (along @ along + change @ change))

    def _lengths(self, change: Floats) -> Floats:
        return np.linalg.norm((self._movement @ change).reshape(-1, 3), axis=1)

    def largest_movement(self, change: Floats) -> float:
        """Largest predicted movement of an observed node, metres."""
        return float(self._lengths(change).max())

    def mean_movement(self, change: Floats) -> float:
        """Mean predicted movement of the observed nodes, metres."""
        return float(self._lengths(change).mean())


def _lbfgs(model: Restricted, registrar: Registrar, cloud: Floats, start: Floats) -> _Found:
    """SciPy's L-BFGS with the gradient by the adjoint (Odot 2023, eq. 6.10): no sensitivities are needed."""
    options, objective, control = registrar.options, registrar.objective, registrar.control
    trace: list[Step] = []
    best: list[Match] = []

    def evaluate(coefficients: Floats) -> tuple[float, Floats]:
        try:
            displacement = registrar.model.solve(control.forces(coefficients))
        except NotConverged:  # a wall that the line search steps back from
            return 10.0 * trace[-1].objective, np.zeros_like(coefficients)
        match = objective.match(displacement[objective.nodes], cloud)
        weight = len(match.distances) / options.noise**2
        pulled = registrar.model.pullback(objective.gradient(match)).ravel() @ control.basis
        value = _value(match, coefficients, options.noise)
        best[:] = [match]
        trace.append(Step(_rms(match), value, np.nan, np.nan, np.nan))
        return value, weight * pulled + coefficients

    limits = {"maxiter": options.max_iterations, "ftol": 1e-9, "maxcor": 30}
    found = minimize(evaluate, start, jac=True, method="L-BFGS-B", options=limits)
    evaluate(found.x)
    jacobian = objective.jacobian(best[0]) @ model.jacobian(found.x)
    message = found.message.decode() if isinstance(found.message, bytes) else str(found.message)
    return _Found(found.x, best[0], jacobian, int(found.nfev), message.lower(), tuple(trace))
