"""Which component of an organ is meant, and which of its holes are cavities: kidneys, bladders, noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .body import Floats, Ints
from .metrics import cell_volumes

Cavities = Literal["", "keep", "fill"]
Structures = Callable[[str], Floats]  # the vertices of a structure by its name, (v, 3), metres
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


def component_of_cells(points: Floats, cells: Ints, component: str, structures: Structures) -> tuple[Ints, Ints, str]:
    """One of several components of a volume mesh: its nodes, (n,), its cells by these, (m, k), and what to say of it.

    Of a mesh of one component nothing is said.

    Args:
        points: node positions, (n, 3), LPS, metres.
        cells: node numbers, (m, k), of any kind.
        component: see `check_component`.
        structures: vertices of the structures that `near:` may name.

    Raises:
        ComponentError: there is no such component.
    """
    pairs = np.repeat(cells[:, 0], cells.shape[1]), cells.ravel()
    graph = coo_array((np.ones(cells.size), pairs), shape=(len(points), len(points)))
    count, labels = connected_components(graph, directed=False)

    def away(name: str) -> Floats:
        vertices = structures(name)
        return np.array([cKDTree(points[labels == one]).query(vertices)[0].min() for one in range(count)])

    volumes = cell_volumes(points, cells[:, : 4 if cells.shape[1] in (4, 10) else 8])  # of curved cells nearly
    sizes = np.bincount(labels[cells[:, 0]], volumes, count).astype(np.float64)
    middles = np.array([points[labels == one].mean(axis=0) for one in range(count)])
    chosen = chosen_component(component, sizes, middles, away, "the mesh")
    nodes, kept = np.flatnonzero(labels == chosen), labels[cells[:, 0]] == chosen
    said = (
        ""
        if count == 1
        else (
            f"component: {component}, {1e6 * sizes[chosen]:.4g} ml, was kept; "
            f"{1e6 * (sizes.sum() - sizes[chosen]):.4g} ml in {count - 1} others left out, as you say"
        )
    )
    return nodes, np.searchsorted(nodes, cells[kept]), said
