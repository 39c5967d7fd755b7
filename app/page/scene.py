"""What is drawn: the organ in bands of colour, what lies inside it, the cloud; moved vertex by vertex, in place."""

from __future__ import annotations

import threading
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import is_carried_along, outer, target_points

from ..record import NOTICE
from .bands import COLOURS, UNINFORMED, Colour, Scale, banded

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Drag = Callable[[Any], Coroutine[Any, Any, None]]

PER_METRE = 10.0  # the scene is in decimetres: what viser takes for granted is about as large as one
FRONT = np.array([-0.3, -1.0, 0.25])  # from an organ towards who looks at it, as from the patient's front
_ORGAN_OPACITY = 0.45
_NOWHERE = np.zeros((1, 3), dtype=np.int64)  # a triangle of no area: viser's meshes are never empty
_KINDS: tuple[tuple[str, Colour], ...] = (
    ("tumour", (110, 30, 140)),
    ("tumor", (110, 30, 140)),
    ("hepatic", (40, 90, 190)),
    ("portal", (90, 170, 230)),
    ("artery", (200, 30, 30)),
)
_OTHER: Colour = (120, 120, 125)
_CLOUD: Colour = (25, 25, 30)


def colour_of(name: str) -> Colour:
    """Colour of an inner structure, by what its name says it is."""
    return next((colour for word, colour in _KINDS if word in name.lower()), _OTHER)


def spoken(name: str) -> str:
    """Name of a structure for people."""
    return name.replace("_", " ")


class Picture:
    """The scene of one body; safe to call from several threads.

    Args:
        server: that shows it.
        body: at rest.
        cloud_size: diameter of a point of the cloud, metres.
    """

    def __init__(self, server: viser.ViserServer, body: Body, cloud_size: float = 0.8e-3) -> None:
        self._server, self._lock = server, threading.RLock()
        self._outer = outer(body)
        self._shown = self._outer.vertices
        self.centre: Floats = self._outer.rest.points[self._shown].mean(axis=0)
        self.triangles: Ints = np.searchsorted(self._shown, self._outer.rest.triangles)
        self._embeddings = target_points(body)
        self._inner_rest = {name: surface.points for name, surface in body.inner.items()}
        self._cloud_size = cloud_size
        self._look()
        rest = self.placed(self._outer.rest.points[self._shown])
        self._bands = [self._band(number, rest, colour) for number, colour in enumerate((UNINFORMED, *COLOURS))]
        self._drawn = [np.zeros((0, 3), dtype=np.int64) for _ in self._bands]
        self._outside = {name: is_carried_along(body, points) for name, points in self._embeddings.items()}
        self._inner = {name: self._structure(name, body.inner[name].triangles) for name in body.inner}
        self._labels = {name: self._label(name) for name in body.inner}
        self._cloud: viser.PointCloudHandle | None = None
        self.paint(None, Scale("", (0.0, 0.0, 0.0)))
        self.move(np.zeros_like(body.points))

    def placed(self, points: Floats) -> NDArray[np.float32]:
        """Points of the body's coordinates, metres, in the scene."""
        return (PER_METRE * (points - self.centre)).astype(np.float32)

    def place_of(self, position: tuple[float, float, float]) -> Floats:
        """A place in the scene in the body's coordinates, (3,), metres."""
        return np.asarray(position, dtype=np.float64) / PER_METRE + self.centre

    def move(self, displacement: Floats) -> None:
        """Move all that the body carries.

        Args:
            displacement: of the nodes, (n, 3), metres.
        """
        organ = self.placed(self._outer.rest.points[self._shown] + self._outer.carried(displacement)[self._shown])
        inner = {
            name: self.placed(rest + self._embeddings[name].displace(displacement))
            for name, rest in self._inner_rest.items()
        }
        with self._lock, self._server.atomic():
            for band in self._bands:
                band.vertices = organ
            for name, points in inner.items():
                for part in self._inner[name]:
                    part.vertices = points
                self._labels[name].position = _label_place(points, self._is_below(name)).astype(np.float64)
        self._server.flush()

    def paint(self, values: Floats | None, scale: Scale) -> None:
        """Colour the organ.

        Args:
            values: at the nodes, (n,), metres, NaN where nothing is told; None where that is nowhere.
            scale: the bands.
        """
        carried = None if values is None else self._outer.carried(values[:, None])[self._shown, 0]
        found = banded(self.triangles, carried, scale)
        with self._lock, self._server.atomic():
            for number, (band, triangles) in enumerate(zip(self._bands, found, strict=True)):
                if not np.array_equal(triangles, self._drawn[number]):
                    band.faces = (triangles if len(triangles) else _NOWHERE).astype(np.uint32)
                    self._drawn[number] = triangles

    def name_margins(self, margins: Mapping[str, float]) -> None:
        """Write beside each structure how well its place is known; nothing where that is not known.

        Args:
            margins: 95 % margin of each, metres, by name.
        """
        with self._lock:
            for name, label in self._labels.items():
                margin = margins.get(name, np.nan)
                said = f"{spoken(name)} ± {1e3 * margin:.1f} mm" if np.isfinite(margin) else spoken(name)
                label.text = f"{said} inside the organ" if np.isfinite(margin) and self._outside[name].any() else said

    def show_cloud(self, points: Floats | None) -> None:
        """Show a cloud; none for None.

        Args:
            points: (p, 3), metres, in the body's coordinates.
        """
        with self._lock:
            if points is None or not len(points):
                if self._cloud is not None:
                    self._cloud.visible = False
                return
            placed = self.placed(points)
            if self._cloud is None:
                self._cloud = self._server.scene.add_point_cloud(
                    "/cloud", placed, _CLOUD, point_size=PER_METRE * self._cloud_size, point_shape="circle"
                )
            self._cloud.points = placed.astype(np.float16)
            self._cloud.visible = True

    def on_drag(self, callback: Drag) -> None:
        """Call with every event of a drag at the organ; the callback must not wait."""
        for band in self._bands:
            band.on_drag(callback)

    def _look(self) -> None:
        scene, camera = self._server.scene, self._server.initial_camera
        points = self._outer.rest.points[self._shown]
        size = PER_METRE * float(np.linalg.norm(np.ptp(points, axis=0)))
        place = 0.78 * size * FRONT / np.linalg.norm(FRONT)
        camera.position, camera.look_at = place, (0.0, 0.0, 0.0)
        camera.up = (0.0, 0.0, 1.0)
        scene.set_up_direction("+z")
        # In the scene, too: a recording has no panel.
        scene.add_label("/notice", NOTICE, position=(0.0, 0.0, -0.45 * size), anchor="top-center")
        scene.configure_default_lights(enabled=True, cast_shadow=False)

    def _band(self, number: int, rest: NDArray[np.float32], colour: Colour) -> viser.MeshHandle:
        return self._server.scene.add_mesh_simple(
            f"/organ/band {number}",
            rest,
            _NOWHERE.astype(np.uint32),
            color=colour,
            opacity=_ORGAN_OPACITY,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _structure(self, name: str, triangles: Ints) -> list[viser.MeshHandle]:
        """What lies inside the organ, and what lies outside and is carried along: where that is, is not known."""
        outside = self._outside[name][triangles].any(axis=1)
        parts = [("", triangles[~outside], colour_of(name)), (" outside", triangles[outside], UNINFORMED)]
        return [
            self._server.scene.add_mesh_simple(
                f"/inner/{name}{word}",
                self.placed(self._inner_rest[name]),
                part.astype(np.uint32),
                color=colour,
                cast_shadow=False,
                receive_shadow=False,
            )
            for word, part, colour in parts
            if len(part)
        ]

    def _label(self, name: str) -> viser.LabelHandle:
        return self._server.scene.add_label(
            f"/labels/{name}",
            spoken(name),
            font_screen_scale=1.3,
            anchor="top-center" if self._is_below(name) else "bottom-center",
        )

    def _is_below(self, name: str) -> bool:
        """Whether a structure's label stands below it: every second of them, so that they do not cover each other."""
        return sorted(self._inner_rest, reverse=True).index(name) % 2 == 0


def _label_place(points: NDArray[np.float32], is_below: bool) -> NDArray[np.float32]:
    """Above the top of what a label names, or below its bottom."""
    end = points[np.argmin(points[:, 2]) if is_below else np.argmax(points[:, 2])]
    return end + np.array([0.0, 0.0, -0.03 if is_below else 0.03], dtype=np.float32)
