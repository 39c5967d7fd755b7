"""Samplers of nodal forces: modal loads on surface patches, and the brute-force random loads they are compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer, outer_nodes

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class LoadPlan:
    """How loads are drawn.

    Args:
        kind: `modal` for b = mask * (Phi q) (Odot 2023, eq. 4.5), `random` for an independent force at every node.
        modes: modes that make the loads, q in [-1, 1]^modes.
        zones: names of node sets that may carry force; one is drawn for each patch. Empty: the whole free boundary.
        patches: most patches that act at once; 1..patches are drawn.
        radius: smallest and largest radius of a patch, relative to the size of its zone.
        displacement: largest nodal displacement wanted, metres: the top of the range that the loads are scaled to.
        amplitude: force that multiplies a load, newtons; given, it replaces the scaling to a displacement.
        sequence: `random`, or `sobol` for training draws that fill the space of modal loads more evenly (a scrambled
            Sobol sequence; Owen 1998); what is held out stays random.
        smoothness: correlation length of the smooth draws, metres, where there are any: see `draw_smooth_load`.
    """

    kind: Literal["modal", "random"] = "modal"
    modes: int = 10
    zones: tuple[str, ...] = ()
    patches: int = 1
    radius: tuple[float, float] = (0.06, 0.65)
    displacement: float = 0.05
    amplitude: float | None = None
    sequence: Literal["random", "sobol"] = "random"
    smoothness: float = 0.02

    def __post_init__(self) -> None:
        if self.kind not in ("modal", "random"):
            raise ValueError(f"LoadPlan.kind: expected 'modal' or 'random', got {self.kind!r}.")
        if self.sequence not in ("random", "sobol"):
            raise ValueError(f"LoadPlan.sequence: expected 'random' or 'sobol', got {self.sequence!r}.")
        if self.sequence == "sobol" and self.kind != "modal":
            raise ValueError("LoadPlan.sequence: expected 'random' for loads that are independent at each node.")
        if self.modes < 1 or self.patches < 1:
            raise ValueError(f"LoadPlan: expected at least one mode and one patch, got {self.modes}, {self.patches}.")
        if not 0.0 < self.radius[0] <= self.radius[1]:
            raise ValueError(f"LoadPlan.radius: expected 0 < smallest <= largest, got {self.radius}.")
        if not 0.0 < self.smoothness < np.inf:
            raise ValueError(f"LoadPlan.smoothness: expected a positive length in metres, got {self.smoothness}.")
        if not self.displacement > 0.0:
            raise ValueError(f"LoadPlan.displacement: expected a positive length in metres, got {self.displacement}.")


class Chance(Protocol):
    """Where draws come from: numpy's generator, or a point of a sequence."""

    def integers(self, low: int, high: int | None = None) -> Any:
        """A whole number from low (or 0) to below high (or low)."""

    def uniform(self, low: float, high: float, size: Any = None) -> Any:
        """Numbers from low to high."""


class QuasiRandom:
    """One point of a sequence in [0, 1)^d in a generator's place: each call takes its next coordinates.

    Args:
        point: its coordinates, (d,).
    """

    def __init__(self, point: Floats) -> None:
        self._rest = iter(point.tolist())

    def integers(self, low: int, high: int | None = None) -> int:
        """A whole number from low (or 0) to below high (or low)."""
        first, end = (0, low) if high is None else (low, high)
        return first + int((end - first) * next(self._rest))

    def uniform(self, low: float, high: float, size: int | None = None) -> Any:
        """Numbers from low to high."""
        if size is None:
            return low + (high - low) * next(self._rest)
        return np.array([low + (high - low) * next(self._rest) for _ in range(size)])


def sobol_point(plan: LoadPlan, more: int, number: int, seed: int) -> Floats:
    """A point of the scrambled Sobol sequence that a load is drawn from, and so many further coordinates behind it.

    Args:
        plan: how loads are drawn.
        more: coordinates at the end that no load takes.
        number: of the point, from 0.
        seed: of the scrambling.
    """
    size = 1 + plan.patches * (3 + plan.modes) + more
    from scipy.stats import qmc  # half a second, which only who draws it waits for

    sequence = qmc.Sobol(size, seed=seed)
    point: Floats = sequence.fast_forward(number).random(1)[0] if number else sequence.random(1)[0]
    return point


def check_loads(body: Body, plan: LoadPlan) -> None:
    """Refuse a plan that a body cannot carry, before anything is solved.

    Args:
        body: the body.
        plan: how loads are to be drawn.

    Raises:
        ValueError: nothing to load, too many modes, or a displacement beyond the size of the body.
    """
    loaded_nodes(body, plan)
    for name in plan.zones:
        loaded_nodes(body, replace(plan, zones=(name,)))
    most = 3 * len(body.free) // 2 - 1
    if plan.modes > most:
        raise ValueError(f"LoadPlan.modes: expected 1..{most} for {len(body.free)} free nodes, got {plan.modes}.")
    size = float(np.linalg.norm(np.ptp(body.points, axis=0)))
    if plan.amplitude is None and plan.displacement > size:
        raise ValueError(
            f"LoadPlan.displacement: expected at most the size of the body, {size:.3g} m, got {plan.displacement:.6g}."
        )


def loaded_nodes(body: Body, plan: LoadPlan) -> Ints:
    """Numbers of the nodes that may carry force, sorted: the free nodes of the zones that move the organ's surface.

    Raises:
        ValueError: a zone that the body lacks, or no free node on the boundary or in the zones.
    """
    allowed = np.setdiff1d(outer_nodes(body), body.fixed)
    if len(allowed) == 0:
        raise ValueError(
            f"Body.fixed: expected free nodes on the boundary, got all {len(outer_nodes(body))} of them fixed; "
            "nothing is left that a load could act on."
        )
    if not plan.zones:
        return allowed
    missing = [name for name in plan.zones if name not in body.node_sets]
    if missing:
        raise ValueError(f"LoadPlan.zones: expected names among {sorted(body.node_sets)}, got {missing}.")
    zones = np.unique(np.concatenate([body.node_sets[name] for name in plan.zones]))
    nodes = np.intersect1d(zones, allowed)
    if len(outer(body).vertices_of(nodes)) == 0:
        raise ValueError(f"LoadPlan.zones: none of the {len(zones)} nodes of {plan.zones} is on the free boundary.")
    return nodes


def draw_load(body: Body, shapes: Floats, plan: LoadPlan, rng: Chance) -> Floats:
    """One unscaled load, (n, 3): the sum of modal (or random) forces on one to `plan.patches` patches.

    Args:
        body: the body.
        shapes: mode shapes, (k, n, 3).
        plan: how loads are drawn.
        rng: source of chance; the load is a function of it alone.
    """
    surface = outer(body)
    forces = np.zeros_like(surface.rest.points)
    for _ in range(rng.integers(1, plan.patches + 1)):
        patch = _draw_patch(body, plan, rng)
        if plan.kind == "modal":
            q = rng.uniform(-1.0, 1.0, plan.modes)
            shape = np.einsum("k,kni->ni", q, shapes[: plan.modes])
            forces[patch] += surface.carried(shape)[patch]
        else:
            forces[patch] += rng.uniform(-1.0, 1.0, (len(patch), 3))
    return _at_nodes(body, forces, plan)


def draw_smooth_load(body: Body, plan: LoadPlan, rng: np.random.Generator) -> Floats:
    """One unscaled load of smooth forces: a Gaussian field on a patch, (n, 3).

    The forces of two places at distance d correlate by exp(-d^2 / 2 s^2) with s the plan's smoothness; components are
    independent. These loads are rougher than modal ones: what a model gets wrong under them, modal loads do not show.
    Registration expects rougher ones still: those of a patch with an edge.

    Args:
        body: the body.
        plan: how loads are drawn: zones, radius and smoothness.
        rng: source of chance; the load is a function of it alone.
    """
    places = outer(body).rest.points
    forces = np.zeros_like(places)
    patch = _draw_patch(body, plan, rng)
    apart = ((places[patch][:, None] - places[patch]) ** 2).sum(axis=2)
    variances, fields = np.linalg.eigh(np.exp(-apart / (2.0 * plan.smoothness**2)))
    root = fields * np.sqrt(np.maximum(variances, 0.0))
    forces[patch] = root @ rng.standard_normal((len(patch), 3))
    return _at_nodes(body, forces, plan)


def _at_nodes(body: Body, forces: Floats, plan: LoadPlan) -> Floats:
    """Forces at the nodes, (n, 3), from those at the vertices of the organ's surface."""
    surface = outer(body)
    if surface.weights is not None:
        forces = surface.spread(forces)
        forces[np.setdiff1d(np.arange(len(forces)), loaded_nodes(body, plan))] = 0.0
    return forces


def _draw_patch(body: Body, plan: LoadPlan, rng: Chance) -> Ints:
    """Vertices of a zone in a ball of random centre and radius; never empty, for the centre is one of them."""
    zone = loaded_nodes(body, plan)
    if plan.zones:
        zone = np.intersect1d(body.node_sets[plan.zones[rng.integers(len(plan.zones))]], zone)
    zone = outer(body).vertices_of(zone)
    positions = outer(body).rest.points[zone]
    centre = positions[rng.integers(len(zone))]
    radius = rng.uniform(*plan.radius) * float(np.linalg.norm(np.ptp(positions, axis=0)))
    return zone[np.linalg.norm(positions - centre, axis=1) <= radius]
