"""Kinds of cells: quadratic bodies, sections in the plane, named surfaces as whole facets, files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.body import Body, BodyError
from softtwin.meshes.elements import KINDS
from softtwin.meshes.io import read_body, read_fields, write_body, write_deformed
from softtwin.meshes.shapes import beam

SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [2, 0], [2, 1]])
PLANE = {"triangle": [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]], "quad": [[0, 1, 2, 3], [1, 4, 5, 2]]}


def made(name: str) -> Body:
    """A small body of each kind: a box 0.6 x 0.2 x 0.2, or a rectangle 2 x 1."""
    linear = {"triangle6": "triangle", "quad9": "quad", "tetra10": "tetra", "hexahedron27": "hexahedron"}.get(
        name, name
    )
    if linear in PLANE:
        right = np.array([[4, 5]])
        body = Body(SQUARE, np.array(PLANE[linear]), {"fixed": np.array([0, 3])}, {"end": right})
    else:
        bare = beam((3, 2, 2), (0.6, 0.2, 0.2), "tetrahedron" if linear == "tetra" else linear)
        end = bare.boundary[np.isin(bare.boundary, bare.node_sets["tip"]).all(axis=1)]
        body = Body(bare.points, bare.cells, dict(bare.node_sets), {"end": end})
    return body if linear == name else body.quadratic()


@pytest.fixture(params=[kind.name for kind in KINDS.values()])
def body(request: pytest.FixtureRequest) -> Body:
    return made(request.param)


def test_volume_and_boundary_are_those_of_the_box(body: Body) -> None:
    size = np.ptp(body.points, axis=0)
    assert body.volume == pytest.approx(np.prod(size))
    outer = np.unique(body.boundary)
    low = body.points.min(axis=0)
    on_a_side = (np.isclose(body.points, low) | np.isclose(body.points, low + size)).any(axis=1)
    np.testing.assert_array_equal(outer, np.flatnonzero(on_a_side))


def test_named_surfaces_are_whole_facets(body: Body) -> None:
    facets = body.facets_of("end")
    x = body.points[:, 0]
    assert np.allclose(x[facets], x.max())
    pieces = {tuple(sorted(piece)) for piece in body.surfaces["end"].tolist()}
    assert len(pieces) == len(facets) * len(body.kind.pieces)


def test_sets_grow_with_the_degree(body: Body) -> None:
    on_the_left = np.flatnonzero(np.isclose(body.points[:, 0], body.points[:, 0].min()))
    np.testing.assert_array_equal(body.fixed, on_the_left)
    assert body.is_straight


def test_every_body_comes_back_from_its_file(body: Body, tmp_path: Path) -> None:
    field = np.random.default_rng(0).standard_normal(body.points.shape)
    write_body(tmp_path / "body.vtu", body, {"mode 000": field, "eigenvalues": np.arange(3.0)})
    again, fields = read_body(tmp_path / "body.vtu"), read_fields(tmp_path / "body.vtu")
    assert again.fingerprint == body.fingerprint and again.kind is body.kind
    np.testing.assert_array_equal(again.surfaces["end"], body.surfaces["end"])
    np.testing.assert_array_equal(fields["mode 000"], field)
    np.testing.assert_array_equal(fields["eigenvalues"], np.arange(3.0))
    write_deformed(tmp_path / "deformed.vtu", body, 1e-3 * field)


def test_a_part_of_a_facet_is_no_surface() -> None:
    whole = made("hexahedron")
    half = Body(whole.points, whole.cells, dict(whole.node_sets), {"half": whole.boundary[:1]})
    with pytest.raises(BodyError, match=r"Body\.surfaces\['half'\]: expected whole facets of the boundary \(2 pieces"):
        half.facets_of("half")
    with pytest.raises(BodyError, match=r"expected one of \['half'\], got 'other'"):
        half.facets_of("other")


def test_curved_cells_are_not_straight() -> None:
    straight = made("tetra10")
    points = straight.points.copy()
    points[-1] += 1e-3
    assert not Body(points, straight.cells, dict(straight.node_sets)).is_straight


def test_inverted_cells_in_the_plane_are_refused() -> None:
    with pytest.raises(BodyError, match=r"got 1 inverted or flat ones of 1"):
        Body(SQUARE[:4], np.array([[0, 3, 2, 1]]), {"fixed": np.array([0, 3])})
