"""The organ that a configuration describes: surfaces as they come, attachment in words, units, axes, what is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

pytest.importorskip("pytetwild", reason="the extra mesh is absent")

from softtwin.app import organ as module
from softtwin.app.cli import _stated_unit, _with_axes, main
from softtwin.app.config import BodySection, Config, ConfigError, files_axes, parse_config
from softtwin.app.organ import make_organ
from softtwin.meshes.attachment import RegionError
from softtwin.meshes.body import Body, BodyError, Surface
from softtwin.meshes.components import ComponentError
from softtwin.meshes.export import Coordinates, write_surface
from softtwin.meshes.io import FileError, UnitWarning, read_surface
from softtwin.meshes.shapes import beam, liver_phantom

PHANTOM_SIZE = 0.016


@pytest.fixture(scope="module")
def phantom() -> Body:
    return liver_phantom(PHANTOM_SIZE)


@pytest.fixture(scope="module")
def files(phantom: Body, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The phantom's tetrahedra and its inner surfaces as files, millimetres."""
    folder = tmp_path_factory.mktemp("organ")
    meshio.Mesh(1e3 * phantom.points, [("tetra", phantom.cells)]).write(folder / "organ.vtu")
    meshio.Mesh(1e3 * phantom.points, [("triangle", phantom.boundary)]).write(folder / "organ.stl")
    for name, surface in phantom.inner.items():
        meshio.Mesh(1e3 * surface.points, [("triangle", surface.triangles)]).write(folder / f"{name}.ply")
    return folder


def section(files: Path, **entries: Any) -> BodySection:
    base: dict[str, Any] = {"source": "organ.vtu", "unit": "mm", "fixed": "halfspace:60,0,0:1,0,0"}
    return parse_config({"body": base | entries}).body


def make(files: Path, **entries: Any) -> Body:
    return make_organ(section(files, **entries), files).body


def test_a_surface_in_millimetres_becomes_a_body_in_metres_and_says_what_was_done(files: Path, phantom: Body) -> None:
    made = make_organ(section(files, source="organ.stl", nodes=300), files)
    assert made.body.volume == pytest.approx(phantom.volume, rel=0.02)
    assert made.body.points[made.body.fixed, 0].min() > 0.06
    assert any("volume before" in note for note in made.notes) and any("moved at most" in note for note in made.notes)


@pytest.mark.parametrize(
    "where",
    [
        "near:vessel_hepatic:20mm",
        "ball:8,18,-20:24",
        "ball:0.8,1.8,-2.0cm:24mm",
        "box:-200,-200,-200:200,200,-35",
        "halfspace:0,0,-35:0,0,-1",
        "ball:8,18,-20:24 + halfspace:60,0,0:1,0,0",
    ],
)
def test_what_holds_the_organ_can_be_said_in_words(files: Path, phantom: Body, where: str) -> None:
    body = make(files, fixed=where, inner={"vessel_hepatic": "vessel_hepatic.ply"})
    assert 3 <= len(body.fixed) < 0.3 * len(body.points)
    assert np.isin(body.fixed, body.boundary_nodes).all()


def test_a_union_holds_both_parts(files: Path) -> None:
    one, two = "ball:8,18,-20:24", "halfspace:60,0,0:1,0,0"
    parts = [make(files, fixed=where).fixed for where in (one, two)]
    assert np.array_equal(make(files, fixed=f"{one} + {two}").fixed, np.union1d(*parts))


def test_zones_and_the_observed_side_take_the_same_words_and_not_the_distance_of_fixed(files: Path) -> None:
    words = {"zones": {"tool": "ball:-60,-60,0:30"}, "observed": "seen-from:-60,-500,50"}
    body = make(files, **words)
    assert len(body.node_sets["tool"]) > 3
    towards = np.array([-0.06, -0.5, 0.05]) - body.points[body.surfaces["observed"]].mean(axis=1)
    a, b, c = (body.points[body.surfaces["observed"][:, i]] for i in range(3))
    assert (np.einsum("ti,ti->t", np.cross(b - a, c - a), towards) > 0).all()
    wide = make(files, **words, fixed_distance=0.03)
    assert np.array_equal(wide.node_sets["tool"], body.node_sets["tool"])
    assert np.array_equal(wide.surfaces["observed"], body.surfaces["observed"])
    file = {"zones": {"tool": "tumour.ply"}, "inner": {}}
    assert np.array_equal(
        make(files, **file, fixed_distance=0.06).node_sets["tool"], make(files, **file).node_sets["tool"]
    )


def test_a_missing_attachment_is_said_before_anything_is_meshed(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "solidify", lambda *_, **__: pytest.fail("it was meshed"))
    for entries, error, message in (
        ({"fixed": ""}, BodyError, "Give --fixed FILE"),
        ({"fixed": "veins.ply"}, FileError, "no such file"),
        ({"fixed": "near:veins:5mm"}, RegionError, r"one of \['tumour'\], got 'veins'"),
        ({"fixed": "ball:1,2:3"}, RegionError, "expected three numbers for its centre"),
        ({"zones": {"tool": "box:1,2,3"}}, RegionError, "expected box:X,Y,Z:X,Y,Z"),
    ):
        with pytest.raises(error, match=message):
            make(files, **{"source": "organ.stl", "inner": {"tumour": "tumour.ply"}} | entries)


def test_a_unit_can_stand_behind_a_file(files: Path, tmp_path: Path) -> None:
    points = np.loadtxt(_veins(files, tmp_path, 1e2))
    assert np.ptp(points) < 25
    fixed = make(files, fixed=f"{tmp_path / 'veins.txt'}:cm").fixed
    assert np.array_equal(fixed, make(files, fixed=str(_veins(files, tmp_path, 1e3))).fixed)


def _veins(files: Path, folder: Path, scale: float, turn: bool = False) -> Path:
    body = make(files)
    np.savetxt(folder / "veins.txt", scale * body.points[body.fixed] * ([-1, -1, 1] if turn else [1, 1, 1]))
    return folder / "veins.txt"


@pytest.mark.parametrize(
    ("source", "frame", "veins", "turn"),
    [
        ("organ.vtu:lps", "", ":ras", True),
        ("organ.vtu", "ras", ":lps", True),
        ("organ.vtu:ras", "lps", ":lps", True),
        ("organ.vtu:ras", "", "", False),
        ("organ.vtu", "ras", "", False),
        ("organ.vtu", "", ":ras", False),
    ],
)
def test_inside_all_is_lps(files: Path, tmp_path: Path, source: str, frame: str, veins: str, turn: bool) -> None:
    """A file on other axes than the source fits it once both are LPS; where the source says none nothing turns."""
    path = _veins(files, tmp_path, 1e3, turn=turn)
    made = section(files, source=source, frame=frame, fixed=f"{path}{veins}", fixed_distance=1e-4)
    body, plain = make_organ(made, files).body, make(files)
    assert np.array_equal(body.fixed, plain.fixed)
    sign = [-1, -1, 1] if files_axes(made) == "ras" else [1, 1, 1]
    assert np.array_equal(body.points, plain.points * sign)


@pytest.mark.parametrize(
    "where", ["ball:8,18,-20:24", "box:-200,-200,-200:200,10,-35", "halfspace:60,0,0:1,0.2,0", "seen-from:500,90,0"]
)
def test_coordinates_in_words_are_on_the_axes_of_the_source(files: Path, where: str) -> None:
    assert np.array_equal(make(files, fixed=where, source="organ.vtu:ras").fixed, make(files, fixed=where).fixed)


def test_clouds_are_read_on_the_axes_of_the_body(files: Path, tmp_path: Path) -> None:
    """A cloud beside a source in RAS must fall on the body that was made of it."""
    from softtwin.app.twin import coordinates_of
    from softtwin.meshes.io import read_cloud

    np.savetxt(tmp_path / "cloud.txt", 1e3 * make(files).points, fmt="%.17g")
    for entries in ({"source": "organ.vtu:ras"}, {"frame": "ras"}, {"source": "organ.vtu:lps"}, {}):
        config = parse_config({"body": section(files, **entries).model_dump()})
        place = coordinates_of(config)
        cloud = read_cloud(tmp_path / "cloud.txt", place.unit, place.axes)
        assert np.allclose(cloud, make(files, **entries).points, rtol=1e-15, atol=0)


def test_a_source_that_states_ras_must_be_recorded(files: Path, tmp_path: Path, phantom: Body) -> None:
    path = tmp_path / "organ.ply"
    meshio.Mesh(1e3 * phantom.points, [("triangle", phantom.boundary)]).write(path, binary=False)
    path.write_text(path.read_text().replace("element", "comment SPACE=RAS\nelement", 1))
    with pytest.raises(ConfigError, match=r"states that it is in RAS, .* write source = \".*organ\.ply:ras\""):
        make(files, source=str(path))
    assert _with_axes(str(path)) == f"{path}:ras"  # what `softtwin build` writes


@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "vtp"])
def test_a_unit_that_a_file_states_is_taken_and_none_against_it(
    files: Path, tmp_path: Path, phantom: Body, kind
) -> None:
    path, place = tmp_path / f"organ.{kind}", Coordinates("mm", "ras")
    write_surface(path, Surface(place.lengths(phantom.points), phantom.boundary), place=place)
    assert _stated_unit(str(path)) == _stated_unit(f"{path}:ras") == "mm"  # what `softtwin build` takes
    assert _stated_unit(str(tmp_path / "not yet written.stl")) is None is _stated_unit(str(files / "organ.stl"))
    with pytest.raises(ConfigError, match=r'body\.unit: .* states that it is in mm, got \'m\'; write unit = "mm"'):
        make(files, source=f"{path}:ras", unit="m")
    inner = tmp_path / f"tumour.{kind}"
    write_surface(
        inner, Surface(place.lengths(phantom.inner["tumour"].points), phantom.inner["tumour"].triangles), place=place
    )
    made = make(files, source=str(files / "organ.vtu"), frame="lps", inner={"tumour": str(inner)})
    assert np.abs(made.inner["tumour"].points.mean(0) - phantom.inner["tumour"].points.mean(0)).max() < 1e-3


def test_a_unit_that_is_said_wins_over_the_one_that_a_mesh_states(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = read_surface(files / "organ.stl", "mm")
    write_surface(tmp_path / "organ.ply", Surface(1e3 * ball.points, ball.triangles), place=Coordinates("m", "lps"))
    seen: list[Config] = []
    monkeypatch.setattr("softtwin.app.chain.build_twin", lambda config, *_: seen.append(config))
    for words, unit in ((["--unit", "mm"], "mm"), ([], "m")):
        main(["build", str(tmp_path / "organ.ply"), *words, "--fixed", "ball:0,0,0:1"])
        assert seen[-1].body.unit == unit
    assert seen[0].body.source == f"{tmp_path / 'organ.ply'}:mm:lps"
    body = {"source": seen[0].body.source, "unit": "mm", "nodes": 300, "fixed": "halfspace:0,0,0:0,0,-1"}
    notes = make_organ(parse_config({"body": body}).body, tmp_path).notes
    assert f"warning: {tmp_path / 'organ.ply'} states that it is in m; mm was taken, as you say" in notes


@pytest.mark.parametrize("component, wanted", [("near:tumour", 1), ("1", 0), ("left", 1), ("near:vein", None)])
def test_one_of_two_organs_in_a_mesh_is_chosen(
    phantom: Body, tmp_path: Path, component: str, wanted: int | None
) -> None:
    one = beam((6, 2, 2), (0.06, 0.02, 0.02), "tetrahedron")
    points = np.concatenate([1.2 * one.points, one.points + np.array([0.1, 0.0, 0.0])])
    mesh = meshio.Mesh(1e3 * points, [("tetra", np.concatenate([one.cells, one.cells + len(one.points)]))])
    mesh.write(tmp_path / "kidneys.vtk")
    tumour = phantom.inner["tumour"]
    middle = tumour.points.mean(axis=0)
    inside = 1e3 * (0.5 * (tumour.points - middle) + points[len(one.points) :].mean(axis=0))
    meshio.Mesh(inside, [("triangle", tumour.triangles)]).write(tmp_path / "tumour.ply")
    body = {"source": "kidneys.vtk", "unit": "mm", "fixed": "halfspace:0,0,5:0,0,-1"}
    body |= {"component": component} | ({"inner": {"tumour": "tumour.ply"}} if component.startswith("near") else {})
    if wanted is None:
        with pytest.raises(ComponentError, match=r"--component near:vein: expected an inner structure, one of tumour"):
            make_organ(parse_config({"body": body}).body, tmp_path)
        return
    organ = make_organ(parse_config({"body": body}).body, tmp_path)
    assert organ.body.volume == pytest.approx((1.2**3, 1.0)[wanted] * one.volume, rel=1e-9)
    assert any("in 1 others left out, as you say" in note for note in organ.notes)
    body["component"] = "largest"  # as where nothing is said: no cell of a file is lost for a default
    with pytest.raises(BodyError, match=r"expected one connected component, got 2 .* --component 1"):
        make_organ(parse_config({"body": body}).body, tmp_path)


def test_an_inner_surface_outside_the_organ_is_refused_and_a_part_outside_is_said(files: Path, tmp_path: Path) -> None:
    tumour = meshio.read(files / "tumour.ply")
    for shift, name in ((300.0, "far"), (-22.0, "partly")):
        tumour_points = tumour.points + np.array([shift, 0.0, 0.0])
        meshio.Mesh(tumour_points, tumour.cells).write(tmp_path / f"{name}.ply")
    with pytest.raises(BodyError, match=r"body\.inner\.tumour: .* all of its vertices outside, up to \d+"):
        make(files, inner={"tumour": str(tmp_path / "far.ply")})
    notes = make_organ(section(files, inner={"tumour": str(tmp_path / "partly.ply")}), files).notes
    assert any(note.startswith("warning: tumour: ") and " mm" in note and "is not known" in note for note in notes)


@pytest.mark.filterwarnings("ignore::softtwin.meshes.io.UnitWarning")
@pytest.mark.parametrize("entries", [{"nodes": 300}, {"cell_size": 0.01}])
def test_millimetres_read_as_metres_are_refused_at_once(
    files: Path, monkeypatch: pytest.MonkeyPatch, entries: dict[str, Any]
) -> None:
    monkeypatch.setattr(module, "solidify", lambda *_, **__: pytest.fail("it was meshed"))
    with pytest.raises(FileError, match=r"an organ of 5 mm to 1 m, got \d+ m across when read in m; say --unit mm"):
        make(files, source="organ.stl", unit="m", **entries)


def test_an_observed_side_that_winds_inward_is_turned_and_counted_once(files: Path, tmp_path: Path) -> None:
    body = make(files)
    inward = body.boundary[:40, ::-1]
    np.save(tmp_path / "seen.npy", np.concatenate([inward, inward]))
    made = make_organ(section(files, observed=str(tmp_path / "seen.npy")), files)
    assert np.array_equal(made.body.surfaces["observed"], body.boundary[:40])
    assert any("80 of 80 triangles wound inward" in note for note in made.notes)


def test_triangles_that_are_no_boundary_are_refused(files: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "seen.npy", make(files).cells[:3, :3])
    with pytest.raises(BodyError, match=r"triangles of the body's boundary, got \d of 3 that are not"):
        make(files, observed=str(tmp_path / "seen.npy"))


def test_node_numbers_still_work(files: Path, tmp_path: Path) -> None:
    fixed = make(files).fixed
    np.save(tmp_path / "fixed.npy", fixed)
    np.savetxt(tmp_path / "fixed.txt", fixed, fmt="%d")
    for name in ("fixed.npy", "fixed.txt"):
        assert np.array_equal(make(files, fixed=str(tmp_path / name)).fixed, fixed)


def test_node_numbers_are_those_of_the_file_where_some_of_its_nodes_are_left_out(files: Path, tmp_path: Path) -> None:
    mesh, fixed = meshio.read(files / "organ.vtu"), make(files).fixed
    points = np.concatenate([[[1e3, 0, 0]], mesh.points, [[0, 1e3, 0]]])
    meshio.Mesh(points, [("tetra", mesh.cells_dict["tetra"] + 1)]).write(tmp_path / "stray.vtu")
    np.savetxt(tmp_path / "fixed.txt", fixed + 1, fmt="%d")
    made = make_organ(section(files, source=str(tmp_path / "stray.vtu"), fixed=str(tmp_path / "fixed.txt")), files)
    assert np.array_equal(made.body.fixed, fixed) and np.array_equal(made.body.points, make(files).points)
    assert any(note.startswith(f"nodes: 2 of {len(points)} belong to no volume cell") for note in made.notes)
    np.savetxt(tmp_path / "fixed.txt", [*(fixed + 1), 0], fmt="%d")
    with pytest.raises(BodyError, match=r"that belong to cells, got 0\.\.[0-9]+ in .* of which 1 do not, first 0"):
        make(files, source=str(tmp_path / "stray.vtu"), fixed=str(tmp_path / "fixed.txt"))


def test_lone_listed_nodes_are_not_an_attachment() -> None:
    """An attachment is a surface: a listed node without a whole listed triangle is left free."""
    bare = beam((6, 2, 2), (0.6, 0.2, 0.2), "tetrahedron")
    lone = int(bare.node_sets["tip"][0])
    assert np.array_equal(module._attached(bare, np.append(bare.fixed, lone)), bare.fixed)


def test_mesh_prints_and_keeps_what_was_done(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from softtwin.app.config import Config, to_toml

    body = section(files, source=str(files / "organ.stl"), nodes=200)
    (tmp_path / "organ.toml").write_text(to_toml(Config(folder="out", body=body)))
    main(["mesh", str(tmp_path / "organ.toml")])
    said = capsys.readouterr().out
    assert "surface: moved at most" in said and "scaled Jacobian" in said
    assert "surface: moved at most" in (tmp_path / "out" / "mesh_quality.txt").read_text()


def test_the_phantom_takes_an_attachment_in_words() -> None:
    made = make_organ(BodySection(source="liver-phantom", cell_size=PHANTOM_SIZE, fixed="near:tumour:40mm"), Path("."))
    own = liver_phantom(PHANTOM_SIZE)
    assert made.body.inner.keys() == own.inner.keys() and not np.array_equal(made.body.fixed, own.fixed)
    assert replace(made, notes=()).notes == ()


def test_unit_warnings_stay_for_clouds(tmp_path: Path) -> None:
    from softtwin.meshes.io import read_cloud

    np.save(tmp_path / "cloud.npy", 100 * np.eye(3))
    with pytest.warns(UnitWarning, match="--unit mm"):
        read_cloud(tmp_path / "cloud.npy")
