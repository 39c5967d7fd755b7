import logging
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from softtwin.meshes.body import Body, BodyError, Surface
from softtwin.meshes.grid import gridded
from softtwin.meshes.io import (
    ContentError,
    FileError,
    UnitWarning,
    Volume,
    read_body,
    read_cloud,
    read_mesh,
    read_points,
    read_surface,
    read_volume,
    stated_axes,
    write_body,
    write_deformed,
)
from softtwin.meshes.shapes import beam

LIVER = Path(__file__).parents[2].parent / "shared" / "data" / "liver"


def _save(path: Path, surface: Surface, scale: float = 1.0, **options: object) -> Path:
    if path.suffix == ".vtp":
        return _save_vtp(path, surface, scale)
    meshio.Mesh(surface.points * scale, [("triangle", surface.triangles)]).write(path, **options)
    return path


def _save_vtp(path: Path, surface: Surface, scale: float) -> Path:
    numbers = " ".join(map(str, (surface.points * scale).ravel().tolist()))
    corners = " ".join(map(str, surface.triangles.ravel().tolist()))
    ends = " ".join(str(3 * i + 3) for i in range(len(surface.triangles)))
    path.write_text(
        f"""<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>
<Piece NumberOfPoints="{len(surface.points)}" NumberOfPolys="{len(surface.triangles)}">
<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">{numbers}</DataArray></Points>
<Polys><DataArray type="Int64" Name="connectivity" format="ascii">{corners}</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">{ends}</DataArray></Polys></Piece></PolyData></VTKFile>"""
    )
    return path


def _equal(first: Body, second: Body) -> None:
    assert first.fingerprint == second.fingerprint
    assert list(first.node_sets) == list(second.node_sets) and list(first.surfaces) == list(second.surfaces)
    assert all(np.array_equal(second.node_sets[name], nodes) for name, nodes in first.node_sets.items())
    assert all(np.array_equal(second.surfaces[name], part) for name, part in first.surfaces.items())
    assert list(first.inner) == list(second.inner)
    for name, surface in first.inner.items():
        assert surface.points.tobytes() == second.inner[name].points.tobytes()
        assert np.array_equal(surface.triangles, second.inner[name].triangles)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".vtk", ".vtu", ".vtp", ".msh"])
def test_a_surface_in_millimetres_comes_back_in_metres(suffix: str, tmp_path: Path, ball: Surface) -> None:
    surface = read_surface(_save(tmp_path / f"ball{suffix}", ball, scale=1000), unit="mm")
    assert len(surface.points) == len(ball.points) and len(surface.triangles) == len(ball.triangles)
    # STL holds single precision.
    assert surface.volume == pytest.approx(ball.volume, rel=1e-6)


def test_a_binary_stl_is_read_like_a_text_one(tmp_path: Path, ball: Surface) -> None:
    path = _save(tmp_path / "ball.stl", ball, scale=1000, binary=True)
    path.write_bytes(b"solid made by a program that lies".ljust(80) + path.read_bytes()[80:])
    surface = read_surface(path, unit="mm")
    assert len(surface.points) == len(ball.points)
    assert surface.volume == pytest.approx(ball.volume, rel=1e-6)


def test_quadrilaterals_become_triangles(tmp_path: Path) -> None:
    box = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    meshio.Mesh(box, [("quad", quads)]).write(tmp_path / "box.vtk")
    surface = read_surface(tmp_path / "box.vtk")
    assert len(surface.triangles) == 12 and abs(surface.volume) == pytest.approx(1e-3, rel=1e-12)


def test_ras_axes_are_turned_and_the_winding_kept(tmp_path: Path, ball: Surface) -> None:
    path = _save(tmp_path / "ball.ply", Surface(ball.points + np.array([0.1, 0.2, 0.3]), ball.triangles))
    lps, ras = read_surface(path), read_surface(path, axes="ras")
    assert np.array_equal(ras.points, lps.points * [-1, -1, 1])
    assert ras.volume == pytest.approx(ball.volume, rel=1e-12)


def test_millimetres_read_as_metres_warn_with_the_size_and_the_flag(tmp_path: Path, ball: Surface) -> None:
    path = _save(tmp_path / "liver.stl", Surface(2.5 * ball.points, ball.triangles), scale=1000)
    with pytest.warns(UnitWarning, match=r"liver\.stl is 250 m across when read in m, .*; say --unit mm, .* 250 mm"):
        read_surface(path)
    with pytest.warns(UnitWarning, match=r"is 2\.5 m across when read in cm, .*; say --unit mm, in which it is 250 mm"):
        read_surface(path, unit="cm")


def test_an_organ_of_a_tenth_of_a_millimetre_warns(tmp_path: Path, ball: Surface) -> None:
    with pytest.warns(UnitWarning, match=r"is 0\.0001 m across when read in mm"):
        read_surface(_save(tmp_path / "ball.ply", ball), unit="mm")


@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
@pytest.mark.parametrize("suffix", [".vtk", ".vtu", ".msh"])
def test_a_volume_mesh_comes_back_exactly(suffix: str, kind: str, tmp_path: Path) -> None:
    body = beam((3, 2, 2), kind=kind)  # type: ignore[arg-type]
    name = "tetra" if kind == "tetrahedron" else "hexahedron"
    meshio.Mesh(body.points, [("triangle", body.boundary), (name, body.cells)]).write(tmp_path / f"beam{suffix}")
    points, cells = read_volume(tmp_path / f"beam{suffix}")
    assert points.tobytes() == body.points.tobytes() and np.array_equal(cells, body.cells)
    volume = read_mesh(tmp_path / f"beam{suffix}")
    assert isinstance(volume, Volume) and volume.said == () and np.array_equal(volume.numbers, range(len(points)))


def test_read_mesh_gives_a_surface_where_there_is_no_volume(tmp_path: Path, ball: Surface) -> None:
    assert isinstance(read_mesh(_save(tmp_path / "ball.stl", ball)), Surface)


@pytest.mark.parametrize("kind", ["tetra", "hexahedron"])
def test_cells_that_are_all_inside_out_are_turned_with_a_note(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    body = beam((3, 2, 2), kind="tetrahedron" if kind == "tetra" else "hexahedron")
    order = [1, 0, 2, 3] if kind == "tetra" else [3, 2, 1, 0, 7, 6, 5, 4]
    meshio.Mesh(body.points, [(kind, body.cells[:, order])]).write(tmp_path / "beam.vtk")
    with caplog.at_level(logging.INFO):
        points, cells = read_volume(tmp_path / "beam.vtk")
    assert f"all {len(body.cells)} cells were inside out" in caplog.text
    assert Body(points, cells, body.node_sets).volume == pytest.approx(body.volume, rel=1e-12)


def test_some_inverted_tetrahedra_are_left_for_the_body_to_refuse(tmp_path: Path) -> None:
    body = beam((3, 2, 2), kind="tetrahedron")
    cells = body.cells.copy()
    cells[:2] = cells[:2, [1, 0, 2, 3]]
    meshio.Mesh(body.points, [("tetra", cells)]).write(tmp_path / "beam.vtk")
    with pytest.raises(BodyError, match="got 2 inverted or flat ones"):
        Body(*read_volume(tmp_path / "beam.vtk"), body.node_sets)


def test_nodes_of_no_cell_are_left_out_and_counted(tmp_path: Path) -> None:
    body = beam((3, 2, 2), kind="tetrahedron")
    points = np.concatenate([[[9.0, 9.0, 9.0]], body.points])
    meshio.Mesh(points * 0.1, [("tetra", body.cells + 1)]).write(tmp_path / "beam.vtk")
    read = read_mesh(tmp_path / "beam.vtk")
    assert isinstance(read, Volume) and np.array_equal(read.cells, body.cells)
    assert np.array_equal(read.numbers, np.arange(len(body.points)) + 1)
    assert read.said == (f"nodes: 1 of {len(points)} belong to no volume cell and were left out",)
    assert np.array_equal(read_volume(tmp_path / "beam.vtk")[0], 0.1 * body.points)


def test_a_surface_where_a_volume_is_wanted_is_refused(tmp_path: Path, ball: Surface) -> None:
    with pytest.raises(FileError, match=r"expected a volume mesh .* got 258 points and cells: 512 triangle; a surface"):
        read_volume(_save(tmp_path / "ball.vtk", ball))


def test_a_volume_where_a_surface_is_wanted_is_refused(tmp_path: Path) -> None:
    body = beam((2, 1, 1))
    meshio.Mesh(body.points, [("hexahedron", body.cells)]).write(tmp_path / "beam.vtu")
    with pytest.raises(FileError, match="expected a surface of triangles, got 12 points and cells: 2 hexahedron"):
        read_surface(tmp_path / "beam.vtu")


@pytest.mark.parametrize("read", [read_mesh, read_surface, read_volume, read_cloud, read_body])
def test_missing_and_empty_files_and_folders_are_refused(read, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "empty.vtu").touch()
    (tmp_path / "folder.vtu").mkdir()
    for name, reason in (("none", "no such file"), ("empty", "the file is empty"), ("folder", "got a folder")):
        with pytest.raises(FileError, match=rf"{name}\.vtu: .*{reason}"):
            read(tmp_path / f"{name}.vtu")


def test_an_unknown_suffix_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "scan.dcm").write_text("x")
    with pytest.raises(FileError, match=r"expected a mesh file \(\.stl, .*\.vtp\), got suffix '\.dcm'"):
        read_surface(tmp_path / "scan.dcm")


def test_what_is_no_cloud_is_told_all_that_are(tmp_path: Path) -> None:
    np.savez(tmp_path / "cloud.npz", points=np.zeros((5, 3)))
    known = r"\(\.txt, .*\.npy, .*\.pcd, .*\.ply, .*\)"
    with pytest.raises(FileError, match=rf"expected a file of a cloud {known}, got suffix '\.npz'"):
        read_cloud(tmp_path / "cloud.npz")


# An OBJ counts nothing in advance: cut off among its triangles it is an open surface, which solidify refuses.
@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtk", ".vtu", ".vtp", ".msh"])
@pytest.mark.parametrize("kept", [0.3, 0.8])
def test_a_truncated_file_is_refused(
    suffix: str, kept: float, tmp_path: Path, ball: Surface, capfd: pytest.CaptureFixture[str]
) -> None:
    path = _save(tmp_path / f"ball{suffix}", ball, **({"binary": True} if suffix == ".stl" else {}))
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    capfd.readouterr()  # what meshio said while it wrote
    with pytest.raises(FileError, match=r"truncated|damaged"):
        read_surface(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".vtk", ".vtu", ".vtp", ".msh"])
def test_a_file_of_something_else_is_refused(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"novel{suffix}"
    path.write_bytes(b"It was a bright cold day in April.\n" * 20)
    with pytest.raises(FileError, match=path.name):
        read_surface(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_a_body_comes_back_bit_for_bit(kind: str, tmp_path: Path, ball: Surface) -> None:
    plain = beam((3, 2, 2), (0.1 / 3, 0.07, 1 / 7), kind)  # type: ignore[arg-type]
    body = Body(
        plain.points,
        plain.cells,
        {**plain.node_sets, 'größe "quoted" <&>': [1, 2], "empty": np.empty(0, int)},
        {"observed": plain.boundary[:5], "none": np.empty((0, 3), int)},
        {"tumour": ball, "vessel": Surface(ball.points / 3, ball.triangles)},
    )
    write_body(tmp_path / "body.vtu", body)
    _equal(body, read_body(tmp_path / "body.vtu"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["body.vtu"]


def test_fractions_come_back_bit_for_bit(tmp_path: Path) -> None:
    plain = beam((3, 2, 2), (0.3, 0.2, 0.1))
    sparse = Body(plain.points, plain.cells, plain.node_sets, fractions=np.linspace(0.1, 1.0, len(plain.cells)) / 3)
    write_body(tmp_path / "body.vtu", sparse)
    _equal(sparse, read_body(tmp_path / "body.vtu"))
    write_body(tmp_path / "plain.vtu", plain)
    read = read_body(tmp_path / "plain.vtu")
    assert read.fractions is None and read.skin is None


def test_a_skin_comes_back_bit_for_bit(tmp_path: Path) -> None:
    body = gridded(beam((4, 2, 2), (0.4, 0.2, 0.2), "tetrahedron"), 0.07)
    body = replace(body, surfaces={"observed": body.skin.triangles[:7]})
    write_body(tmp_path / "body.vtu", body)
    read = read_body(tmp_path / "body.vtu")
    _equal(body, read)
    assert np.array_equal(read.skin.points, body.skin.points)
    assert np.array_equal(read.skin.triangles, body.skin.triangles)


def test_the_liver_phantom_comes_back_bit_for_bit(tmp_path: Path, liver: Body) -> None:
    write_body(tmp_path / "liver.vtu", liver)
    _equal(liver, read_body(tmp_path / "liver.vtu"))


def test_a_mesh_that_is_no_body_is_refused(tmp_path: Path) -> None:
    body = beam((2, 1, 1))
    meshio.Mesh(body.points, [("hexahedron", body.cells)]).write(tmp_path / "beam.vtu")
    with pytest.raises(FileError, match="not a body written by softtwin"):
        read_body(tmp_path / "beam.vtu")


def test_a_truncated_body_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "body.vtu"
    write_body(path, beam())
    content = path.read_bytes()
    for kept in (0.2, 0.6, 0.95):
        path.write_bytes(content[: int(kept * len(content))])
        with pytest.raises((FileError, BodyError)):
            read_body(path)
    assert capfd.readouterr() == ("", "")


def test_a_body_cannot_be_written_where_there_is_no_folder(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FileError, match="could not be written; is the folder there"):
        write_body(tmp_path / "none" / "body.vtu", beam())
    with pytest.raises(FileError, match=r"expected the suffix \.vtu, got '\.stl'"):
        write_body(tmp_path / "body.stl", beam())
    assert capfd.readouterr() == ("", "")


def test_a_deformed_body_holds_its_positions_and_fields(tmp_path: Path) -> None:
    body = beam((3, 2, 2))
    moved = np.random.default_rng(0).normal(size=body.points.shape)
    fields = {"energy": np.arange(len(body.cells)), "force": 2 * moved}
    write_deformed(tmp_path / "now.vtu", body, moved, fields)
    mesh = meshio.read(tmp_path / "now.vtu")
    assert np.array_equal(mesh.points, body.points + moved)
    assert np.array_equal(mesh.point_data["displacement"], moved)
    assert np.array_equal(mesh.point_data["force"], 2 * moved)
    assert np.array_equal(mesh.cell_data["energy"][0], fields["energy"])
    with pytest.raises(ValueError, match=r"fields\['energy'\]: expected a row for each of 36 nodes or 12 cells"):
        write_deformed(tmp_path / "now.vtu", body, moved, {"energy": np.ones(5)})
    with pytest.raises(ValueError, match=r"displacement: expected shape \(36, 3\), got \(35, 3\)"):
        write_deformed(tmp_path / "now.vtu", body, moved[1:])


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".npy", ".ply", ".vtp", ".xyz"])
def test_a_cloud_comes_back_in_metres(suffix: str, tmp_path: Path, ball: Surface) -> None:
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".npy":
        np.save(path, 1000 * ball.points)
    elif suffix in (".ply", ".vtp"):
        _save(path, ball, scale=1000)
    else:
        comma = suffix == ".csv"
        np.savetxt(path, 1000 * ball.points, fmt="%.17g", delimiter="," if comma else " ", header="x,y,z" * comma)
    # Times a thousand and back: two roundings.
    assert np.allclose(read_cloud(path, unit="mm"), ball.points, rtol=2 * np.finfo(float).eps, atol=0)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rows.txt", "1 2 3\n4 5\n", "expected rows of three numbers"),
        ("words.txt", "1 2 3\n4 five 6\n", "expected rows of three numbers"),
        ("flat.csv", "1,2\n3,4\n", r"expected a cloud of shape \(p, 3\), got \(2, 2\)"),
        ("head.csv", "x,y,z\n", "expected a cloud with points, got none"),
        ("blank.txt", "\n\n", "expected a cloud with points, got none"),
        ("fake.npy", "not an array", "expected rows of three numbers"),
    ],
)
def test_a_damaged_cloud_is_refused(name: str, content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(FileError, match=message):
        read_cloud(tmp_path / name)


def test_unshared_vertices_are_merged_in_any_format(tmp_path: Path, ball: Surface) -> None:
    points = ball.points[ball.triangles].reshape(-1, 3)
    torn = Surface(points, np.arange(len(points)).reshape(-1, 3))
    for suffix in (".obj", ".ply", ".vtk"):
        surface = read_surface(_save(tmp_path / f"torn{suffix}", torn))
        assert len(surface.points) == len(ball.points) and surface.volume == pytest.approx(ball.volume, rel=1e-9)


@pytest.mark.parametrize("kept", [0.5, 0.99])
@pytest.mark.parametrize("binary", [True, False])
def test_a_truncated_stl_is_called_truncated(binary: bool, kept: float, tmp_path: Path, ball: Surface) -> None:
    path = _save(tmp_path / "ball.stl", ball, binary=binary)
    lines = path.read_bytes()
    # An STL as text is cut after a whole facet, where nothing but its missing end shows it.
    cut = int(kept * len(lines)) if binary else lines.rindex(b"endfacet", 0, int(kept * len(lines))) + 9
    path.write_bytes(lines[:cut])
    with pytest.raises(FileError, match="the STL is truncated"):
        read_surface(path)


_FIRST_MSH = """$NOD
5
1 0 0 0
3 0.1 0 0
4 0 0.1 0
7 0 0 0.1
9 0.1 0.1 0.1
$ENDNOD
$ELM
3
1 2 0 0 3 1 4 3
2 4 0 0 4 1 3 4 7
3 4 0 0 4 3 9 4 7
$ENDELM
"""


def test_an_msh_of_version_1_is_read_with_its_own_node_numbers(tmp_path: Path) -> None:
    (tmp_path / "old.msh").write_text(_FIRST_MSH)
    points, cells = read_volume(tmp_path / "old.msh")
    assert points.shape == (5, 3) and cells.tolist() == [[0, 1, 2, 3], [1, 4, 2, 3]]
    (tmp_path / "cut.msh").write_text(_FIRST_MSH[: _FIRST_MSH.index("$ENDELM")])
    with pytest.raises(FileError, match=r"cut\.msh: could not be read as msh; .*MSH 1: .* save it as MSH 2 or 4"):
        read_volume(tmp_path / "cut.msh")


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_cloud_is_read_without_its_empty_pixels(encoding: str, tmp_path: Path, ball: Surface) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    points = ball.points.astype(np.float32)
    points[3] = np.nan
    fields = np.column_stack([points, np.arange(len(points), dtype=np.float32)])
    cloud = pypcd4.PointCloud.from_xyzi_points(fields)
    cloud.save(tmp_path / "cloud.pcd", pypcd4.Encoding(encoding))
    assert np.array_equal(read_cloud(tmp_path / "cloud.pcd"), np.delete(points, 3, axis=0).astype(float))
    content = (tmp_path / "cloud.pcd").read_bytes()
    (tmp_path / "cut.pcd").write_bytes(content[: int(0.7 * len(content))])
    with pytest.raises(FileError, match="truncated or damaged"):
        read_cloud(tmp_path / "cut.pcd")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rows_without_a_measurement_are_left_out_and_counted(value: float, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "cloud.txt", [[0.1, 0.2, 0.3], [0.1, value, 0.3], [0.2, 0.2, 0.3]])
    cloud = read_points(tmp_path / "cloud.txt")
    assert cloud.points.tolist() == [[0.1, 0.2, 0.3], [0.2, 0.2, 0.3]] and cloud.rows == 3
    assert cloud.said == ("points: 1 of 3 rows have no measurement (NaN or infinity) and were left out",)
    np.savetxt(tmp_path / "cloud.txt", [[0.1, value, 0.3], [value, value, value]])
    with pytest.raises(ContentError, match="expected a cloud with measured points, got 2 rows without one"):
        read_cloud(tmp_path / "cloud.txt")


def test_zeros_are_pixels_without_a_measurement_but_one_point_may_be_the_origin(tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", [[[0.1, 0.2, 0.3], [0, 0, 0]], [[0, 0, 0], [0.2, 0.0, 0.3]]])
    cloud = read_points(tmp_path / "cloud.npy")
    assert cloud.points.tolist() == [[0.1, 0.2, 0.3], [0.2, 0.0, 0.3]] and "2 of 4 rows are zeros" in cloud.said[0]
    np.save(tmp_path / "cloud.npy", [[0.1, 0.2, 0.3], [0, 0, 0], [0.2, 0.0, 0.3]])
    assert len(read_points(tmp_path / "cloud.npy").points) == 3


def test_a_text_cloud_cut_in_the_middle_of_a_number_is_refused(tmp_path: Path, ball: Surface) -> None:
    for form in ("%.6f", "%.8e"):
        np.savetxt(tmp_path / "cloud.txt", ball.points, fmt=form)
        text = (tmp_path / "cloud.txt").read_text()
        (tmp_path / "cut.txt").write_text(text[:-2])
        with pytest.raises(FileError, match=r"cut\.txt: .* fewer digits"):
            read_cloud(tmp_path / "cut.txt")
        (tmp_path / "whole.txt").write_text(text[:-1])  # an editor that writes no last line end
        assert len(read_cloud(tmp_path / "whole.txt")) == len(ball.points)
    (tmp_path / "free.txt").write_text("0 1 .25\n0 1 .5\n0 1 .125\n0 1 1")
    assert len(read_cloud(tmp_path / "free.txt")) == 4


def test_axes_are_found_where_the_file_states_it(tmp_path: Path, ball: Surface) -> None:
    path = _save(tmp_path / "ball.stl", ball, binary=True)
    assert stated_axes(path) is None
    content = path.read_bytes()
    path.write_bytes(b"3D Slicer output. SPACE=RAS".ljust(80) + content[80:])
    assert stated_axes(path) == "ras" and len(read_surface(path).points) == len(ball.points)


def test_unknown_units_and_axes_are_refused(tmp_path: Path, ball: Surface) -> None:
    path = _save(tmp_path / "ball.ply", ball)
    with pytest.raises(ValueError, match="unit: expected 'm', 'cm' or 'mm', got 'inch'"):
        read_surface(path, unit="inch")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="axes: expected 'lps' or 'ras', got 'xyz'"):
        read_surface(path, axes="xyz")  # type: ignore[arg-type]


@pytest.mark.liver
@pytest.mark.skipif(not LIVER.is_dir(), reason="the real liver is not in ../shared/data")
@pytest.mark.parametrize(("mesh", "nodes"), [("mesh-default", 3046), ("mesh-remeshed", 3829)])
def test_the_real_liver_is_a_body(mesh: str, nodes: int, tmp_path: Path) -> None:
    points, cells = read_volume(LIVER / mesh / "liver.msh")
    body = Body(
        points,
        cells,
        {"fixed": np.load(LIVER / mesh / "dirichlet-vertices.npy")},
        {"observed": np.load(LIVER / mesh / "matching-triangles.npy")},
    )
    assert len(body.points) == nodes and 1.4e-3 < body.volume < 1.45e-3
    write_body(tmp_path / "liver.vtu", body)
    _equal(body, read_body(tmp_path / "liver.vtu"))
    assert read_cloud(LIVER / "sequences/neohookean/s1/pointclouds/pc00.txt").shape == (500, 3)
