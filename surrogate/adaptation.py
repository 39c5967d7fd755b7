"""A surrogate that learns while it is used: from exact states of what it is asked, and of what it may be asked next.

Each frame's exact state is a test before it is learned from (prequential: Dawid 1984), and every third is never learned
from. Bounds follow what the tests say by online quantile tracking (Gibbs and Candes 2021; Angelopoulos, Candes and
Tibshirani 2023), which holds the share wanted however the loads drift; an adaptation leaves them at least as wide as
the split conformal quantile of the frames that were kept back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.outcome import NotConverged

from .architecture import AdaptableArchitecture
from .calibration import needed, quantile
from .error_bound import ERRORS, ErrorEstimator
from .error_indicators import Error, elastic_of
from .exact_states import ExactStates
from .model import Surrogate
from .registry import ARCHITECTURES

Floats = NDArray[np.float64]
_DUE, _TELLING = 8, 4  # states since the last adaptation that make one worth while; states kept back before the first
_BETTER = 0.9  # of the error on what was kept back, or the surrogate stays as it is
_RATE = 0.3  # of the logarithm of a bound, by which a miss raises it beside what it missed by; nine hits undo that
_TINY = 1e-12  # metres: of a frame at rest nothing is wrong, and nothing was said
_LEAST_SPREAD = 1e-3  # of the largest, of a coordinate that is new


@dataclass(frozen=True)
class Observation:
    """What one frame's exact state says of the surrogate that had not seen it.

    Args:
        error: mean and largest nodal error, metres.
        bound: what had been said of them beforehand, metres; infinite where nothing was.
        is_kept_back: whether it will not be learned from.
    """

    error: dict[Error, float]
    bound: dict[Error, float]
    is_kept_back: bool


class OnlineLearner:
    """Adapts one surrogate to exact states, again and again, beside what it was built to know.

    Args:
        surrogate: as it was built.
        seconds: that an adaptation by training takes.
        seed: of the states that are looked at ahead.

    Raises:
        ValueError: an architecture that does not learn while it is used.
        CalibrationError: a card that names no material.
    """

    def __init__(self, surrogate: Surrogate, seconds: float = 4.0, seed: int = 0) -> None:
        self.check(surrogate)
        kind = ARCHITECTURES[surrogate.card["architecture"]]
        self._kind, self._seconds = cast("type[AdaptableArchitecture]", kind), seconds
        self.built = self.current = surrogate
        self._exact = ExactStates(surrogate, seed)
        self._estimator = ErrorEstimator(surrogate) if surrogate.card.get("certificate") else None
        self._known = self._rehearsal()
        self._since, self.frames, self.explored, self.adaptations = 0, 0, 0, 0

    @staticmethod
    def check(surrogate: Surrogate) -> None:
        """Refuse what cannot learn while it is used.

        Raises:
            ValueError, CalibrationError: as above.
        """
        kind = ARCHITECTURES[surrogate.card["architecture"]]
        if not hasattr(kind, "adapted"):
            able = sorted(name for name, each in ARCHITECTURES.items() if hasattr(each, "adapted"))
            raise ValueError(
                f"OnlineLearner.surrogate: expected an architecture that learns while it is used ({', '.join(able)}), "
                f"got {kind.name}."
            )
        if surrogate.card.get("plan", {}).get("vary"):
            raise ValueError("OnlineLearner.surrogate: expected a surrogate of one tissue, got one that takes several.")
        elastic_of(surrogate)

    # ------------------------------------------------------------------ what comes

    def observe(self, forces: ArrayLike, displacement: ArrayLike | None = None, learn: bool = True) -> Observation:
        """A frame's load with its exact state: a test of the surrogate, then learned from unless it is kept back.

        Args:
            forces: nodal forces, (n, 3), newtons.
            displacement: the exact state, (n, 3), metres; solved for if not given.
            learn: keep it; a test alone takes a tenth of the time.

        Raises:
            ValueError: another shape, numbers that are not finite, forces on nodes that the surrogate never saw loaded,
                or no state of this body under this load.
            NotConverged: no state was found, or none that is stable.
        """
        state = self._exact.frame(forces, displacement, self.current)
        error, bound = self._tested(state.load, state.displacement)
        self.frames += 1
        self._since += learn
        return Observation(error, bound, learn and self._exact.keep(state))

    def explore(self) -> bool:
        """Solve for a state that the loads may come to, and learn from it; False where there was none."""
        is_found = self._exact.explore(self.current)
        self.explored += is_found
        self._since += is_found
        return is_found

    @property
    def is_due(self) -> bool:
        """Whether enough has come since the last adaptation to make another one."""
        return self._since >= _DUE and len(self._exact.kept_back) >= _TELLING

    def adapt(self) -> Surrogate | None:
        """A surrogate that has learned from what has come; None where it does no better on what was kept back."""
        self._since = 0
        if not self._exact.kept_back:
            return None
        before = self._error(self.current)
        found = Surrogate(
            self.built.body,
            *self._kind.adapted(
                self.built.encoder_decoder, self.current.network, self._exact.samples(self._known, self._seconds)
            ),
            self.built.card,
        )
        after = self._error(found)
        if not after < _BETTER * before:
            return None
        found = self._with_domain(found).with_card(
            adaptation={
                "frames": self.frames,
                "kept_back": len(self._exact.frames.kept_back),
                "explored": self.explored,
                "relative_error_before": before,
                "relative_error_after": after,
            }
        )
        self.current = self._recalibrated(found)
        self.adaptations += 1
        return self.current

    def _tested(self, load: Floats, displacement: Floats) -> tuple[dict[Error, float], dict[Error, float]]:
        state = self.current.solve(load)
        apart = nodal_distances(state.displacement[None], displacement[None])[0]
        error: dict[Error, float] = {"mean": float(apart.mean()), "largest": float(apart.max())}
        bound: dict[Error, float] = dict.fromkeys(ERRORS, float("inf"))
        if self._estimator is not None:
            said = self._estimator.bound_error(load, state)
            bound = {"mean": said.mean, "largest": said.largest}
            self._estimator = self._estimator.scaled(
                {name: _raised(error[name], bound[name], said.confidence) for name in ERRORS}
            )
            self.current = self.current.with_card(certificate=self._estimator.known)
        return error, bound

    def _error(self, surrogate: Surrogate) -> float:
        """Of what was kept back, relative to it; infinite where the surrogate finds no state."""
        missed = size = 0.0
        for each in self._exact.kept_back:
            try:
                missed += float(np.linalg.norm(surrogate.solve(each.forces).displacement - each.displacement))
            except NotConverged:
                return float("inf")
            size += float(np.linalg.norm(each.displacement))
        return missed / max(size, 1e-300)

    def _rehearsal(self) -> tuple[Floats, Floats]:
        """Loads like those of the training, (r, 3l), and what the surrogate as it was built makes of them, (r, 3n)."""
        modes, rng = self.built.encoder_decoder.load_modes, np.random.default_rng(0)
        loads, fields = [], []
        for _ in range(0 if modes is None else self._kind.rehearsed):
            assert modes is not None
            load = np.zeros(self.built.body.points.size)
            load[self.built.rows] = modes @ rng.standard_normal(modes.shape[1])
            try:
                state = self.built.solve(load.reshape(-1, 3))
            except NotConverged:
                continue
            loads.append(load[self.built.rows])
            fields.append(state.displacement.ravel())
        size = self.built.body.points.size
        return np.reshape(loads, (-1, len(self.built.rows))), np.reshape(fields, (-1, size))

    # ------------------------------------------------------------------ what is said of the surrogate

    def _with_domain(self, surrogate: Surrogate) -> Surrogate:
        """With the loads that were learned among those that it knows."""
        domain, spread = surrogate.card.get("domain"), self.built.encoder_decoder.spread
        if domain is None or "reach" not in domain or spread is None:
            return surrogate
        states = list(self._exact)
        encoded = surrogate.encoder_decoder.encoded(
            np.stack([each.forces.ravel()[surrogate.rows] for each in states], axis=1)
        )
        wide = np.concatenate([spread, np.sqrt((encoded[len(spread) :] ** 2).mean(axis=1))])  # new ones come last
        wide = np.maximum(wide, _LEAST_SPREAD * wide.max())
        reach = np.sqrt(((encoded / wide[:, None]) ** 2).mean(axis=0)).max()
        moved = max(float(np.linalg.norm(each.displacement, axis=1).max()) for each in states)
        entry = {
            **domain,
            "reach": max(float(reach), domain["reach"]),
            "displacement_m": max(moved, domain["displacement_m"]),
        }
        encoder_decoder = replace(surrogate.encoder_decoder, spread=wide)
        return Surrogate(surrogate.body, encoder_decoder, surrogate.network, {**surrogate.card, "domain": entry})

    def _recalibrated(self, surrogate: Surrogate) -> Surrogate:
        """With bounds that hold on what was kept back, where that is enough to say so, and that are as wide as before.

        Frames that are kept back lie between those that were learned, and frames to come do not; states ahead that are
        kept back lie farther out. Both may widen bounds, and only tests narrow them. The indicators tell by themselves
        that predictions are better in balance now.
        """
        if self._estimator is None:
            return surrogate
        estimator = self._estimator.of(surrogate)
        shown, missed = [], []
        for each in self._exact.kept_back:
            state = surrogate.solve(each.forces)
            shown.append(estimator.reader.read(each.forces, state))
            missed.append(nodal_distances(state.displacement[None], each.displacement[None])[0])
        estimator = estimator.within(shown)
        confidence = estimator.known["confidence"]
        if len(shown) >= needed(confidence):
            factors = {}
            for name in ERRORS:
                errors = np.array([apart.mean() if name == "mean" else apart.max() for apart in missed])
                said = np.array([getattr(estimator.read(indicators), name) for indicators in shown])
                factors[name] = max(1.0, quantile(errors / np.maximum(said, _TINY), confidence) or 1.0)
            estimator = estimator.scaled(factors)
        self._estimator = estimator
        return surrogate.with_card(certificate=estimator.known)


def _raised(error: float, bound: float, confidence: float) -> float:
    """What a bound is multiplied with after a test of it: by what it missed an error by at once, as loads drift."""
    missed = error / bound if error > bound > 0.0 else 1.0
    return missed * float(np.exp(_RATE * (float(error > bound) - (1.0 - confidence))))
