"""Which component of an organ is meant, and which of its holes are cavities: kidneys, bladders, noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from .body import Floats

Cavities = Literal["", "keep", "fill"]
# A hole of a segmentation that is smaller than either is noise of the segmentation, and is filled: voxels that were
# missed, small vessels without a label. The lumen of a bladder, a stomach or a heart is a tenth of its wall or more. No
# label map at hand has a natural hole between the two (those of lungs in shared/data have none), so this is a choice.
CAVITY_VOLUME = 2e-6  # cubic metres
CAVITY_SHARE = 0.02  # of the volume of what is around it
LARGE_SHARE = 0.05  # of the whole: what is left out above this is a warning
_SIDES = {"left": 1.0, "right": -1.0}  # along x of LPS, which points to the patient's left


class ComponentError(ValueError):
    """A component that there is not, or words that name none: what was expected and what came."""


def check_component(text: str) -> None:
    """Refuse words that name no component.

    Args:
        text: `largest`, `left`, `right`, a number from 1 (the largest) or `near:STRUCTURE`.

    Raises:
        ComponentError: other words.
    """
    plain = text.strip()
    near = plain.startswith("near:") and len(plain) > len("near:")
    if not (plain in ("largest", *_SIDES) or near or (plain.isdigit() and int(plain) > 0)):
        raise ComponentError(
            f"--component: expected largest, left, right, a number from 1 or near:STRUCTURE, got {text!r}."
        )


def chosen_component(
    text: str, volumes: Floats, middles: Floats, away: Callable[[str], Floats], said: str = "the label"
) -> int:
    """The number, from 0, of the component that words mean.

    Left and right are the patient's, among components of more than a twentieth of the largest.

    Args:
        text: see `check_component`.
        volumes: of the components, (c,), of any unit.
        middles: their centroids, (c, 3), LPS, metres.
        away: distances of the components to a structure by its name, (c,), metres.
        said: what has the components, for messages.

    Raises:
        ComponentError: there is no such component; other words.
    """
    check_component(text)
    plain, order = text.strip(), np.argsort(volumes, kind="stable")[::-1]
    if plain == "largest":
        return int(order[0])
    if plain.startswith("near:"):
        return int(np.argmin(away(plain.removeprefix("near:"))))
    large = order[volumes[order] > LARGE_SHARE * volumes[order[0]]]
    if plain.isdigit():
        if int(plain) > len(order):
            raise ComponentError(f"--component: {said} has {len(order)} components, got {plain}.")
        return int(order[int(plain) - 1])
    if len(large) < 2:
        raise ComponentError(f"--component {plain}: {said} has one component that is no crumb; leave the option out.")
    return int(large[np.argmax(_SIDES[plain] * middles[large, 0])])


def dropped_line(dropped: float, kept: float, component: str) -> str:
    """What to say of components that were left out: a warning where they are a large part of the whole.

    Args:
        dropped: their volume, cubic metres.
        kept: volume of the component that was kept.
        component: how it was chosen.
    """
    line = f"component: {component}, {1e6 * kept:.4g} ml, was kept; {1e6 * dropped:.3g} ml in others left out"
    if dropped <= LARGE_SHARE * (dropped + kept):
        return f"segmentation: {line}"
    return f"warning: {line}; --component left, right, 2 or near:STRUCTURE takes another one"
