"""Displacement fields: exact in the cells, each the other's inverse, and read from their files as ITK and pynrrd do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nrrd
import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.displacement import (
    DisplacementField,
    Region,
    forward_field,
    inverse_field,
    read_displacement,
    region_path,
    write_displacement,
)
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import FileError
from softtwin.meshes.quadrature import shape_functions
from softtwin.meshes.shapes import beam

CLOSE = 1e-6  # metres


def bodies() -> dict[str, Body]:
    shapes = {shape: beam((8, 3, 3), (0.20, 0.06, 0.06), shape) for shape in ("tetrahedron", "hexahedron")}
    return {**shapes, "quadratic tetrahedron": shapes["tetrahedron"].quadratic()}


BODIES = bodies()


@pytest.fixture(params=BODIES)
def body(request) -> Body:
    """Away from the origin, so that no axis may be turned unnoticed."""
    made = BODIES[request.param]
    return replace(made, points=made.points + np.array([0.03, -0.11, 0.23]))


def bent(body: Body) -> np.ndarray:
    """A bend by about three centimetres with a twist and a stretch, as large as organs see."""
    x, y, z = (body.points - body.points.min(axis=0)).T
    return np.stack([0.05 * x - 0.4 * x * z, 1.2 * x * (z - 0.03), 0.8 * x**2 - 1.2 * x * (y - 0.03)], axis=1)


def inner_points(body: Body, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Points of the body at rest, (p, 3), and how its shape functions move them."""
    rng = np.random.default_rng(0)
    cells = body.cells[rng.integers(len(body.cells), size=count)]
    local = rng.dirichlet(np.ones(4), size=count)[:, :3] if body.is_tetrahedral else rng.random((count, 3))
    weights = shape_functions(body.kind, local)[0]
    return tuple(np.einsum("pk,pki->pi", weights, field[cells]) for field in (body.points, bent(body)))  # type: ignore[return-value]


def test_the_fields_are_the_movement_and_its_inverse(body: Body) -> None:
    """At any point of the organ, up to its surface; half of what is allowed is seen, at kinks and at the rim."""
    points, moved = inner_points(body)
    forward, inverse = forward_field(body, bent(body)), inverse_field(body, bent(body))
    assert np.linalg.norm(moved, axis=1).max() > 5.0 * forward.spacing  # there is something to find
    assert np.linalg.norm(forward.at(points) - moved, axis=1).max() < 0.15 * forward.spacing
    assert np.linalg.norm(inverse.at(points + moved) + moved, axis=1).max() < 0.15 * forward.spacing


def test_there_and_back_again_is_where_one_was(body: Body) -> None:
    points, _ = inner_points(body)
    forward, inverse = forward_field(body, bent(body)), inverse_field(body, bent(body))
    there = points + forward.at(points)
    off = np.linalg.norm(there + inverse.at(there) - points, axis=1) / forward.spacing
    assert off.max() < 0.2 and off.mean() < 0.02  # voxels


def test_voxels_in_the_organ_are_exact(body: Body) -> None:
    """The inverse's voxels are moved back by the cells' own functions: to rounding, not to a voxel."""
    inverse = inverse_field(body, bent(body))
    places = np.argwhere(inverse.region == Region.ORGAN)
    at = inverse.origin + inverse.spacing * places
    rest = at + inverse.vectors[tuple(places.T)]
    there = rest + forward_field(body, bent(body), 0.5 * inverse.spacing).at(rest)
    assert np.linalg.norm(there - at, axis=1).mean() < 0.02 * inverse.spacing
    share = len(places) * inverse.spacing**3
    assert share == pytest.approx(_volume(body, body.points + bent(body)), rel=0.03)


def _volume(body: Body, points: np.ndarray) -> float:
    corners = points[body.boundary]
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def test_nothing_is_said_outside(body: Body) -> None:
    for field in (forward_field(body, bent(body)), inverse_field(body, bent(body))):
        assert (field.vectors[field.region == Region.OUTSIDE] == 0.0).all()
        assert {int(value) for value in np.unique(field.region)} == {0, 1, 2}
        for axis in range(3):  # the grid ends outside, so that what is beyond it is zero, too
            assert (np.take(field.region, [0, -1], axis) == Region.OUTSIDE).all()
        assert np.abs(field.at([[9.0, 9.0, 9.0]])).max() == 0.0


def test_the_longest_side_has_so_many_voxels(body: Body) -> None:
    assert forward_field(body, bent(body)).spacing == pytest.approx(0.20 / 64)
    assert inverse_field(body, bent(body), 0.004).spacing == 0.004


# --- Files.


def as_itk_reads(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin and steps of the grid on LPS axes, and the vectors just as they stand: what ITK makes of a file."""
    data, header = nrrd.read(str(path), index_order="F")
    turn = {"left-posterior-superior": [1.0, 1.0, 1.0], "right-anterior-superior": [-1.0, -1.0, 1.0]}[header["space"]]
    return turn * header["space origin"], turn * header["space directions"][1:], np.moveaxis(data, 0, 3)


@pytest.mark.parametrize("axes", ["lps", "ras"])
@pytest.mark.parametrize("unit", ["mm", "m"])
@pytest.mark.parametrize("make", [forward_field, inverse_field])
def test_a_field_comes_back_from_its_file(tmp_path: Path, axes, unit, make) -> None:
    body, place = BODIES["tetrahedron"], Coordinates(unit, axes)
    field = make(body, bent(body), 0.008)
    path, beside = write_displacement(tmp_path / "Leber links_0003.nrrd", field, place)
    assert beside.name == "Leber links-region_0003.nrrd" and {path.name for path in tmp_path.iterdir()} == {
        path.name,
        beside.name,
    }
    back = read_displacement(path)
    assert back.direction == field.direction
    assert np.abs(back.origin - field.origin).max() < CLOSE and abs(back.spacing - field.spacing) < CLOSE
    assert np.abs(back.vectors - field.vectors).max() < CLOSE
    assert np.array_equal(back.region, field.region)


@pytest.mark.parametrize("axes", ["lps", "ras"])
def test_itk_finds_every_vector_at_its_place_in_either_space(tmp_path: Path, axes) -> None:
    """ITK turns a grid in RAS and leaves its vectors alone: they stand in LPS in either file."""
    body = BODIES["tetrahedron"]
    field = inverse_field(body, bent(body), 0.008)
    path, _ = write_displacement(tmp_path / "field.nrrd", field, Coordinates("mm", axes))
    origin, steps, vectors = as_itk_reads(path)
    for index in np.argwhere(field.region == Region.ORGAN)[::37]:
        place = 1e-3 * (origin + index @ steps)
        assert np.abs(place - (field.origin + field.spacing * index)).max() < CLOSE
        assert np.abs(1e-3 * vectors[tuple(index)] - field.at(place[None])[0]).max() < CLOSE


def test_a_file_says_what_it_holds(tmp_path: Path) -> None:
    body = BODIES["tetrahedron"]
    for make, words in ((forward_field, "rest to deformed"), (inverse_field, "deformed to rest")):
        path, beside = write_displacement(tmp_path / "f.nrrd", make(body, bent(body)), Coordinates("mm", "ras"))
        header = nrrd.read_header(str(path))
        assert header["space"] == "right-anterior-superior" and header["space units"] == ["mm"] * 3
        assert header["kinds"] == ["vector", "domain", "domain", "domain"]
        assert words in header["meaning"] and "x + v(x)" in header["meaning"]
        assert "in mm" in header["vectors"] and beside.name in header["outside"]
        # By the standard the measurement frame takes a vector to the file's space: from LPS to RAS.
        assert np.array_equal(header["measurement frame"], np.diag([-1.0, -1.0, 1.0]))
        assert nrrd.read_header(str(beside))["space"] == header["space"]


def test_what_cannot_be_is_said_by_name(tmp_path: Path) -> None:
    body = BODIES["tetrahedron"]
    field = forward_field(body, bent(body), 0.02)
    with pytest.raises(ValueError, match=r"displacement: expected shape \(\d+, 3\), got \(4, 3\)"):
        forward_field(body, np.zeros((4, 3)))
    for spacing in (1e-7, -1.0, np.nan):
        with pytest.raises(ValueError, match="spacing: expected an edge of at least"):
            inverse_field(body, bent(body), spacing)
    with pytest.raises(FileError, match=r"field\.nii: expected the suffix \.nrrd"):
        write_displacement(tmp_path / "field.nii", field, Coordinates("mm"))
    with pytest.raises(FileError, match=r"field\.nrrd: could not be written"):
        write_displacement(tmp_path / "nowhere" / "field.nrrd", field, Coordinates("mm"))
    with pytest.raises(FileError, match=r"field\.nrrd: could not be read"):
        read_displacement(tmp_path / "field.nrrd")
    path, _ = write_displacement(tmp_path / "field.nrrd", field, Coordinates("mm"))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FileError, match="truncated or damaged"):
        read_displacement(path)
    nrrd.write(str(path), np.zeros((3, 3, 3)))
    nrrd.write(str(region_path(path)), np.zeros((3, 3, 3)))
    with pytest.raises(FileError, match="not a displacement field written by softtwin"):
        read_displacement(path)


def test_a_fold_has_no_inverse_and_does_no_harm() -> None:
    """A corner pushed through its neighbours: two origins for one place, of which one is given."""
    body = BODIES["tetrahedron"]
    moved = np.zeros_like(body.points)
    moved[np.argmax(body.points.sum(axis=1))] = [-0.1, -0.03, -0.03]
    field = inverse_field(body, moved)
    assert isinstance(field, DisplacementField) and np.isfinite(field.vectors).all()
