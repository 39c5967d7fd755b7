"""Unknowns beside the forces, and known loads, as the configuration and the command line name them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.export import Coordinates
from softtwin.meshes.signed import cells_inside
from softtwin.reference.data.loading import Loading
from softtwin.registration.contact import Patch
from softtwin.registration.parameter_blocks import (
    ParameterBlock,
    ParameterBlocks,
    PoissonRatio,
    PrescribedMotion,
    YoungModulus,
)

if TYPE_CHECKING:
    from .config import Config

Floats = NDArray[np.float64]
WORDS = (
    "young-modulus, young-modulus@STRUCTURE (a closed inner surface, against the rest), poisson-ratio, moved@NODES (a "
    "zone or node set that moves as a rigid whole) or contact (one patch of unknown place instead of forces anywhere); "
    "=NUMBER behind it is its deviation: of the logarithm, of the logistic, metres; of a contact the patch's radius, "
    "metres"
)
_WORD = re.compile(r"(?P<kind>[a-z-]+)(?:@(?P<place>[^=]+))?(?:=(?P<number>.+))?")
_MODULUS = "young-modulus"
_PLACED = {_MODULUS: "maybe", "poisson-ratio": "never", "moved": "always", "contact": "never"}


class UnknownError(ValueError):
    """An unknown that nothing is known by that name, or that does not go with the others."""


@dataclass(frozen=True)
class Unknown:
    """One unknown as it is named.

    Args:
        kind: `young-modulus`, `poisson-ratio`, `moved` or `contact`.
        place: a structure or a node set; empty for the whole body.
        number: deviation, or radius; None for the default.
    """

    kind: str
    place: str = ""
    number: float | None = None

    @classmethod
    def parse(cls, text: str) -> Unknown:
        """The unknown that words stand for.

        Raises:
            UnknownError: no such words, a place where there is none, or none where there is one, no positive number.
        """
        found = _WORD.fullmatch(text.strip())
        kind = found["kind"] if found else ""
        if found is None or kind not in _PLACED:
            raise UnknownError(f"expected {WORDS}, got {text!r}")
        placed = bool(found["place"])
        if (placed and _PLACED[kind] == "never") or (not placed and _PLACED[kind] == "always"):
            raise UnknownError(f"expected {'moved@NODES' if kind == 'moved' else kind}, got {text!r}")
        return cls(kind, found["place"] or "", _positive(found["number"], text))

    def condition(self, body: Body) -> ParameterBlock:
        """What it is to a registration.

        Args:
            body: the body, which has the structure or the nodes.
        """
        given = {} if self.number is None else {"deviation": self.number}
        if self.kind == _MODULUS:
            return YoungModulus(**given, cells=cells_inside(body, self.place) if self.place else None, name=self.place)
        if self.kind == "poisson-ratio":
            return PoissonRatio(**given)
        return (
            PrescribedMotion(self.place)
            if self.number is None
            else PrescribedMotion(self.place, translation_deviation=self.number)
        )


def priors_taken(unknowns: tuple[str, ...]) -> list[str]:
    """A line for each modulus whose prior nobody has said: beside unknown forces it is what newtons are worth.

    Args:
        unknowns: words, as `Unknown.parse` takes them.
    """
    silent = [text for text in unknowns if (named := Unknown.parse(text)).number is None and named.kind == _MODULUS]
    taken = f"prior of ±{100 * YoungModulus.deviation:.0f} % taken"
    return [f"{text}: {taken}, and forces are known no better; say {text}=DEVIATION" for text in silent]


def _positive(text: str | None, whole: str) -> float | None:
    if text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not 0.0 < number < np.inf:
        raise UnknownError(f"expected a positive number behind =, got {whole!r}")
    return number


@dataclass(frozen=True)
class Scenario:
    """What is unknown beside the forces of a twin, and what is known to act along.

    Args:
        unknowns: beside the forces.
        forces: file of known nodal forces, .npy (n, 3), newtons, on the axes of the twin's files; None for none.
        gravity: on the axes of the twin's files, (3,), m/s^2.
        pressure: on the whole boundary, pascals.
        density: kg/m^3.
    """

    unknowns: tuple[Unknown, ...]
    forces: Path | None
    gravity: tuple[float, float, float]
    pressure: float
    density: float

    @classmethod
    def of(cls, config: Config) -> Scenario:
        """What a configuration says."""
        section = config.registration
        return cls(
            tuple(map(Unknown.parse, section.unknowns)),
            Path(section.known_forces) if section.known_forces else None,
            section.gravity,
            section.pressure,
            config.material.density,
        )

    @property
    def patch(self) -> Patch | None:
        """The one contact of unknown place; None where forces act anywhere."""
        contacts = [unknown for unknown in self.unknowns if unknown.kind == "contact"]
        if not contacts:
            return None
        return Patch() if contacts[0].number is None else Patch(contacts[0].number)

    def modulus(self, modulus: float, body: Body) -> float | Floats:
        """Young's modulus as the material needs it: one for each cell where that of a region is unknown, pascals."""
        by_region = any(unknown.kind == _MODULUS and unknown.place for unknown in self.unknowns)
        return np.full(len(body.cells), modulus) if by_region else modulus

    @property
    def held(self) -> dict[str, str]:
        """Axes that are held at each node set."""
        moved = [unknown.place for unknown in self.unknowns if unknown.kind == "moved"]
        return {"fixed": "xyz", **dict.fromkeys(moved, "xyz")}

    def loading(self, body: Body, coordinates: Coordinates) -> Loading:
        """What is known to act.

        Args:
            body: the body.
            coordinates: of the twin's files.

        Raises:
            UnknownError: no such file, or forces of another body.
        """
        weight = coordinates.directions(np.array(self.gravity)) * self.density if any(self.gravity) else None
        pressure = {"boundary": self.pressure} if self.pressure else {}
        return Loading(self._known_forces(body, coordinates), weight, pressure=pressure)

    def _known_forces(self, body: Body, coordinates: Coordinates) -> Floats | None:
        if self.forces is None:
            return None
        try:
            found = np.asarray(np.load(self.forces, allow_pickle=False), dtype=np.float64)
        except (OSError, ValueError, EOFError) as error:
            raise UnknownError(f"known forces: expected an array in {self.forces} ({error}).") from None
        if found.shape != body.points.shape or not np.isfinite(found).all():
            raise UnknownError(
                f"known forces: expected finite numbers of shape {body.points.shape}, newtons, got shape {found.shape} "
                f"in {self.forces}."
            )
        found = coordinates.directions(found)
        lost = np.abs(found[body.fixed]).sum()
        if lost > 1e-9 * np.abs(found).sum():
            raise UnknownError(f"known forces: expected none at fixed nodes, got {lost:.3g} N there in {self.forces}.")
        found[body.fixed] = 0.0
        return found

    def parameter_blocks(self, body: Body, modulus: float, ratio: float) -> ParameterBlocks | None:
        """The unknowns as registration takes them; None where there are none.

        Args:
            body: the body.
            modulus: expected Young's modulus, pascals.
            ratio: expected Poisson's ratio.

        Raises:
            ValueError: no such structure or node set, or each named twice.
        """
        named = [unknown for unknown in self.unknowns if unknown.kind != "contact"]
        if not named:
            return None
        parameters = {"young_modulus": self.modulus(modulus, body), "poisson_ratio": ratio}
        return ParameterBlocks(body, parameters, tuple(unknown.condition(body) for unknown in named))
