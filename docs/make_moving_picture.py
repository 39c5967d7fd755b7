"""The moving picture of the README: a registration from before to after, from what `softtwin quickstart` wrote.

    python docs/make_moving_picture.py softtwin-quickstart docs/quickstart.gif

The organ is translucent, with its vessels and its tumour; black points are the partial cloud that a camera saw. Between
the reference configuration and the registered state the displacement grows smoothly, for the eye.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyvista
from PIL import Image, ImageDraw

SIZE = (640, 400)
FRAMES, HELD_BEFORE, HELD_AFTER = 16, 4, 4  # growing, and still at either end
FRAME_MS = 110
COLOURS = {
    "organ": ("#c98a78", 0.45),
    "tumour": ("#d62728", 1.0),
    "vessel_hepatic": ("#2b5fa8", 1.0),
    "vessel_portal": ("#7a4fb5", 1.0),
}
CAMERA = (0.25, -1.0, 0.35)  # from where the cloud was seen, about


def shares() -> list[float]:
    """Part of the displacement in each picture, from 0 to 1 with soft ends."""
    grown = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, FRAMES + 1) / FRAMES)
    return [0.0] * HELD_BEFORE + grown.tolist() + [1.0] * HELD_AFTER


def pictures(folder: Path) -> list[Image.Image]:
    """One picture for each share.

    Args:
        folder: of a registration: `organ_0000.vtp`, ..., each with its displacement, `cloud_0000.vtp` and
            `registration.json`.
    """
    plotter = pyvista.Plotter(off_screen=True, window_size=[2 * side for side in SIZE])
    plotter.set_background("white")
    moved = {}
    for name, (colour, opacity) in COLOURS.items():
        surface = pyvista.read(folder / f"{name}_0000.vtp")
        moved[name] = (surface, surface.points.copy(), surface.point_data["displacement"].copy())
        plotter.add_mesh(surface, color=colour, opacity=opacity, smooth_shading=True, specular=0.2)
    cloud = pyvista.read(folder / "cloud_0000.vtp")
    plotter.add_points(cloud.points, color="black", point_size=7.0, render_points_as_spheres=True)
    plotter.camera_position = [np.array(cloud.center) + 600.0 * np.array(CAMERA), cloud.center, (0.0, 0.0, 1.0)]
    plotter.reset_camera()
    plotter.camera.zoom(1.35)
    frame = json.loads((folder / "registration.json").read_text())["frames"][0]
    after = (
        f"registered: {frame['verdict']}, tumour within {1e3 * frame['targets']['tumour']['margin95_m']:.1f} mm (95 %)"
    )
    drawn = []
    for share in shares():
        for surface, points, displacement in moved.values():
            surface.points = points - (1.0 - share) * displacement
            surface.compute_normals(cell_normals=False, inplace=True, split_vertices=False, consistent_normals=False)
        plotter.render()
        picture = Image.fromarray(plotter.screenshot(return_img=True)).resize(SIZE, Image.Resampling.LANCZOS)
        words = "before: the organ as it was scanned" if share == 0.0 else after if share == 1.0 else "registering"
        ImageDraw.Draw(picture).text((12, SIZE[1] - 26), words, fill="black", font_size=16)
        drawn.append(picture)
    plotter.close()
    return drawn


def main(quickstart: Path, output: Path) -> None:
    """Writes the picture.

    Args:
        quickstart: what `softtwin quickstart` wrote.
        output: a GIF.
    """
    drawn = pictures(quickstart / "demo" / "surrogate")
    palette = drawn[-1].quantize(128)
    first, *rest = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in drawn]
    first.save(output, save_all=True, append_images=rest, duration=FRAME_MS, loop=0, optimize=True)
    print(f"{output}: {len(drawn)} pictures, {output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
