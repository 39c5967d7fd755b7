"""Parameters to estimate beside the forces, as the configuration and the command line name them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.signed import cells_inside
from softtwin.registration.parameters.block import ParameterBlock
from softtwin.registration.parameters.input_block import InputBlock
from softtwin.registration.parameters.poisson_ratio import PoissonRatio
from softtwin.registration.parameters.prescribed_motion import PrescribedMotion
from softtwin.registration.parameters.springs import SpringStiffness
from softtwin.registration.parameters.young_modulus import YoungModulus
from softtwin.registration.surface_distance import SurfaceDistance

Floats = NDArray[np.float64]
_WORD = re.compile(r"(?P<kind>[a-z-]+)(?:@(?P<place>[^=]+))?(?:=(?P<number>.+))?")
_MODULUS = "young-modulus"


@dataclass(frozen=True)
class Kind:
    """A kind of parameter that can be asked for: one line of `KINDS`.

    Args:
        words: how it is written, with what it is.
        input: of the forward model, by the body, the place and the number; None for another kind of block.
        block: any other block, by the observed side, the place and the number; None for an input.
        placed: whether a place belongs to it.
        of_gravity: an input, too: made of gravity and density.
    """

    words: str
    input: Callable[[Body, str, float | None], InputBlock] | None = None
    block: Callable[[SurfaceDistance, str, float | None], ParameterBlock] | None = None
    placed: Literal["never", "maybe", "always"] = "never"
    of_gravity: bool = False


def _young_modulus(body: Body, place: str, deviation: float | None) -> YoungModulus:
    cells = cells_inside(body, place) if place else None
    return YoungModulus(YoungModulus.deviation if deviation is None else deviation, cells, place)


def _poisson_ratio(_body: Body, _place: str, deviation: float | None) -> PoissonRatio:
    return PoissonRatio() if deviation is None else PoissonRatio(deviation)


def _moved(_body: Body, place: str, shift: float | None) -> PrescribedMotion:
    return PrescribedMotion(place) if shift is None else PrescribedMotion(place, translation_deviation=shift)


def _springs(_body: Body, name: str, deviation: float | None) -> SpringStiffness:
    return SpringStiffness(name=name) if deviation is None else SpringStiffness(deviation, name=name)


# A new parameter is a block in `softtwin.registration.parameters`, and a line here. A contact is a way of its own.
KINDS = {
    _MODULUS: Kind(
        "young-modulus, young-modulus@STRUCTURE (a closed inner surface, against the rest)",
        _young_modulus,
        placed="maybe",
    ),
    "poisson-ratio": Kind("poisson-ratio", _poisson_ratio),
    "moved": Kind("moved@NODES (a zone or node set that moves as a rigid whole)", _moved, placed="always"),
    "springs": Kind("springs@NAME (how many times as stiff as [springs] says)", _springs, placed="always"),
    "weight": Kind("weight (of gravity: how many times what density and gravity say)", of_gravity=True),
    "gravity": Kind("gravity (its direction and size, near what gravity says)", of_gravity=True),
    "contact": Kind("contact (one patch of unknown place instead of forces anywhere)"),
}


def words() -> str:
    """How parameters are named."""
    every = [kind.words for kind in KINDS.values()]
    return (
        f"{', '.join(every[:-1])} or {every[-1]}; =NUMBER behind it is its deviation: of the logarithm, of the "
        "logistic, metres, m/s^2; of a contact the patch's radius, metres"
    )


class ParameterError(ValueError):
    """A parameter of no known name, or one that does not go with the others."""


@dataclass(frozen=True)
class NamedParameter:
    """One parameter as it is named.

    Args:
        kind: one of `KINDS`.
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
        if found is None or kind not in KINDS:
            raise ParameterError(f"expected {words()}, got {text!r}")
        placed, rule = bool(found["place"]), KINDS[kind].placed
        if (placed and rule == "never") or (not placed and rule == "always"):
            raise ParameterError(f"expected {f'{kind}@NODES' if rule == 'always' else kind}, got {text!r}")
        return cls(kind, found["place"] or "", _positive(found["number"], text))

    @property
    def is_input(self) -> bool:
        """Whether it is an input of the forward model, which a network has learned one value of."""
        return KINDS[self.kind].input is not None or KINDS[self.kind].of_gravity

    def input_block(self, body: Body) -> InputBlock | None:
        """What it is to the model; None where it is no input.

        Args:
            body: the body, which has the structure or the nodes.
        """
        made = KINDS[self.kind].input
        return None if made is None else made(body, self.place, self.number)

    def block(self, observed: SurfaceDistance) -> ParameterBlock | None:
        """What it is beside the model; None where it is an input.

        Args:
            observed: the observed side.
        """
        made = KINDS[self.kind].block
        return None if made is None else made(observed, self.place, self.number)


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
