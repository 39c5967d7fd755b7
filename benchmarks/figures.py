"""The pictures of the pages of results, drawn from the records: `python benchmarks/figures.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("svg")
import matplotlib.pyplot as plt
from dashboard import PAGES, load

plt.rcParams.update(
    {"svg.hashsalt": "softtwin", "svg.fonttype": "none", "font.size": 10, "axes.grid": True, "grid.alpha": 0.3}
)


def hard_loads() -> Any:
    """How many hard loads each way solves, and in what time."""
    figures = load("beam_hard")["figures"]
    figure, axes = plt.subplots(figsize=(6.4, 3.2))
    for name, told in figures.items():
        if "median_ms" in told:
            axes.plot(told["median_ms"], 100 * told["converged"] / told["loads"], "o")
            axes.annotate(name, (told["median_ms"], 100 * told["converged"] / told["loads"]), fontsize=7, rotation=25)
    axes.set(xscale="log", xlabel="median time, ms", ylabel="solved, %", ylim=(0, 118))
    return figure


def networks() -> Any:
    """Mean nodal error of the architectures on 8,192 samples of the beam."""
    figures = load("networks")["figures"]
    rows = {
        "reduced, Jacobians": "4.2: reduced, whole Jacobians, seed 0",
        "reduced": "4.2: reduced, seed 0",
        "POD, linear": "4.2: POD of 64 modes, linear map",
        "perceptron": "4.2: mlp, seed 0",
        "transolver": "4.2: transolver, seed 0",
        "U-Mesh, 16 channels": "4.2: umesh, 16 channels, seed 0",
    }
    figure, axes = plt.subplots(figsize=(6.4, 2.8))
    values = [1e3 * figures[key]["modal"]["nodal_error"]["mean"] for key in rows.values()]
    axes.barh(list(rows), values, color="teal")
    axes.set(xscale="log", xlabel="mean nodal error, mm")
    axes.invert_yaxis()
    return figure


def noise() -> Any:
    """Target error by the noise of the points."""
    sizes = {"clean": 0.0, "noise 1 mm": 1.0, "noise 2 mm": 2.0, "noise 5 mm": 5.0}
    figure, axes = plt.subplots(figsize=(6.4, 3.0))
    for engine, style in (("surrogate", "o-"), ("reference", "s--")):
        figures = load(f"robustness_{engine}")["figures"]
        axes.plot(list(sizes.values()), [figures[name]["cold"]["tre_mm"] for name in sizes], style, label=engine)
    axes.set(xlabel="noise of a point, mm", ylabel="target error, mm", ylim=(0, None))
    axes.legend()
    return figure


def sequences() -> Any:
    """Target error of each frame of the real liver's sequences."""
    figure, axes = plt.subplots(figsize=(6.4, 3.0))
    for name, told in load("registration_surrogate")["figures"]["sequences"].items():
        errors = [frame["tre_mm"] for frame in told["frames"]]
        axes.plot(range(len(errors)), errors, label=name)
    axes.set(xlabel="frame", ylabel="target error, mm", ylim=(0, None))
    axes.legend()
    return figure


def ways() -> Any:
    """Errors of all ways to register an organ, theirs and ours, by data."""
    figures = load("organs")["figures"]
    data = list(dict.fromkeys(row.split(": ")[0] for row in figures))
    names = list(dict.fromkeys(row.split(": ")[1] for row in figures))
    figure, axes = plt.subplots(1, len(data), figsize=(11.0, 3.2), sharex=True, sharey=True)
    for axis, each in zip(axes, data, strict=True):
        told = {name: figures[f"{each}: {name}"] for name in names if f"{each}: {name}" in figures}
        ours = ["surrogate", "hybrid", "reference"]
        colours = ["teal" if name in ours else "0.65" for name in told]
        places = [names.index(name) for name in told]
        axis.scatter([row["all_mm"] for row in told.values()], places, color=colours, zorder=3)
        axis.set(xscale="log", xlim=(0.05, 150.0), title=each, xlabel="mean error, mm")
        axis.set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    figure.tight_layout()
    return figure


PICTURES = {"hard-loads": hard_loads, "networks": networks, "noise": noise, "sequences": sequences, "ways": ways}


def main() -> None:
    """All pictures, as SVG beside the pages."""
    for name, draw in PICTURES.items():
        figure = draw()
        path: Path = PAGES / f"{name}.svg"
        figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
        plt.close(figure)
        print(f"written: {path.relative_to(PAGES.parents[1])}")


if __name__ == "__main__":
    main()
