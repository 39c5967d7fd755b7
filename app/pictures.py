"""Pictures of surfaces and charts, drawn off screen and kept as text in the page."""

from __future__ import annotations

import base64
import io
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import pyvista
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from vtkmodules.vtkCommonCore import vtkLogger

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ORGAN = "#c4604a"  # colour of a surface that is given none
CLOUD, FOUND = "#1c6fd1", "#f08c00"
_VESSELS = ("#3b5bdb", "#9c36b5", "#0c8599", "#5c940d")
_TUMOUR = re.compile("tumou?r|lesion|metasta", re.IGNORECASE)
DISPLACEMENT = "viridis"
_SUPERSAMPLING = 2  # VTK counts points and lines in the pixels before they are averaged
# In a process of its own: where VTK can draw nowhere, it ends the process that asks it to.
_PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(16, 16))
plotter.add_mesh(pyvista.Sphere())
assert plotter.screenshot(return_img=True).min() < 255
"""
_PROBE_TIMEOUT_S = 60


@dataclass(frozen=True)
class Picture:
    """A PNG inside the HTML.

    Args:
        address: data address of the picture, empty where nothing could be drawn.
        words: what is to be seen, for those who do not see it.
        dark: the same for a dark page, empty where one does for both.
        bar: length of the scale bar, metres; 0 for none.
        bar_share: its share of the picture's width.
    """

    address: str
    words: str
    dark: str = ""
    bar: float = 0.0
    bar_share: float = 0.0


@dataclass(frozen=True, eq=False)
class Layer:
    """One thing in a picture.

    Args:
        points: positions, (n, 3), metres.
        triangles: node numbers, (t, 3); none: the points themselves are drawn as balls.
        colour: of the whole.
        opacity: 0 to 1.
        values: a figure a node, (n,), shown in colours from 0 to `limit` instead of the one colour.
        limit: value at the end of the colours.
        colours: name of the colour map.
        style: `surface`, `wireframe` or `outline` (what stands against the background).
        ball: diameter of balls relative to the picture's width.
    """

    points: Floats
    triangles: Ints | None = None
    colour: str = ORGAN
    opacity: float = 1.0
    values: Floats | None = None
    limit: float = 1.0
    colours: str = DISPLACEMENT
    style: str = "surface"
    ball: float = 0.008


@dataclass(frozen=True, eq=False)
class View:
    """A camera without perspective, so that lengths can be compared.

    Args:
        towards: unit vector from what is seen to the camera, (3,).
        right: unit vector to the right in the picture, (3,).
        up: unit vector upwards in the picture, (3,).
        centre: what stands in the middle, (3,), metres.
        half: half of width and height, (2,), metres.
    """

    towards: Floats
    right: Floats
    up: Floats
    centre: Floats
    half: tuple[float, float]


def is_tumour(name: str) -> bool:
    """True for the name of what a surgeon looks for."""
    return _TUMOUR.search(name) is not None


def inner_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each inner surface: tumours stand out."""
    names = list(names)
    vessels = [name for name in names if not is_tumour(name)]
    return {name: _VESSELS[vessels.index(name) % len(_VESSELS)] if name in vessels else FOUND for name in names}


def view_of(towards: Floats, points: Iterable[Floats], margin: float = 1.06) -> View:
    """The view from a direction that just holds all points.

    Args:
        towards: direction to the camera, (3,), any length.
        points: arrays (n, 3), metres.
        margin: how much larger than needed.
    """
    towards = towards / np.linalg.norm(towards)
    vertical = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.95 else np.array([0.0, 1.0, 0.0])
    right = np.cross(vertical, towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    seen = np.concatenate(list(points)) @ np.column_stack([right, up, towards])
    low, high = seen.min(axis=0), seen.max(axis=0)
    centre = np.column_stack([right, up, towards]) @ (0.5 * (low + high))
    width, height = (margin * max(x, 0.2 * float((high - low)[:2].max())) / 2 for x in (high - low)[:2].tolist())
    return View(towards, right, up, centre, (width, height))


def sprung(body: Body) -> dict[str, Ints]:
    """Triangles of the surfaces that springs hold, by name: all that are named but the observed one."""
    return {name: triangles for name, triangles in body.surfaces.items() if name != "observed"}


def camera_side(body: Body) -> Floats:
    """Direction from the body to a camera that sees its observed side, or its broadest side, a little from above."""
    surface = outer(body).rest
    triangles = body.surfaces.get("observed", surface.triangles)
    a, b, c = (surface.points[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    forward = normals.sum(axis=0)
    if np.linalg.norm(forward) < 0.2 * np.linalg.norm(normals, axis=1).sum():
        _, _, axes = np.linalg.svd(body.points - body.points.mean(axis=0), full_matrices=False)
        held = [body.fixed, *(triangles.ravel() for name, triangles in sprung(body).items())]
        nodes = np.concatenate(held)
        away = body.points.mean(axis=0) - body.points[nodes].mean(axis=0) if len(nodes) else axes[2]
        forward = axes[2] * (1.0 if axes[2] @ away >= 0 else -1.0)
    forward = forward / np.linalg.norm(forward)
    return forward + np.array([0.0, 0.0, 0.3]) + 0.3 * np.cross(forward, [0.0, 0.0, 1.0])


def moved_layers(body: Body, displacement: Floats, limit: float) -> list[Layer]:
    """The deformed body coloured by its displacement, and its outline at rest.

    Args:
        body: the body.
        displacement: (n, 3), metres.
        limit: displacement at the end of the colours, metres.
    """
    outside = outer(body)
    at_rest, moved = outside.rest, outside.moved(displacement)
    sizes = np.linalg.norm(moved.points - at_rest.points, axis=1)
    coloured = Layer(moved.points, moved.triangles, values=sizes, limit=limit)
    return [coloured, Layer(at_rest.points, at_rest.triangles, "#8a929c", style="outline")]


def rendering_problem() -> str:
    """Why pictures cannot be drawn on this machine, empty if they can."""
    try:
        told = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=_PROBE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"VTK did not draw within {_PROBE_TIMEOUT_S} s"
    return "" if told.returncode == 0 else "VTK found no way to draw off screen (apt-get install libegl1 libgl1)"


@dataclass(frozen=True)
class Studio:
    """Draws pictures, or says why it cannot.

    Args:
        problem: why nothing can be drawn, empty if all is well.
    """

    problem: str

    def picture(self, view: View, layers: Iterable[Layer], words: str, width: int = 760) -> Picture:
        """Layers seen from a view, on a transparent ground.

        Args:
            view: the camera.
            layers: what is seen.
            words: says what is seen.
            width: pixels.
        """
        bar = _round_length(0.5 * view.half[0])
        address = "" if self.problem else _png(_render(view, layers, width))
        return Picture(address, words, bar=bar, bar_share=0.5 * bar / view.half[0])


def _render(view: View, layers: Iterable[Layer], width: int) -> NDArray[np.uint8]:
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # it warns of each screen that is not there
    height = round(width * view.half[1] / view.half[0])
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[width, height], lighting="none")
    plotter.add_light(pyvista.Light(light_type="headlight"))
    for layer in layers:
        _add(plotter, layer, width)
    camera = plotter.camera
    camera.focal_point, camera.up = view.centre, view.up
    camera.position = view.centre + 20 * max(view.half) * view.towards
    camera.parallel_projection, camera.parallel_scale = True, view.half[1]
    plotter.renderer.ResetCameraClippingRange()
    plotter.enable_depth_peeling(6)
    plotter.enable_anti_aliasing("ssaa")
    image = plotter.screenshot(return_img=True, transparent_background=True)
    plotter.close()
    return np.asarray(image)


def _add(plotter: Any, layer: Layer, width: int) -> None:
    if layer.triangles is None:
        size = _SUPERSAMPLING * layer.ball * width
        plotter.add_points(layer.points, color=layer.colour, render_points_as_spheres=True, point_size=size)
        return
    used, local = np.unique(layer.triangles, return_inverse=True)
    faces = np.column_stack([np.full(len(layer.triangles), 3), local.reshape(-1, 3)])
    mesh = pyvista.PolyData(layer.points[used], faces.ravel())
    if layer.style == "outline":
        plotter.add_silhouette(mesh, color=layer.colour, line_width=_SUPERSAMPLING * width / 200)
        return
    look: dict[str, Any] = {"color": layer.colour}
    if layer.values is not None:
        mesh.point_data["values"] = layer.values[used]
        limits = (0.0, max(layer.limit, 1e-12))  # VTK wants an interval
        look = {"scalars": "values", "cmap": layer.colours, "clim": limits, "show_scalar_bar": False}
    if layer.style == "surface":
        look |= {"smooth_shading": True, "split_sharp_edges": True, "feature_angle": 50.0}
    look |= {"ambient": 0.4, "diffuse": 0.6, "line_width": _SUPERSAMPLING * width / 900}
    plotter.add_mesh(mesh, opacity=layer.opacity, style=layer.style, **look)


def _png(image: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=6)
    return _address(buffer)


def _address(buffer: io.BytesIO) -> str:
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * 1.0001))


_CHART_STYLE = {"axes.spines.top": False, "axes.spines.right": False, "font.size": 10.0, "axes.facecolor": "none"}


def chart(draw: Callable[[Figure], None], words: str, size: tuple[float, float] = (10.0, 3.1)) -> Picture:
    """A chart for light and for dark pages.

    Args:
        draw: fills a figure.
        words: says what is seen.
        size: width and height, inches.
    """
    addresses = []
    for ink in ("#30363d", "#c9d1d9"):
        inked = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
        style: Any = {**dict.fromkeys(inked, ink), **_CHART_STYLE}
        with matplotlib.rc_context(style):
            sheet = Figure(figsize=size, layout="constrained", facecolor="none")
            draw(sheet)
            buffer = io.BytesIO()
            sheet.savefig(buffer, format="png", dpi=104)
        addresses.append(_address(buffer))
    return Picture(addresses[0], words, dark=addresses[1])
