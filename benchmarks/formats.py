"""Every program at hand writes one organ, one cloud, one label map, landmarks and a pose; softtwin reads each file.

What is read is compared with what was written: volume, points, cells, labels, place and unit. A file that is not read
has to be refused by a message that says why. The page docs/formats.md is made of the record. SimpleITK and PyMeshLab
write where they are installed (`pip install SimpleITK pymeshlab`; 280 MB): nothing else needs them.

    python benchmarks/formats.py                       # writes, reads, compares, records
    python benchmarks/formats.py --write docs/formats.md
"""

from __future__ import annotations

import re
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import record
from columns import Column
from harness import Benchmark, Figures, Given, run
from reading import difference, read
from written import Writer, writers

PACKAGES = {"trimesh": "trimesh", "pyvista": "pyvista", "VTK": "vtk", "meshio": "meshio", "gmsh": "gmsh",
            "nibabel": "nibabel", "pynrrd": "pynrrd", "NumPy": "numpy", "pypcd4": "pypcd4",
            "SimpleITK": "SimpleITK", "PyMeshLab": "pymeshlab"}  # fmt: skip
TITLES = {"surface": "Surfaces", "volume": "Volume meshes", "cloud": "Point clouds", "labels": "Segmentations",
          "landmarks": "Landmarks", "transform": "Poses"}  # fmt: skip
SAME, REFUSED, OTHER = "same", "refused", "other"


def by_name() -> dict[str, Writer]:
    """The writers by their names."""
    return {writer.name: writer for writer in writers()}


def work(name: str, given: Given) -> dict[str, Any]:
    """What softtwin makes of the file of one writer."""
    writer = given.once(by_name)[name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"file{writer.suffix}"
        writer.write(path)
        found = read(writer.content, path)
    said = re.sub(r"\S*file\.\S+: ", "", found.said)
    whole = {"content": writer.content, "program": writer.program, "suffix": writer.suffix, "options": writer.options}
    if found.is_refused:
        return {**whole, "outcome": REFUSED, "said": said}
    differs = difference(writer.content, writer.options, found.content)
    return {**whole, "outcome": OTHER if differs else SAME, "said": differs or said}


def versions(figures: Figures, given: Given) -> Figures:
    """Versions of the programs that wrote."""
    found = {}
    for program, package in PACKAGES.items():
        try:
            found[program] = version(package)
        except PackageNotFoundError:
            continue
    return {"programs": found}


BENCHMARK = Benchmark(
    name="formats",
    title="Files of other programs, read",
    about=("meshes/io", "meshes/cells.py", "registration/pose.py"),
    work=work,
    rows=lambda given: given.once(by_name),
    columns=(Column("outcome", "", "{outcome}"), Column("said", "", "{said}")),
    under="files",
    finish=versions,
)


def page(figures: Figures) -> str:
    """The page of the documents."""
    rows = list(figures["files"].values())
    programs = ", ".join(f"{name} {number}" for name, number in figures["programs"].items())
    counts = {outcome: sum(row["outcome"] == outcome for row in rows) for outcome in (SAME, REFUSED, OTHER)}
    lines = [
        "# Formats",
        "",
        "Made by `python benchmarks/formats.py --write docs/formats.md`: do not edit.",
        "",
        "Each program at hand wrote the same organ, cloud, label map, landmarks and pose in its options; softtwin read "
        "the files. *Same* means equal volume, points, cells, labels, place and unit. *Refused* means an error that "
        f"says why, here in short. Of {len(rows)} files {counts[SAME]} are the same, {counts[REFUSED]} are refused, "
        f"and {counts[OTHER]} differ.",
        "",
        f"Programs: {programs}. Files *by hand* have the form that a program is known to write.",
        "",
        "What softtwin does with cavities, components, structures that leave the organ, units and axes is in "
        "[From a segmentation](segmentations.md).",
    ]
    for content, title in TITLES.items():
        lines += ["", f"## {title}", "", "| format | program | options | read |", "|---|---|---|---|"]
        chosen = [row for row in rows if row["content"] == content]
        for suffix, program in dict.fromkeys((row["suffix"], row["program"]) for row in chosen):
            group = [row for row in chosen if (row["suffix"], row["program"]) == (suffix, program)]
            for outcome, said in dict.fromkeys((row["outcome"], _short(row)) for row in group):
                options = [row["options"] for row in group if (row["outcome"], _short(row)) == (outcome, said)]
                words = "; ".join(filter(None, (option.strip(", ") for option in options)))
                lines.append(f"| {suffix[1:]} | {program} | {words or '–'} | {said} |")
    return "\n".join(lines) + "\n"


def _short(row: Figures) -> str:
    if row["outcome"] == SAME:
        return SAME
    said = row["said"].replace("|", "/").rstrip(".")
    said = said if len(said) < 160 else said[:157] + "..."
    return f"{row['outcome']}: {said}"


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        Path(sys.argv[2]).write_text(page(record.recorded("formats")))
    else:
        run(BENCHMARK)
