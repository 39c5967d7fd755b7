"""A pull at the organ: the most usual load about a place under which the network says that it follows the mouse."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.registration.verdict import Verdict
from softtwin.surrogate.error_bound import ErrorBound

from ..twin import Twin

Floats = NDArray[np.float64]

_GRIP, _REACH = 0.1, 0.4  # radii of what follows the mouse and of where the load acts, relative to the body's size
_FARTHEST = 1.5  # times the largest calibrated displacement: beyond it the patch no longer follows
_EXTENT = 1.3  # times as far out as any load of the training: beyond it the network's state is of no use to look at
_WORTHLESS = 0.02  # of the body's size: where the largest error may be more, a state is not worth a look
_PARTS = (1.0, 0.5, 0.25)  # of the way to the mouse that are tried, until the prediction is worth something
_LEFT, _LEAST_LEFT = 0.2, 1e-3  # of the way, and metres, that a place may lag behind the mouse and still follow it
_STEPS = 2  # of Newton's method for each place of the mouse: the network is smooth and the mouse moves little


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the network says of a pull.

    Args:
        displacement: nodal, (n, 3), metres.
        forces: nodal, (n, 3), newtons.
        pull: net force of the pull, (3,), newtons.
        error_bound: how wrong the displacement may be; None where the network was never calibrated.
        asked: when the mouse was there, seconds of the monotonic clock.
        is_held: whether the mouse is farther away than the organ could follow it.
    """

    displacement: Floats
    forces: Floats
    pull: Floats
    error_bound: ErrorBound | None
    asked: float
    is_held: bool = False


@dataclass(frozen=True, eq=False)
class Place:
    """Where the mouse is.

    Args:
        translation: from where it took hold, (3,), metres.
        at: when, seconds of the monotonic clock.
    """

    translation: Floats
    at: float


class Pull:
    """One pull, from where the mouse took hold.

    Args:
        twin: with a network.
        held: place that the mouse took hold of, (3,), metres.
        displacement: nodal, as shown when it did, (n, 3), metres.
        forces: nodal, that act already, (n, 3), newtons.
    """

    def __init__(self, twin: Twin, held: Floats, displacement: Floats, forces: Floats) -> None:
        self._twin, self._before = twin, forces
        self._weights = patch(twin, held, displacement, _GRIP)
        state = twin.predict(forces)
        self._rest = self._weights @ state.displacement
        self._basis = typical_loads(twin, held, displacement, _moved_by(state, self._weights))
        self._farthest = _FARTHEST * farthest(twin)
        self._limit = _WORTHLESS * twin.body.size
        self._amounts: Floats = np.zeros(3)
        self._last: Prediction | None = None
        self._reached = self._rest

    def to(self, place: Place) -> Prediction:
        """The prediction for a place of the mouse; where it would be worth nothing, the last one, which is said."""
        wanted = self._rest + _within(place.translation, self._farthest)
        for part in _PARTS if self._last is not None else (1.0,):
            before = self._amounts
            found = self._prediction(self._towards(self._reached + part * (wanted - self._reached)), place.at)
            bound = 0.0 if found.error_bound is None else found.error_bound.largest
            if bound <= self._limit or self._last is None:
                self._last = found
                self._reached = self._weights @ found.displacement
                break
            self._amounts = before
        assert self._last is not None
        return replace(self._last, is_held=self._is_held(place), asked=place.at)

    def _is_held(self, place: Place) -> bool:
        left = np.linalg.norm(self._rest + place.translation - self._reached)
        return bool(left > _LEFT * np.linalg.norm(place.translation) + _LEAST_LEFT)

    def _towards(self, wanted: Floats) -> Any:
        """The state under amounts by which the place is where it is wanted, or nearer to it."""
        state: Any = self._twin.predict(self._forces(self._amounts))
        for _ in range(_STEPS):
            missing = wanted - self._weights @ state.displacement
            compliance = _moved_by(state, self._weights).reshape(3, -1) @ self._basis.reshape(-1, 3)
            state = self._advance(np.linalg.lstsq(compliance, missing, rcond=1e-6)[0], state)
        return state

    def _prediction(self, state: Any, asked: float) -> Prediction:
        forces = self._forces(self._amounts)
        error_bound = self._twin.bound_error(forces, state) if is_calibrated(self._twin) else None
        return Prediction(state.displacement, forces, (self._basis @ self._amounts).sum(axis=0), error_bound, asked)

    def _advance(self, step: Floats, state: Any) -> Any:
        """The state after as much of a step as leaves the load where the network says something; moves there."""
        for part in (1.0, 0.5, 0.25, 0.1):
            amounts = self._amounts + part * step
            reached: Any = self._twin.predict(self._forces(amounts))
            extent = reached.extrapolation_ratio
            if extent is None or extent <= _EXTENT or extent <= state.extrapolation_ratio:
                self._amounts = amounts
                return reached
        return state

    def _forces(self, amounts: Floats) -> Floats:
        return self._before + self._basis @ amounts


def judged(found: Prediction) -> tuple[Verdict, str]:
    """The verdict on a prediction by its certificate, and why it is not accepted."""
    error_bound = found.error_bound
    if error_bound is None:
        return Verdict.DOUBTFUL, "no certificate: this twin was never calibrated"
    if found.is_held:
        return Verdict.DOUBTFUL, "it follows no farther: what the network says beyond this pull is worth nothing"
    if error_bound.is_inside and np.isfinite(error_bound.largest):
        return Verdict.ACCEPTED, ""
    return Verdict.DOUBTFUL, next(iter(error_bound.reasons), "nothing can be said of its error")


def typical_loads(twin: Twin, held: Floats, displacement: Floats, response: Floats) -> Floats:
    """Three loads on the nodes about a place, (n, 3, 3), newtons: the most usual ones that move it along each axis.

    Usual is what the training loads were like on these nodes: of all loads that move the place by as much, these have
    the least Mahalanobis length, which is what the certificate asks of a load. They are as long as they are usual.

    Args:
        twin: with a network.
        held: the place, (3,), metres, on the moved organ.
        displacement: nodal, (n, 3), metres.
        response: gradient of the place's movement by the forces, (3, n, 3), metres a newton.
    """
    maps = twin.model.encoder_decoder  # type: ignore[attr-defined]
    near = (patch(twin, held, displacement, _REACH) > 0.0)[maps.loaded]
    rows = np.repeat(near, 3)
    gradient = response[:, maps.loaded].reshape(3, -1)[:, rows]
    loads = gradient.T
    if maps.load_modes is not None and maps.load_rest is not None:
        modes = maps.load_modes[rows]
        loads = modes @ (modes.T @ gradient.T) + float(maps.load_rest[0]) * gradient.T
    basis = np.zeros((len(maps.loaded) * 3, 3))
    basis[rows] = loads / max(float(np.linalg.norm(loads, axis=0).max()), 1e-300)
    whole = np.zeros((len(twin.body.points), 3, 3))
    whole[maps.loaded] = basis.reshape(-1, 3, 3)
    return whole


def _moved_by(state: Any, weights: Floats) -> Floats:
    """Gradient of the weighted displacement by the nodal forces, (3, n, 3), metres a newton."""
    return np.stack([state.vjp(np.outer(weights, axis)) for axis in np.eye(3)])


def patch(twin: Twin, held: Floats, displacement: Floats, relative: float) -> Floats:
    """Shares of the nodes about a place, (n,), that sum to one: of those alone that may carry load.

    Args:
        twin: with a network.
        held: the place, (3,), metres, on the moved organ.
        displacement: nodal, (n, 3), metres.
        relative: radius of the patch, relative to the body's size.
    """
    body, loaded = twin.body, twin.model.encoder_decoder.loaded  # type: ignore[attr-defined]
    away = np.linalg.norm(body.points[loaded] + displacement[loaded] - held, axis=1)
    radius = max(relative * body.size, 1.5 * float(away.min()))
    shares = np.zeros(len(body.points))
    shares[loaded] = np.square(np.maximum(1.0 - np.square(away / radius), 0.0))
    return shares / shares.sum()


def farthest(twin: Twin) -> float:
    """Largest displacement that the network's certificate was calibrated for, or that it has learned, metres."""
    card = twin.model.card  # type: ignore[attr-defined]
    limits = (card.get("certificate") or {}).get("limits", {})
    return float(limits.get("size") or (card.get("domain") or {}).get("displacement_m") or 0.2 * twin.body.size)


def is_calibrated(twin: Twin) -> bool:
    """Whether the network has a certificate."""
    return bool(getattr(twin.model, "card", {}).get("certificate"))


def _within(vector: Floats, length: float) -> Floats:
    size = float(np.linalg.norm(vector))
    return vector if size <= length else vector * (length / size)
