"""What programs at hand write is read as it was written, or refused by name; damaged files are never less unsaid."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

for package in ("trimesh", "pyvista", "nibabel", "nrrd", "gmsh", "pypcd4"):
    pytest.importorskip(package, reason="a program that writes is absent")

import damaged_files
import formats
from reading import difference, read
from written import Writer, writers

WRITERS = {writer.name: writer for writer in writers()}
NOT_READ = {
    **dict.fromkeys((".off", ".glb", ".bdf", ".inp", ".ply2", ".unv", ".xdmf", ".med"), "expected a mesh file"),
    ".img": "expected a segmentation",
    ".tif": "expected a segmentation",
    ".h5": "save it as .tfm",
}
REFUSED = {
    "cloud NumPy .npy a depth image": "is it a depth image",
    "cloud by hand .csv commas, decimal commas": "are they decimal commas",
    "cloud by hand .csv names without x, y, z": "expected columns named x, y and z",
    "landmarks 3D Slicer .fcsv system IJK": "expected points in LPS or RAS",
    "transform by hand .txt a mirror": "the matrix mirrors",
    "transform ITK .tfm similarity, scale 1.05": "a scale of 1.05",
    "transform ITK .tfm B-spline": "expected one linear transform",
}


@pytest.mark.parametrize("content", ["surface", "volume", "cloud", "labels", "landmarks", "transform"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_every_writer_is_read_as_it_wrote_or_refused_by_name(content: str, tmp_path: Path) -> None:
    wrong = []
    for number, writer in enumerate(one for one in WRITERS.values() if one.content == content):
        (folder := tmp_path / str(number)).mkdir()
        path = folder / f"file{writer.suffix}"
        writer.write(path)
        found = read(content, path)
        words = REFUSED.get(writer.name) or NOT_READ.get(writer.suffix)
        if words is None and (found.is_refused or (differs := difference(content, writer.options, found.content))):
            wrong.append(f"{writer.name}: {found.said if found.is_refused else differs}")
        if words is not None and not (found.is_refused and words in found.said):
            wrong.append(f"{writer.name}: expected {words!r}, got {found.said}")
    assert not wrong


def test_the_page_is_that_of_the_record() -> None:
    page = Path(__file__).parents[2] / "docs" / "formats.md"
    assert page.read_text() == formats.page(formats.record.recorded("formats"))


@pytest.mark.parametrize("name", ["OBJ surface", "STL surface", "VTU volume", "NII.GZ labels", "TFM transform"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_damaged_files_end_no_process_and_lose_nothing_in_silence(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: dict[str, list[Writer]] = {}
    for writer in WRITERS.values():
        chosen.setdefault(f"{writer.suffix[1:].upper()} {writer.content}", []).append(writer)
    some = chosen[name][: 1 if name.startswith("VTU") else 3]
    monkeypatch.setattr(damaged_files, "by_suffix", lambda: {name: some})
    found = damaged_files.work(name, SimpleNamespace(each=6))
    assert found["files"] == 6 * len(some) and found["refused"] > 0
    assert (found["silent"], found["traceback"], found["crash"]) == (0, 0, 0), found["examples"]


def test_damage_is_of_all_kinds() -> None:
    rng = np.random.default_rng(0)
    content = b"v 0 1 2\n" * 40
    damaged = {way: damaged_files.mutated(content, way, rng) for way in damaged_files.WAYS}
    assert all(damaged[way] != content for way in ("cut", "lose", "gain", "number"))
    assert len(damaged["cut"]) < len(content) < len(damaged["gain"]) and len(damaged["change"]) == len(content)
