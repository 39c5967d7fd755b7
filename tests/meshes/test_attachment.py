from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.attachment import (
    Ball,
    Box,
    File,
    HalfSpace,
    Near,
    RegionError,
    SeenFrom,
    boundary_nodes,
    boundary_triangles,
    parse_file,
    parse_region,
    parse_regions,
    turned,
)
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.shapes import beam


@pytest.fixture(scope="module")
def bar(request: pytest.FixtureRequest) -> Body:
    """A bar of 0.4 x 0.1 x 0.2 m with a small ball near its end at x = 0.4 m."""
    ball = request.getfixturevalue("ball")
    inner = Surface(0.2 * ball.points + np.array([0.38, 0.05, 0.1]), ball.triangles)
    return beam((8, 2, 4), (0.4, 0.1, 0.2), "tetrahedron").with_inner(vein=inner)


@pytest.mark.parametrize(
    ("text", "unit", "region"),
    [
        ("near:vein:5mm", "m", Near("vein", 0.005)),
        ("near:vein:5", "mm", Near("vein", 0.005)),
        ("near:vein", "mm", Near("vein")),
        ("ball:10,-20,35mm:1.5cm", "m", Ball((0.01, -0.02, 0.035), 0.015)),
        ("ball:10,-20,35:15", "mm", Ball((0.01, -0.02, 0.035), 0.015)),
        ("box:0,30,0:40,0,20mm", "m", Box((0.0, 0.0, 0.0), (0.04, 0.03, 0.02))),
        ("box:1,2,3cm:0,0,0mm", "m", Box((0.0, 0.0, 0.0), (0.01, 0.02, 0.03))),
        ("halfspace:0,0,12mm:0,0,-1", "cm", HalfSpace((0.0, 0.0, 0.012), (0.0, 0.0, -1.0))),
        ("seen-from:0,-4e2,1.0", "mm", SeenFrom((0.0, -0.4, 0.001))),
        ("veins.ply", "mm", File(Path("veins.ply"))),
        ("veins.ply:mm", "m", File(Path("veins.ply"), "mm")),
        ("a/veins.ply:RAS:cm", "m", File(Path("a/veins.ply"), "cm", "ras")),
    ],
)
def test_a_text_is_the_region_that_it_says(text: str, unit: str, region: object) -> None:
    assert parse_region(text, unit) == region  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("near:", "expected near:NAME or near:NAME:DISTANCE"),
        ("near:vein:-5mm", "expected a positive distance, got '-5mm'"),
        ("ball:1,2,3", "expected ball:X,Y,Z:RADIUS"),
        ("ball:1,2:3", "expected three numbers for its centre, got '1,2'"),
        ("ball:1,2,x:3", "expected a number with m, cm, mm or nothing behind it for its centre, got 'x'"),
        ("ball:1,2,3:4inch", "expected a number .* for its radius, got '4inch'"),
        ("box:1,2,3:1,2", "expected three numbers for its corner"),
        ("halfspace:0,0,0:0,0,0", "expected a normal that is not zero"),
        ("seen-from:1,2,nan", "expected a number"),
        (":mm", "expected a file"),
    ],
)
def test_what_is_no_region_is_refused_with_what_was_expected(text: str, message: str) -> None:
    with pytest.raises(RegionError, match=message):
        parse_region(text)


def test_a_file_whose_name_ends_like_a_unit_is_that_file(tmp_path: Path) -> None:
    (tmp_path / "veins:mm").touch()
    assert parse_file(str(tmp_path / "veins:mm")) == File(tmp_path / "veins:mm")
    assert str(parse_file("veins.ply:ras:mm")) == "veins.ply:mm:ras"


def test_several_regions_stand_with_a_plus_between() -> None:
    assert parse_regions("ball:0,0,0:1 + veins.ply:cm", "m") == (
        Ball((0.0, 0.0, 0.0), 1.0),
        File(Path("veins.ply"), "cm"),
    )


def test_nodes_are_those_of_the_boundary_that_lie_inside(bar: Body) -> None:
    x, y, z = bar.points[bar.boundary_nodes].T
    for text, inside in (
        ("halfspace:0.301,0,0:2,0,0", x > 0.301),
        ("box:0,0,0:0.11,1,0.06", (x < 0.11) & (z < 0.06)),
        ("ball:40,5,10cm:8cm", (x - 0.4) ** 2 + (y - 0.05) ** 2 + (z - 0.1) ** 2 <= 0.08**2),
    ):
        nodes = boundary_nodes(parse_region(text), bar)  # type: ignore[arg-type]
        assert np.array_equal(nodes, bar.boundary_nodes[inside]) and len(nodes) > 3


def test_near_is_measured_to_the_inner_surface(bar: Body) -> None:
    distance = np.linalg.norm(bar.points[bar.boundary_nodes] - [0.38, 0.05, 0.1], axis=1) - 0.01
    nodes = boundary_nodes(Near("vein", 0.06), bar)
    # The ball is a polyhedron inside its sphere.
    assert (distance[np.isin(bar.boundary_nodes, nodes)] < 0.06).all()
    assert np.isin(bar.boundary_nodes[distance < 0.0595], nodes).all()


def test_a_camera_sees_the_sides_that_face_it(bar: Body) -> None:
    seen = boundary_triangles(SeenFrom((2.0, 0.05, 0.1)), bar)
    assert np.array_equal(np.unique(seen), np.flatnonzero(bar.points[:, 0] == 0.4))
    corner = boundary_triangles(SeenFrom((2.0, 2.0, 2.0)), bar)
    sides = bar.points[corner]
    assert all((np.ptp(sides[:, :, axis], axis=1) == 0).any() for axis in range(3))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ball:0,0,-100mm:20mm", r"ball about \(0, 0, -100\) mm of radius 20 mm: holds no node .* nearest is 80\.0 mm"),
        ("near:artery:5mm", r"expected the name of an inner structure, one of \['vein'\], got 'artery'"),
        ("near:vein:0.1mm", r"near vein \(0\.1 mm\): holds no node"),
        ("seen-from:0.2,0.05,0.1", "no triangle of the boundary is seen from there"),
    ],
)
def test_a_region_that_holds_nothing_is_refused(bar: Body, text: str, message: str) -> None:
    with pytest.raises(RegionError, match=message):
        boundary_nodes(parse_region(text), bar)  # type: ignore[arg-type]


def test_turned_twice_is_the_same_region() -> None:
    for text in ("ball:1,2,3:4", "box:1,2,3:4,5,6", "halfspace:1,2,3:1,0,2", "seen-from:1,2,3", "near:a:1", "a.ply"):
        region = parse_region(text)
        assert turned(turned(region)) == region
    assert turned(Box((1, 2, 3), (4, 5, 6))) == Box((-4, -5, 3), (-1, -2, 6))
