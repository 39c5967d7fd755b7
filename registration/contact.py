"""One contact of unknown place: where a force acts is looked for among all nodes, then taken for a single patch."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .parameters.contact import Contact
from .parameters.inputs import InputBlocks
from .parameters.nodal_forces import known_forces
from .policy import POLICY
from .registrar import Registrar
from .result import Registration
from .verdict import Check, Code, Verdict

Floats = NDArray[np.float64]
_REACH = 0.1  # body sizes that the place may be off where forces anywhere have put it


@dataclass(frozen=True)
class Patch:
    """What is known of the one contact.

    Args:
        radius: metres.
        force: standard deviation of each component of the force, newtons; that found by forces anywhere if not given.
    """

    radius: float = 0.01
    force: float | None = None


class ContactRegistrar:
    """Registers clouds with forces at any of the nodes, then with a single contact near where it has found them.

    The result's `draft` is the one with forces anywhere. Where one contact leaves the cloud much further from the
    surface, it is doubtful.

    Args:
        anywhere: with forces at all nodes that may be touched.
        patch: what is known of the contact.
    """

    def __init__(self, anywhere: Registrar, patch: Patch | None = None) -> None:
        self.anywhere, self.patch = anywhere, patch or Patch()

    @property
    def model(self) -> object:
        """The forward model."""
        return self.anywhere.model

    def limited(self, until: float) -> ContactRegistrar:
        """The same, which begins no step after a time of the monotonic clock; see `Registrar.limited`."""
        return ContactRegistrar(self.anywhere.limited(until), self.patch)

    def register(self, cloud: ArrayLike, start: Registration | None = None) -> Registration:
        """The contact and the state that bring the observed side to a cloud; see `Registrar.register`.

        Args:
            cloud: observed points, (p, 3), metres.
            start: an earlier frame's result.
        """
        return self._single(cloud, lambda: self.anywhere.register(cloud, None if start is None else start.draft))

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """The next frame of a sequence; see `Registrar.follow`."""
        return self._single(cloud, lambda: self.anywhere.follow(cloud, None if last is None else last.draft))

    def _single(self, cloud: ArrayLike, drafted: Callable[[], Registration]) -> Registration:
        begin = time.perf_counter()
        draft = drafted()
        draft = replace(draft, draft=draft)
        if not draft.judgement.is_usable:
            return replace(draft, seconds=time.perf_counter() - begin)
        found = self._registrar(draft).register(cloud)
        minimum = max(draft.scatter, self.anywhere.setup.noise.minimum)
        is_worse = found.scatter > minimum / POLICY.elsewhere
        reason = (
            f"one contact does not explain the cloud: points lie {1e3 * found.scatter:.2f} mm from the surface, "
            f"with forces anywhere {1e3 * draft.scatter:.2f} mm"
        )
        found = found.with_check(
            Check(
                Code.CONTACT,
                Verdict.DOUBTFUL if is_worse else Verdict.ACCEPTED,
                found.scatter / minimum,
                1.0 / POLICY.elsewhere,
                "times the distances with forces anywhere",
                reason=reason if is_worse else "",
            )
        )
        return replace(found, draft=draft, seconds=time.perf_counter() - begin)

    def _registrar(self, draft: Registration) -> Registrar:
        body, anywhere = self.anywhere.model.body, self.anywhere
        nodes = anywhere.forces.nodes
        sizes = np.linalg.norm(draft.forces[nodes], axis=1)
        middle = sizes**2 @ body.points[nodes] / max(float(sizes @ sizes), 1e-300)
        size = self.patch.force or max(float(np.linalg.norm(draft.net_force)), 1e-12)
        contact = Contact(nodes, middle, _REACH * body.size, self.patch.radius, size)
        # What neighbours are missed by alike is for forces anywhere to tell: here it could hide a second contact.
        localisation = replace(anywhere.options.localisation, rounds=0)
        options = replace(anywhere.options, localisation=localisation, correlated=draft.shared_noise is not None)
        return Registrar(
            anywhere.model,
            anywhere.observed,
            known_forces(body, anywhere.forces.scale),
            options,
            pose=anywhere.pose,
            expectations=anywhere.setup.expectations,
            inputs=InputBlocks(body, {}, (contact,)),
            blocks=anywhere.setup.blocks,
            modulus_deviation=anywhere.modulus_deviation,
        )
