"""A pull at the organ: the force on a patch under which the network says that the patch follows the mouse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtwin.surrogate.certificate import Certificate

from ..twin import Twin

Floats = NDArray[np.float64]

_RADIUS = 0.13  # of the patch, relative to the body's size
_FARTHEST = 1.5  # times the largest calibrated displacement: beyond it the patch no longer follows
_STRONGEST = 0.025  # newtons for each pascal of Young's modulus and square metre of size
_STEPS = 2  # of Newton's method for each place of the mouse: the network is smooth and the mouse moves little


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the network says of a pull.

    Args:
        displacement: nodal, (n, 3), metres.
        forces: nodal, (n, 3), newtons.
        pull: net force of the pull, (3,), newtons.
        certificate: how wrong the displacement may be; None where the network was never calibrated.
        asked: when the mouse was there, seconds of the monotonic clock.
    """

    displacement: Floats
    forces: Floats
    pull: Floats
    certificate: Certificate | None
    asked: float


@dataclass(frozen=True, eq=False)
class Place:
    """Where the mouse is.

    Args:
        shift: from where it took hold, (3,), metres.
        at: when, seconds of the monotonic clock.
    """

    shift: Floats
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
        self._weights = patch(twin, held, displacement)
        self._rest = self._weights @ twin.predict(forces).displacement
        body, modulus = twin.body, twin.config.material.young_modulus
        self._strongest = _STRONGEST * modulus * body.size**2
        self._farthest = _FARTHEST * farthest(twin)
        self._force: Floats = np.zeros(3)

    def to(self, place: Place) -> Prediction:
        """The prediction for a place of the mouse."""
        wanted = _within(place.shift, self._farthest)
        for _ in range(_STEPS):
            state = self._twin.predict(self._forces)
            missing = self._rest + wanted - self._weights @ state.displacement
            columns = np.kron(self._weights[:, None], np.eye(3))
            compliance = np.einsum("n,nij->ij", self._weights, state.push(columns).reshape(-1, 3, 3))
            step = np.linalg.lstsq(compliance, missing, rcond=1e-6)[0]
            self._force = _within(self._force + step, self._strongest)
        forces = self._forces
        state = self._twin.predict(forces)
        certificate = self._twin.certify(forces, state) if is_calibrated(self._twin) else None  # type: ignore[arg-type]
        return Prediction(state.displacement, forces, self._force, certificate, place.at)

    @property
    def _forces(self) -> Floats:
        return self._before + self._weights[:, None] * self._force


def patch(twin: Twin, held: Floats, displacement: Floats) -> Floats:
    """Shares of a force on the nodes about a place, (n,), that sum to one: of those alone that may carry load.

    Args:
        twin: with a network.
        held: the place, (3,), metres, on the moved organ.
        displacement: nodal, (n, 3), metres.
    """
    body, loaded = twin.body, twin.model.maps.loaded  # type: ignore[attr-defined]
    away = np.linalg.norm(body.points[loaded] + displacement[loaded] - held, axis=1)
    radius = max(_RADIUS * body.size, 1.5 * float(away.min()))
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
