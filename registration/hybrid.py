"""Two models behind one registration: a fast one finds where to begin, an exact one goes on from there to its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from numpy.typing import ArrayLike

from softtwin.reference.data.outcome import NotConverged

from .forward import ForwardModel
from .registrar import Registrar
from .residuals.term import ResidualTerm
from .result import Registration, badness
from .strategies.refinement import is_same_place
from .surface_distance import SurfaceDistance
from .verdict import Verdict


class HybridRegistrar:
    """Registers as the exact model does, from what the fast one finds for the same cloud.

    Each result is the exact model's, and `Registration.draft` is the fast one's. Where the fast model finds nothing
    that can be used, or the exact one no state there, the exact model begins at rest.

    Args:
        fast: of the fast model.
        exact: of the exact one: the same body, observed side and kind of unknowns.
    """

    def __init__(self, fast: Registrar, exact: Registrar) -> None:
        self.fast, self.exact = fast, exact

    @property
    def model(self) -> object:
        """The exact forward model."""
        return self.exact.model

    @property
    def observed(self) -> SurfaceDistance:
        """The observed side."""
        return self.exact.observed

    def with_fast(self, model: ForwardModel) -> HybridRegistrar:
        """The same with another fast model; see `Registrar.with_model`."""
        return HybridRegistrar(self.fast.with_model(model), self.exact)

    def limited(self, until: float) -> HybridRegistrar:
        """The same, which begins no step after a time of the monotonic clock, seconds; see `Registrar.limited`.

        Where the exact model has not ended by then, the better one of both results is given.
        """
        return HybridRegistrar(self.fast.limited(until), self.exact.limited(until))

    def with_terms(self, *terms: ResidualTerm) -> HybridRegistrar:
        """The same with other measurements that pull beside the cloud; see `Registrar.with_terms`."""
        return HybridRegistrar(self.fast.with_terms(*terms), self.exact.with_terms(*terms))

    def register(self, cloud: ArrayLike, start: Registration | None = None) -> Registration:
        """The forces, the state and the pose that bring the observed side to a cloud; see `Registrar.register`.

        Args:
            cloud: observed points, (p, 3), metres.
            start: an earlier frame's result; its draft is where the fast model starts.
        """
        return self._refined(cloud, start, lambda: self.fast.register(cloud, None if start is None else start.draft))

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """The next frame of a sequence, and from rest where that is not accepted; see `Registrar.follow`."""
        return self._refined(cloud, last, lambda: self.fast.follow(cloud, None if last is None else last.draft))

    def _refined(
        self, cloud: ArrayLike, last: Registration | None, drafted: Callable[[], Registration]
    ) -> Registration:
        begin = time.perf_counter()
        draft = drafted()
        draft = replace(draft, draft=draft)
        return replace(self._best(cloud, draft, last), seconds=time.perf_counter() - begin)

    def _best(self, cloud: ArrayLike, draft: Registration, last: Registration | None) -> Registration:
        """The exact model's result, from the frame before, the draft or rest; where time was over before, the best."""
        refined = None
        for start in [last, None] if is_same_place(last, draft) else [None]:
            if draft.judgement.is_usable and not self._is_late:
                with suppress(NotConverged):
                    again = self.exact.refine(cloud, draft, self.fast.model, start)
                    refined = again if refined is None else min(refined, again, key=badness)
            if refined is not None and refined.judgement.verdict is Verdict.ACCEPTED:
                return refined
        if not self._is_late:
            alone = replace(self.exact.register(cloud), draft=draft)
            return alone if refined is None else min(refined, alone, key=badness)
        return draft if refined is None else min(draft, refined, key=badness)

    @property
    def _is_late(self) -> bool:
        return time.monotonic() >= self.exact.options.solver.until
