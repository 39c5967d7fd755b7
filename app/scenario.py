"""Parameters to estimate beside the forces of a twin, and known loads that act on it, from the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer
from softtwin.meshes.export import Coordinates
from softtwin.meshes.metrics import nodal_volumes
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.springs import Support
from softtwin.registration.contact import Patch
from softtwin.registration.parameters.block import ParameterBlock
from softtwin.registration.parameters.gravity import Gravity
from softtwin.registration.parameters.input_block import InputBlock
from softtwin.registration.parameters.inputs import InputBlocks
from softtwin.registration.parameters.weight import Weight
from softtwin.registration.surface_distance import SurfaceDistance

from .config import Config
from .parameters import NamedParameter, ParameterError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """What is unknown beside the forces of a twin, and what is known to act along.

    Args:
        parameters: to estimate beside the forces.
        forces: file of known nodal forces, .npy (n, 3), newtons, on the axes of the twin's files; None for none.
        gravity: on the axes of the twin's files, (3,), m/s^2.
        pressure: on the whole boundary, pascals.
        density: kg/m^3.
        scan_gravity: gravity under which the files show the organ, on their axes, (3,), m/s^2.
        springs: that hold named surfaces.
        floats: what surrounds the organ carries its weight by a pressure that grows with depth; the pressure that is
            unknown is beside it.
    """

    parameters: tuple[NamedParameter, ...]
    forces: Path | None
    gravity: tuple[float, float, float]
    pressure: float
    density: float
    scan_gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    springs: Mapping[str, Support] = field(default_factory=dict)
    floats: bool = False

    @classmethod
    def of(cls, config: Config) -> Scenario:
        """What a configuration says."""
        section = config.registration
        return cls(
            tuple(map(NamedParameter.parse, section.parameters)),
            Path(section.known_forces) if section.known_forces else None,
            section.gravity,
            section.pressure,
            config.material.density,
            section.scan_gravity,
            config.supports,
            section.forces == "normal",
        )

    @property
    def patch(self) -> Patch | None:
        """The one contact of unknown place; None where forces act anywhere."""
        contacts = [named for named in self.parameters if named.kind == "contact"]
        if not contacts:
            return None
        return Patch() if contacts[0].number is None else Patch(contacts[0].number)

    def modulus(self, modulus: float, body: Body) -> float | Floats:
        """Young's modulus as the material needs it: one for each cell where that of a region is unknown, pascals."""
        by_region = any(named.kind == "young-modulus" and named.place for named in self.parameters)
        return np.full(len(body.cells), modulus) if by_region else modulus

    def held(self, body: Body) -> dict[str, str]:
        """Axes that are held at each node set of a body; springs may be all that holds it."""
        moved = [named.place for named in self.parameters if named.kind == "moved"]
        return dict.fromkeys([*(["fixed"] if len(body.fixed) else []), *moved], "xyz")

    def loading(self, body: Body, coordinates: Coordinates) -> Loading:
        """What is known to act, that of the scan included.

        Args:
            body: the body.
            coordinates: of the twin's files.

        Raises:
            ParameterError: no such file, or forces of another body.
        """
        weight = None if self.unknown_weight or self.unknown_gravity else self._weight(coordinates)
        pressure = {"boundary": self.pressure} if self.pressure else {}
        forces = self._known_forces(body, coordinates)
        if self.floats and weight is not None:
            carrying = buoyancy(body, weight)
            carrying[body.fixed] = 0.0  # what holds the organ carries the rest
            forces = carrying if forces is None else forces + carrying
        in_scan = self.loading_of_scan(coordinates).body_force
        if in_scan is not None:
            weight = np.asarray(in_scan) + (0.0 if weight is None else weight)
        return Loading(forces, weight, pressure=pressure)

    def loading_of_scan(self, coordinates: Coordinates) -> Loading:
        """What acted when the organ was scanned.

        Args:
            coordinates: of the twin's files.
        """
        return Loading(body_force=self._force_of(self.scan_gravity, coordinates))

    def _force_of(self, gravity: tuple[float, float, float], coordinates: Coordinates) -> Floats | None:
        """Force per volume, (3,), N/m^3; None without gravity."""
        return coordinates.directions(np.array(gravity)) * self.density if any(gravity) else None

    @property
    def unknown_weight(self) -> NamedParameter | None:
        """The weight as it is named where it is known but for a factor."""
        return next((named for named in self.parameters if named.kind == "weight"), None)

    @property
    def unknown_gravity(self) -> NamedParameter | None:
        """Gravity as it is named where its direction is not known."""
        return next((named for named in self.parameters if named.kind == "gravity"), None)

    def _weight(self, coordinates: Coordinates) -> Floats | None:
        return self._force_of(self.gravity, coordinates)

    def _known_forces(self, body: Body, coordinates: Coordinates) -> Floats | None:
        if self.forces is None:
            return None
        try:
            found = np.asarray(np.load(self.forces, allow_pickle=False), dtype=np.float64)
        except (OSError, ValueError, EOFError) as error:
            raise ParameterError(f"known forces: expected an array in {self.forces} ({error}).") from None
        if found.shape != body.points.shape or not np.isfinite(found).all():
            raise ParameterError(
                f"known forces: expected finite numbers of shape {body.points.shape}, newtons, got shape {found.shape} "
                f"in {self.forces}."
            )
        found = coordinates.directions(found)
        lost = np.abs(found[body.fixed]).sum()
        if lost > 1e-9 * np.abs(found).sum():
            raise ParameterError(
                f"known forces: expected none at fixed nodes, got {lost:.3g} N there in {self.forces}."
            )
        found[body.fixed] = 0.0
        return found

    def inputs(self, body: Body, modulus: float, ratio: float, coordinates: Coordinates) -> InputBlocks | None:
        """The unknown inputs of the model; None where there are none.

        Args:
            body: the body.
            modulus: expected Young's modulus, pascals.
            ratio: expected Poisson's ratio.
            coordinates: of the twin's files.

        Raises:
            ValueError: no such structure or node set, or each named twice.
        """
        made: list[InputBlock | None] = [parameter.input_block(body) for parameter in self.parameters]
        named, weight = self.unknown_weight, self._weight(coordinates)
        if named is not None and weight is not None:
            forces = nodal_volumes(body)[:, None] * weight + (buoyancy(body, weight) if self.floats else 0.0)
            forces[body.fixed] = 0.0
            made.append(Weight(forces=forces) if named.number is None else Weight(named.number, forces=forces))
        if self.unknown_gravity is not None:
            made.append(self._gravity(body, coordinates))
        blocks = tuple(block for block in made if block is not None)
        values = {"young_modulus": self.modulus(modulus, body), "poisson_ratio": ratio}
        return InputBlocks(body, values, blocks) if blocks else None

    def _gravity(self, body: Body, coordinates: Coordinates) -> Gravity:
        """Gravity of unknown direction, on the axes of the files.

        Of a body that is scanned under its weight the masses are those of the scanned cells.
        """
        volumes = nodal_volumes(body)[:, None]
        masses = np.zeros((3, *body.points.shape))
        for axis, unit in enumerate(np.eye(3)):
            weight = self.density * coordinates.directions(unit)
            masses[axis] = volumes * weight + (buoyancy(body, weight) if self.floats else 0.0)
        masses[:, body.fixed] = 0.0
        named = self.unknown_gravity
        deviation = Gravity.deviation if named is None or named.number is None else named.number
        return Gravity(masses, np.array(self.gravity, dtype=np.float64), deviation)

    def blocks(self, observed: SurfaceDistance) -> tuple[ParameterBlock, ...]:
        """Parameters that are no inputs of the model.

        Args:
            observed: the observed side.
        """
        made = [parameter.block(observed) for parameter in self.parameters]
        return tuple(block for block in made if block is not None)


def buoyancy(body: Body, weight: Floats) -> Floats:
    """Nodal forces of the pressure of surroundings in which a body floats, (n, 3), newtons.

    The pressure grows along the weight as in a liquid of the body's own density, so that it carries all of the weight
    and turns nothing (Archimedes); it is none at the middle of the nodes.

    Args:
        body: the body.
        weight: force per volume, (3,), N/m^3.
    """
    surface = outer(body)
    return -surface.along_normals((surface.rest.points - body.points.mean(axis=0)) @ weight)
