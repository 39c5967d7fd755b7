"""Two models behind one registration: a fast one finds where to begin, an exact one goes on from there to its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from numpy.typing import ArrayLike

from softtwin.reference.data.outcome import NotConverged

from .registrar import Registrar, Registration, badness
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

    def register(self, cloud: ArrayLike, start: Registration | None = None) -> Registration:
        """The forces, the state and the pose that bring the observed side to a cloud; see `Registrar.register`.

        Args:
            cloud: observed points, (p, 3), metres.
            start: an earlier frame's result; its draft is where the fast model starts.
        """
        return self._refined(cloud, lambda: self.fast.register(cloud, None if start is None else start.draft))

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """The next frame of a sequence, and from rest where that is not accepted; see `Registrar.follow`."""
        return self._refined(cloud, lambda: self.fast.follow(cloud, None if last is None else last.draft))

    def _refined(self, cloud: ArrayLike, drafted: Callable[[], Registration]) -> Registration:
        begin, found = time.perf_counter(), None
        draft = drafted()
        if draft.judgement.is_usable:
            with suppress(NotConverged):
                found = self.exact.refine(cloud, draft)
        if found is None or found.judgement.verdict is not Verdict.ACCEPTED:
            alone = replace(self.exact.register(cloud), draft=draft)
            found = alone if found is None else min(found, alone, key=badness)
        return replace(found, seconds=time.perf_counter() - begin)
