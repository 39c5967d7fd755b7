"""What acts on a body: nodal forces, body force, traction, follower pressure, prescribed displacements; any mix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Loading:
    """A load; all parts add up and grow together in load steps: prescribed rotations by angles, all else in proportion.

    Args:
        forces: nodal forces, (n, 3), newtons.
        body_force: force per volume at rest, (3,), N/m^3; weight is density times gravity.
        traction: dead force per area at rest on named surfaces, (3,), pascals.
        pressure: pressure on named surfaces that follows them (pneumoperitoneum), pascals; positive pushes inward.
        displacement: prescribed displacement of named node sets, (3,) or (k, 3), metres; only the axes that the
            problem holds there are prescribed.

    Two components instead of three in the plane. The name `boundary` stands for the whole boundary.
    """

    forces: ArrayLike | None = None
    body_force: ArrayLike | None = None
    traction: Mapping[str, ArrayLike] = field(default_factory=dict)
    pressure: Mapping[str, float] = field(default_factory=dict)
    displacement: Mapping[str, ArrayLike] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("traction", "pressure", "displacement"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Names of the surfaces that carry a traction or a pressure, sorted."""
        return tuple(sorted({*self.traction, *self.pressure}))

    def scaled(self, factor: float) -> Loading:
        """The same load, `factor` times as strong, displacements too: no part of a rotation (`LoadPath` has those)."""

        def times(value: Any) -> Any:
            return factor * np.asarray(value, dtype=np.float64)

        return Loading(
            None if self.forces is None else times(self.forces),
            None if self.body_force is None else times(self.body_force),
            {name: times(value) for name, value in self.traction.items()},
            {name: factor * value for name, value in self.pressure.items()},
            {name: times(value) for name, value in self.displacement.items()},
        )


def checked_loading(load: Loading | ArrayLike, body: Body, held: Mapping[str, str]) -> Loading:
    """A load that fits a body: arrays in their full shapes.

    Args:
        load: the load, or nodal forces alone.
        body: the body.
        held: axes held at each named node set.

    Raises:
        ValueError: wrong shapes, numbers that are not finite, names that are not there.
    """
    given = load if isinstance(load, Loading) else Loading(forces=load)
    dimension, count = body.dimension, len(body.points)
    known = sorted({*body.surfaces, "boundary"})
    for surface in given.surfaces:
        if surface not in known:
            raise ValueError(f"Loading: expected a surface among {known}, got {surface!r}.")
    for name in given.displacement:
        if name not in held:
            raise ValueError(
                f"Loading.displacement: expected a node set that the problem holds, one of {sorted(held)}, "
                f"got {name!r}."
            )
    return Loading(
        None if given.forces is None else checked_array("Problem.forces", given.forces, (count, dimension)),
        None if given.body_force is None else checked_array("Loading.body_force", given.body_force, (dimension,)),
        {name: checked_array(f"Loading.traction[{name!r}]", t, (dimension,)) for name, t in given.traction.items()},
        {name: float(checked_array(f"Loading.pressure[{name!r}]", p, ())) for name, p in given.pressure.items()},
        {name: _checked_displacement(name, u, body) for name, u in given.displacement.items()},
    )


def _checked_displacement(name: str, displacement: ArrayLike, body: Body) -> Floats:
    values = np.asarray(displacement, dtype=np.float64)
    full = (len(body.node_sets[name]), body.dimension)
    if values.shape == full[1:]:
        values = np.broadcast_to(values, full)
    return checked_array(f"Loading.displacement[{name!r}]", values, full)


def checked_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Finite float64 values of one shape.

    Raises:
        ValueError: no real numbers (text, complex ones, rows of different lengths), another shape, NaN or infinity.
    """
    try:
        given = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name}: expected shape {shape}, got rows of different lengths.") from error
    if given.dtype.kind not in "biuf":
        raise ValueError(f"{name}: expected real numbers, got {given.dtype}.")
    array = given.astype(np.float64, copy=False)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity.")
    return array
