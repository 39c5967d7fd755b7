"""Whatever order, unit or end a file has: the same body, or a clear refusal."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("hypothesis", reason="hypothesis is absent")

from hypothesis import given, settings
from hypothesis import strategies as st

from softtwin.meshes.body import Surface
from softtwin.meshes.checks import put_in_order
from softtwin.meshes.export import write_surface
from softtwin.meshes.io import FileError, Unit, in_metres, read_body, read_cloud, read_surface, read_volume, write_body
from softtwin.meshes.metrics import cell_volumes
from softtwin.meshes.shapes import beam

QUICK = settings(max_examples=40, deadline=None)
SUFFIXES = st.sampled_from([".stl", ".ply", ".obj", ".vtp"])
_PER_METRE = {"m": 1.0, "cm": 1e2, "mm": 1e3}


def block() -> Surface:
    body = beam((3, 2, 2), (0.09, 0.06, 0.06), "hexahedron")
    used, numbers = np.unique(body.boundary, return_inverse=True)
    return Surface(body.points[used], numbers.reshape(-1, 3))


BLOCK = block()


def shuffled(surface: Surface, seed: int) -> Surface:
    """The same surface with vertices and triangles in another order, each triangle begun elsewhere."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(surface.points))
    numbers = np.argsort(order)
    triangles = numbers[surface.triangles][rng.permutation(len(surface.triangles))]
    turned = np.stack([np.roll(t, k) for t, k in zip(triangles, rng.integers(3, size=len(triangles)), strict=True)])
    return Surface(surface.points[order], turned)


@QUICK
@given(suffix=SUFFIXES, seed=st.integers(0, 2**32 - 1), unit=st.sampled_from(["m", "cm", "mm"]))
def test_order_and_unit_do_not_change_a_surface(suffix: str, seed: int, unit: Unit) -> None:
    other = shuffled(BLOCK, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write_surface(path, Surface(_PER_METRE[unit] * other.points, other.triangles))
        ordered, defects = put_in_order(read_surface(path, unit))
    assert ordered.volume == pytest.approx(BLOCK.volume, rel=1e-6)
    assert defects.open_edges == defects.clashing_edges == defects.crowded_edges == 0


@QUICK
@given(suffix=SUFFIXES, data=st.data())
def test_a_surface_that_is_cut_off_is_whole_refused_or_open(suffix: str, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write_surface(path, BLOCK)
        content = path.read_bytes()
        path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
        try:
            ordered, defects = put_in_order(read_surface(path, "m"))
        except FileError as error:
            assert str(path) in str(error)
            return
    assert defects.open_edges > 0 or ordered.volume == pytest.approx(BLOCK.volume, rel=1e-6)


@QUICK
@given(suffix=st.sampled_from([".stl", ".obj", ".ply"]), tail=st.binary(max_size=60))
def test_bytes_behind_the_end_change_nothing_or_are_refused(suffix: str, tail: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write_surface(path, BLOCK)
        path.write_bytes(path.read_bytes() + tail)
        try:
            found = put_in_order(read_surface(path, "m"))[0]
        except FileError:
            return
    assert found.volume == pytest.approx(BLOCK.volume, rel=1e-6)


@QUICK
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["tetrahedron", "hexahedron"]))
def test_cells_in_another_order_are_the_same_volume(seed: int, kind: str) -> None:
    body, rng = beam((2, 2, 1), (0.06, 0.06, 0.03), kind), np.random.default_rng(seed)  # type: ignore[arg-type]
    order = rng.permutation(len(body.points))
    cells = np.argsort(order)[body.cells][rng.permutation(len(body.cells))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.vtu"
        write_body(path, type(body)(body.points[order], cells, {}))
        assert np.array_equal(read_body(path).cells, cells)
        points, found = read_volume(path)
    assert cell_volumes(points, found).sum() == pytest.approx(cell_volumes(body.points, body.cells).sum(), rel=1e-12)


@QUICK
@given(
    points=st.lists(st.tuples(*[st.floats(-0.4, 0.4, allow_nan=False)] * 3), min_size=2, max_size=20, unique=True),
    separator=st.sampled_from([" ", "\t", ";", ",", ", "]),
    is_local=st.booleans(),
    unit=st.sampled_from(["m", "cm", "mm"]),
)
def test_a_table_in_any_locale_is_the_same_cloud(
    points: list[tuple[float, float, float]], separator: str, is_local: bool, unit: Unit
) -> None:
    array = np.array(points) + np.array([1e-9, 0.0, 0.0])  # rows of zeros are no points
    rows = [separator.join(f"{value:.17g}" for value in row) for row in array.tolist()]
    text = f"x{separator}y{separator}z\n" + "\n".join(rows) + "\n"
    if is_local and "," not in separator:
        text = text.replace(".", ",")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.txt").write_text(text)
        found = read_cloud(Path(folder) / "a.txt", unit)
    assert np.array_equal(found, in_metres(array, unit))
