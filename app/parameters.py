"""Parameters to estimate beside the forces, as the configuration and the command line name them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.signed import cells_inside
from softtwin.registration.parameter_blocks import ParameterBlock, PoissonRatio, PrescribedMotion, YoungModulus

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


class ParameterError(ValueError):
    """A parameter of no known name, or one that does not go with the others."""


@dataclass(frozen=True)
class NamedParameter:
    """One parameter as it is named.

    Args:
        kind: `young-modulus`, `poisson-ratio`, `moved` or `contact`.
        place: a structure or a node set; empty for the whole body.
        number: deviation, or radius; None for the default.
    """

    kind: str
    place: str = ""
    number: float | None = None

    @classmethod
    def parse(cls, text: str) -> NamedParameter:
        """The parameter that words stand for.

        Raises:
            ParameterError: no such words, a place where there is none, or none where there is one, no positive number.
        """
        found = _WORD.fullmatch(text.strip())
        kind = found["kind"] if found else ""
        if found is None or kind not in _PLACED:
            raise ParameterError(f"expected {WORDS}, got {text!r}")
        placed = bool(found["place"])
        if (placed and _PLACED[kind] == "never") or (not placed and _PLACED[kind] == "always"):
            raise ParameterError(f"expected {'moved@NODES' if kind == 'moved' else kind}, got {text!r}")
        return cls(kind, found["place"] or "", _positive(found["number"], text))

    def parameter_block(self, body: Body) -> ParameterBlock:
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


def priors_taken(parameters: tuple[str, ...]) -> list[str]:
    """A line for each modulus whose prior nobody has said: beside unknown forces it is what newtons are worth.

    Args:
        parameters: words, as `NamedParameter.parse` takes them.
    """
    silent = [
        text for text in parameters if (named := NamedParameter.parse(text)).number is None and named.kind == _MODULUS
    ]
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
        raise ParameterError(f"expected a positive number behind =, got {whole!r}")
    return number
