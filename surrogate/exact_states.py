"""Exact states of what a surrogate is asked while it is used, and of what it may be asked next."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from softtwin.reference.data.loading import checked_array
from softtwin.reference.data.outcome import NotConverged

from .architecture import NewSamples
from .equilibria import Equilibria, NewtonSettings
from .equilibria_model import EquilibriaModel, EquilibriaState
from .error_indicators import elastic_of
from .model import Surrogate

Floats = NDArray[np.float64]
_KEPT_BACK = 3  # one state in so many is never learned from
_NEWEST, _COMPARED = 48, 24  # states that are learned from; those kept back that adaptations are compared by
_WAY = 64  # frames whose loads say where the next may lie
_WIDER, _FARTHER = 4.0, 1.5  # in each direction than these loads lie; than the farthest of them in any
_DIRECTIONS, _LEAST_EXTENT = 4, 0.03  # of the loads, at most; of the farthest, at least
_PUSH = 0.1  # of the farthest load: a small change, for which the first order does
_OTHERS = 48  # changes by loads of the training's kind
_BESIDE = 1.5  # of what the directions leave of the loads
_TOLERANCE = 1e-7  # of Newton's method, relative to the load
_BALANCED = 1e-2  # forces out of balance, relative to the load, of what is no state of this body


@dataclass(frozen=True, eq=False)
class ExactState:
    """An equilibrium, and what small changes of its load change.

    Args:
        forces: nodal forces, (n, 3), newtons.
        displacement: (n, 3), metres.
        pushes: changes of the forces, (k, 3n), newtons.
        changes: of the displacement by each, (k, 3n), metres.
    """

    forces: Floats
    displacement: Floats
    pushes: Floats
    changes: Floats


class Collected:
    """The newest exact states, of which every third is kept back."""

    def __init__(self) -> None:
        self.learned: deque[ExactState] = deque(maxlen=_NEWEST)
        self.kept_back: deque[ExactState] = deque(maxlen=_COMPARED)
        self._count = 0

    def take(self, state: EquilibriaState, changes: Callable[[EquilibriaState], tuple[Floats, Floats]]) -> bool:
        """Whether the state is kept back; its first-order changes are looked for if it is not."""
        self._count += 1
        is_kept_back = self._count % _KEPT_BACK == 0
        nothing = np.zeros((0, state.displacement.size))
        pair = (nothing, nothing) if is_kept_back else changes(state)
        (self.kept_back if is_kept_back else self.learned).append(ExactState(state.load, state.displacement, *pair))
        return is_kept_back


class ExactStates:
    """What has been solved for, and how the next is.

    Loads to come are looked for in the directions of the newest loads, told apart by the displacements that they cause:
    in each a few times as far as these lie, and in none much farther than the farthest of them.

    Args:
        surrogate: names body, material and springs.
        seed: of the loads that are looked at ahead.

    Raises:
        CalibrationError: a card that names no material.
    """

    def __init__(self, surrogate: Surrogate, seed: int = 0) -> None:
        self._surrogate, self.elastic = surrogate, elastic_of(surrogate)
        settings = NewtonSettings(tolerance=_TOLERANCE)
        self._solver = Equilibria(
            surrogate.body, self.elastic.material, settings=settings, springs=surrogate.learned_springs
        )
        self._patient, self._hasty = EquilibriaModel(self._solver), EquilibriaModel(self._solver, patient=False)
        self._rng = np.random.default_rng(seed)
        self._way: deque[Floats] = deque(maxlen=_WAY)
        self.frames, self.ahead = Collected(), Collected()

    def __iter__(self) -> Iterator[ExactState]:
        """Those that are learned from."""
        yield from self.ahead.learned
        yield from self.frames.learned

    @property
    def kept_back(self) -> Sequence[ExactState]:
        """States that are not learned from."""
        return [*self.frames.kept_back, *self.ahead.kept_back]

    def samples(self, known: tuple[Floats, Floats], seconds: float) -> NewSamples:
        """What there is to learn.

        Args:
            known: loads, (r, 3l), and displacements, (r, 3n), of what is known.
            seconds: that it may take.
        """
        states, rows = list(self), self._surrogate.rows
        return NewSamples(
            self.elastic,
            np.stack([each.forces.ravel()[rows] for each in states]),
            np.stack([each.displacement.ravel() for each in states]),
            [each.pushes[:, rows] for each in states],
            [each.changes for each in states],
            *known,
            seconds,
        )

    # ------------------------------------------------------------------ frames

    def frame(self, forces: ArrayLike, displacement: ArrayLike | None, guess: Surrogate) -> EquilibriaState:
        """The exact state of a frame's load.

        Args:
            forces: nodal forces, (n, 3), newtons.
            displacement: the exact state, (n, 3), metres; solved for if not given.
            guess: where to look for it.

        Raises:
            ValueError: another shape, numbers that are not finite, or no state of this body under this load.
            NotConverged: no state was found, or none that is stable.
        """
        load = checked_array("OnlineLearner.forces", forces, self._surrogate.body.points.shape).copy()
        if displacement is None:
            return self._solved(self._patient, load, guess)
        given = checked_array("OnlineLearner.displacement", displacement, load.shape).copy()
        self._check_balance(load, given)
        return EquilibriaState(self._patient, self._solver, load, load, given)

    def keep(self, state: EquilibriaState) -> bool:
        """Collect a frame's state; whether it is kept back."""
        self._way.append(state.load)
        return self.frames.take(state, self._changes)

    def _check_balance(self, load: Floats, displacement: Floats) -> None:
        free = np.setdiff1d(np.arange(len(load)), self._surrogate.body.fixed)
        inner = self.elastic.internal_forces(torch.from_numpy(displacement[None]))[0].numpy()
        missing, size = float(np.linalg.norm((inner - load)[free])), float(np.linalg.norm(load[free]))
        if not missing <= _BALANCED * size:
            raise ValueError(
                "OnlineLearner.displacement: expected an equilibrium of the surrogate's body and material, got forces "
                f"of {missing / max(size, 1e-300):.2g} times the load out of balance; is it of another organ?"
            )

    # ------------------------------------------------------------------ ahead

    def explore(self, guess: Surrogate) -> bool:
        """Solve for a state that the loads may come to, and collect it; False where there was none.

        Args:
            guess: where to look for it.
        """
        if not self._way:
            return False
        axes = self._axes
        if len(axes.extents) == 0:
            return False
        place = self._rng.standard_normal(len(axes.extents))
        place *= float(self._rng.uniform()) ** (1.0 / len(place)) / float(np.linalg.norm(place))
        reach = np.minimum(_WIDER * axes.extents, _FARTHER * axes.extents.max())
        load = np.einsum("k,kni->ni", place * reach, axes.directions)
        shares = _BESIDE / np.sqrt(len(axes.rest)) * self._rng.standard_normal(len(axes.rest))
        load += np.einsum("w,wni->ni", shares, axes.rest)
        try:
            found = self._solved(self._hasty, load, guess)
        except NotConverged:
            return False
        self.ahead.take(found, self._changes)
        return True

    @property
    def _axes(self) -> _Axes:
        loads, response = np.stack(self._way), self._surrogate.encoder_decoder.linear
        fields = response(loads.reshape(len(loads), -1)[:, self._surrogate.rows].T)
        squares, turned = np.linalg.eigh(fields.T @ fields)
        values, turned = np.sqrt(np.maximum(squares[::-1], 0.0)), turned[:, ::-1]
        extents = values * np.abs(turned).max(axis=0)
        kept = np.flatnonzero(extents > _LEAST_EXTENT * extents.max())[:_DIRECTIONS]
        directions = np.einsum("wk,wni->kni", turned[:, kept] / values[kept], loads)
        return _Axes(
            directions, extents[kept], loads - np.einsum("wk,kni->wni", turned[:, kept] * values[kept], directions)
        )

    def _others(self, count: int) -> Floats:
        """Loads of the training's kind, (count, n, 3), whose linear responses have norm one."""
        maps, found = self._surrogate.encoder_decoder, np.zeros((count, self._surrogate.body.points.size))
        if maps.load_modes is None:
            return found.reshape(count, -1, 3)
        loads = maps.load_modes @ self._rng.standard_normal((maps.load_modes.shape[1], count))
        found[:, self._surrogate.rows] = (loads / np.linalg.norm(maps.linear(loads), axis=0)).T
        return found.reshape(count, -1, 3)

    # ------------------------------------------------------------------ states

    def _solved(self, model: EquilibriaModel, load: Floats, guess: Surrogate) -> EquilibriaState:
        """From what the surrogate says, or from the nearest state that is known, whichever is lower in energy."""
        starts = []
        with suppress(NotConverged):
            starts.append(guess.solve(load).displacement)
        near = min(self, key=lambda each: float(np.linalg.norm(each.forces - load)), default=None)
        if near is not None:
            shares = np.linalg.lstsq(near.pushes.T, (load - near.forces).ravel(), rcond=1e-6)[0]
            starts.append(near.displacement + (shares @ near.changes).reshape(-1, 3))
        start = None
        if starts:
            stored = self.elastic.energy_and_forces(torch.from_numpy(np.stack(starts)))[0].numpy()
            energies = stored - np.einsum("sni,ni->s", np.stack(starts), load)
            start = _Start(starts[int(np.argmin(np.where(np.isfinite(energies), energies, np.inf)))])
        state = model.solve(load, start)
        if state.negative_pivots != 0:
            raise NotConverged("OnlineLearner: the state that was found is not stable; nothing is learned from it.")
        return state

    def _changes(self, state: EquilibriaState) -> tuple[Floats, Floats]:
        axes = self._axes
        every = np.concatenate([axes.directions, self._others(_OTHERS)])
        pushes = _PUSH * axes.extents.max(initial=0.0) * every.reshape(len(every), -1)
        return pushes, state.jvp(pushes.T).T


@dataclass(frozen=True, eq=False)
class _Axes:
    """Principal axes of the newest loads, told apart by the displacements that they cause.

    Args:
        directions: loads whose linear responses have norm one, (k, n, 3).
        extents: the largest coordinate of the newest loads along each, (k,).
        rest: what these loads have beside, (w, n, 3).
    """

    directions: Floats
    extents: Floats
    rest: Floats


@dataclass(frozen=True, eq=False)
class _Start:
    displacement: Floats
