"""The way of a load from nothing to its whole, on which what is turned by prescribed displacements turns rigidly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..data.loading import Loading
from ..fem.forms import DiscreteLoad
from .rigid import RigidMotion, fitted, screwed
from .system import System

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_FAR_TURN = 0.2  # radians from rest: more, and a displacement that grows straight is far from what turns
_TURN = 0.02  # radians from a state that has turned already
_ROUNDING = 1e-12  # of the largest coordinate: nodes that are no farther from where a motion takes them go with it


@dataclass(frozen=True, eq=False)
class _Part:
    """Nodes that move together.

    Args:
        nodes: of no other part, (k,).
        motion: the rigid motion nearest to theirs, seen from the frame.
        rest: their displacements where that motion is taken back, (k, d), metres.
    """

    nodes: Ints
    motion: RigidMotion
    rest: Floats


class LoadPath:
    """Parts of a load, by a factor from 0 to 1: forces and pressures grow with it, what is turned goes by its screw.

    The displacements of each node set that is held in all axes are split into the rigid motion nearest to them, of
    whose screw the set goes that part, and a rest that grows with the factor. They are seen from a frame, which goes
    that part of its own screw: so sets that move alike stay as they lie to each other all the way. The frame moves
    with a set that tells a rotation: one at rest if there is one, else the first; or with all held nodes where none
    does. A set too small to tell one turns no more in the frame than it has to. What is held in some axes only tells no
    rotation: it goes straight, and the frame rests. A linear law knows no rotations: all goes straight.

    Args:
        system: body, law and what is held.
        given: the whole load, as `System.load` returns it.
        whole: the same as unknowns.
        since: displacement that held nodes have at the factor 0, (n, d), metres; none if not given.
    """

    def __init__(self, system: System, given: Loading, whole: DiscreteLoad, since: Floats | None = None) -> None:
        self._system, self._space, self._given, self.whole = system, system.space, given, whole
        self._points, self._sets = system.body.points, system.body.node_sets
        self._first, last = np.zeros_like(self._points), np.zeros_like(self._points)
        if since is not None:
            self._first[self._space.held] = since[self._space.held]
        for name, values in given.displacement.items():
            last[self._sets[name]] = values
        self._change = last - self._first
        self._start, self._end = self._points + self._first, self._points + last
        self._far = _FAR_TURN if since is None else _TURN
        self._noise = _ROUNDING * max(float(np.abs(self._start).max()), float(np.abs(self._end).max()))
        is_straight = system.material.is_linear or not self._change.any()
        self._frame, groups = self._frame_of([] if is_straight else self._groups(system))
        self._parts = [self._part(nodes) for nodes in groups]

    def _groups(self, system: System) -> list[Ints]:
        """Nodes of each set that is held in all axes; one of several sets is of the one that has the last word."""
        names = [*(name for name in system.held if name not in self._given.displacement), *self._given.displacement]
        owner = np.full(len(self._points), -1)
        for number, name in enumerate(names):
            if len(set(system.held[name])) == self._points.shape[1]:
                owner[self._sets[name]] = number
        groups = [np.flatnonzero(owner == number) for number in range(len(names))]
        return [nodes for nodes in groups if len(nodes)]

    def _frame_of(self, groups: list[Ints]) -> tuple[RigidMotion, list[Ints]]:
        """The motion of the frame on the whole path, and the groups that are seen from it."""
        held, none = self._space.held, RigidMotion.none(self._points.shape[1])
        if not groups or (held.any(axis=1) & ~held.all(axis=1)).any():
            return none, groups
        fits = [(nodes, *fitted(self._start[nodes], self._end[nodes])) for nodes in groups]
        told = [(nodes, motion) for nodes, motion, is_told in fits if is_told]
        if any(not self._change[nodes].any() for nodes, _ in told):
            return none, groups
        if told:
            return told[0][1], groups
        together = np.concatenate(groups)
        return fitted(self._start[together], self._end[together])[0], [together]

    def _part(self, nodes: Ints) -> _Part:
        points, seen = self._start[nodes], self._frame.back(self._end[nodes])
        motion = RigidMotion.none(points.shape[1])
        if np.abs(seen - points).max() > self._noise:
            motion, _ = fitted(points, seen)
        rest = motion.back(seen) - points
        return _Part(nodes, motion, rest if np.abs(rest).max() > self._noise else np.zeros_like(rest))

    def since(self, displacement: Floats) -> LoadPath:
        """The way to the same load for a body that has a displacement, (n, d), metres, already."""
        return LoadPath(self._system, self._given, self.whole, displacement)

    @property
    def turns(self) -> bool:
        """Whether the frame, or anything seen from it, turns far."""
        return self.screws is not None or bool(np.linalg.norm(self._frame.screw[0]) > self._far)

    # ------------------------------------------------------------------ parts of the load

    def load(self, factor: float) -> DiscreteLoad:
        """A part of the load as unknowns."""
        if factor == 1.0:
            return self.whole
        return replace(self.whole.scaled(factor), lift=self._lift(self._displacement(factor, self._frame.part(factor))))

    def loading(self, factor: float) -> Loading:
        """A part of the load in the body's numbers."""
        if factor == 1.0:
            return self._given
        field = self._displacement(factor, self._frame.part(factor))
        moved = {name: field[self._sets[name]] for name in self._given.displacement}
        return replace(self._given.scaled(factor), displacement=moved)

    def seen(self, factor: float) -> DiscreteLoad:
        """A part of the load as the frame sees it, by which the body does not turn with the frame."""
        if self._frame.is_none:
            return self.load(factor)
        dead, own = factor * self.whole.dead, self._space.own_numbers
        dead[own] = (dead[own].reshape(-1, self._points.shape[1]) @ self._frame.part(factor).rotation).ravel()
        lift = self._lift(self._displacement(factor, RigidMotion.none(self._points.shape[1])))
        return replace(self.whole.scaled(factor), dead=dead, lift=lift)

    def _displacement(self, factor: float, frame: RigidMotion) -> Floats:
        """Prescribed displacements of a part of the load, zero at free nodes, (n, d), metres."""
        field = self._first + factor * self._change
        for part in self._parts:
            now = part.motion.part(factor).of(self._start[part.nodes] + factor * part.rest)
            field[part.nodes] = frame.of(now) - self._points[part.nodes]
        return field

    def _lift(self, field: Floats) -> Floats:
        lift = np.zeros(self._space.owned)
        lift[self._space.fixed] = self._space.unknowns("Loading.displacement", field)[self._space.fixed]
        return lift

    @property
    def screws(self) -> tuple[Floats, Floats] | None:
        """Angles and velocities of the screws of held nodes as unknowns; None where nothing turns far in the frame."""
        screws = [(part.nodes, *part.motion.screw) for part in self._parts]
        if not any(np.linalg.norm(angle) > self._far for _, angle, _ in screws):
            return None
        dimension = self._points.shape[1]
        angles, velocities = np.zeros_like(self._points), np.zeros_like(self._points)
        for nodes, angle, velocity in screws:
            angles[nodes], velocities[nodes] = angle[-dimension:], velocity[:dimension]
        return self._lift(angles), self._lift(velocities)

    # ------------------------------------------------------------------ states

    def carried(self, unknowns: Floats, factor: float) -> Floats:
        """A state that the frame sees at a part of the load as it is in space, held unknowns where they should be."""
        out = unknowns.copy() if self._frame.is_none else self._turned(unknowns, self._frame.part(factor).of)
        fixed = self._space.fixed
        out[fixed] = self.load(factor).lift[fixed]
        return out

    def from_frame(self, unknowns: Floats, factor: float) -> Floats:
        """A state in space as the frame sees it at a part of the load."""
        return unknowns if self._frame.is_none else self._turned(unknowns, self._frame.part(factor).back)

    def screwed(self, unknowns: Floats, angles: Floats, velocities: Floats) -> Floats:
        """A state whose nodes go on by a screw each, as `screws` gives them."""
        space, dimension = self._space, self._points.shape[1]
        turns, moves = np.zeros((2, len(space.nodes), 3))
        turns[:, -dimension:] = angles[space.own_numbers].reshape(-1, dimension)
        moves[:, :dimension] = velocities[space.own_numbers].reshape(-1, dimension)

        def motion(points: Floats) -> Floats:
            in_space = np.pad(points, ((0, 0), (0, 3 - dimension)))
            return screwed(in_space, turns, moves)[:, :dimension]

        return self._turned(unknowns, motion)

    def _turned(self, unknowns: Floats, motion: Callable[[Floats], Floats]) -> Floats:
        out, points, own = unknowns.copy(), self._points[self._space.nodes], self._space.own_numbers
        out[own] = (motion(points + out[own].reshape(points.shape)) - points).ravel()
        return out
