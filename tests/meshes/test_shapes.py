import threading

import numpy as np
import pytest
from scipy.spatial import cKDTree

from softtwin.meshes.body import Body
from softtwin.meshes.checks import checked_surface
from softtwin.meshes.embedding import embed
from softtwin.meshes.metrics import mesh_quality
from softtwin.meshes.shapes import beam, liver_phantom, propeller

EPS = np.finfo(float).eps


def test_the_default_beam_is_the_one_of_the_thesis() -> None:
    body = beam()
    assert body.cells.shape == (304, 8)
    assert np.array_equal(np.ptp(body.points, axis=0), [1.0, 0.25, 0.25])
    assert len(body.fixed) == len(body.node_sets["tip"]) == 25
    assert (body.points[body.fixed, 0] == 0).all() and (body.points[body.node_sets["tip"], 0] == 1).all()


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
def test_a_beam_has_exactly_the_volume_and_the_area_of_its_box(kind: str) -> None:
    body = beam((7, 3, 2), (0.9, 0.3, 0.2), kind)
    assert body.volume == pytest.approx(0.9 * 0.3 * 0.2, rel=len(body.cells) * EPS)
    # A face that fits no neighbour would count as boundary and add to the area.
    assert body.boundary_surface.area == pytest.approx(2 * (0.27 + 0.18 + 0.06), rel=len(body.boundary) * EPS)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_nodes_of_a_beam_are_their_own_mirror_image(axis: int) -> None:
    body = beam()
    mirrored = body.points.copy()
    mirrored[:, axis] = np.ptp(body.points[:, axis]) - mirrored[:, axis]
    rounded = [{tuple(p) for p in points.round(12) + 0.0} for points in (body.points, mirrored)]
    assert rounded[0] == rounded[1] and len(rounded[0]) == 500


def test_a_beam_refuses_what_makes_no_beam() -> None:
    with pytest.raises(ValueError, match=r"divisions, size: expected three positive numbers each, got \(0, 4, 4\)"):
        beam((0, 4, 4))
    with pytest.raises(ValueError, match="kind: expected 'hexahedron' or 'tetrahedron', got 'prism'"):
        beam(kind="prism")  # type: ignore[arg-type]


def test_a_propeller_has_three_equal_blades_and_is_held_at_its_bore() -> None:
    body = propeller()
    assert np.allclose(np.hypot(*body.points[body.fixed, :2].T), 0.05, rtol=1e-6)
    assert np.isin(body.fixed, body.boundary_nodes).all()
    angles = np.degrees(np.arctan2(*body.points[body.node_sets["tips"], 1::-1].T))
    thirds = [((angles - turn + 60) % 360 < 120).sum() for turn in (0, 120, 240)]
    assert min(thirds) > 0.7 * max(thirds) and sum(thirds) == len(angles)
    assert np.linalg.norm(body.points[body.boundary_nodes].mean(axis=0)) < 0.02
    assert mesh_quality(body).min_radius_ratio > 0.1


def test_the_liver_phantom_is_as_large_as_a_liver(liver: Body) -> None:
    assert 1.0e-3 < liver.volume < 1.6e-3
    assert np.allclose(np.ptp(liver.points, axis=0), [0.20, 0.13, 0.13], atol=0.015)
    assert 1500 <= len(liver.points) <= 2000
    assert mesh_quality(liver).min_radius_ratio > 0.2


def test_the_right_lobe_of_the_liver_phantom_is_the_larger_one(liver: Body) -> None:
    centroids = liver.points[liver.cells].mean(axis=1)
    # Cells are of even size: count them on the two sides of the falciform notch.
    assert (centroids[:, 0] < 0.02).sum() > 2 * (centroids[:, 0] > 0.02).sum() > 0


def test_the_hilum_lies_below_and_behind(liver: Body) -> None:
    assert 15 <= len(liver.fixed) <= 0.05 * len(liver.points)
    assert np.isin(liver.fixed, liver.boundary_nodes).all()
    above = liver.points.mean(axis=0) - liver.points[liver.fixed].mean(axis=0)
    assert above[2] > 0.01 and above[1] < -0.01


def test_the_observed_side_faces_the_front(liver: Body) -> None:
    a, b, c = (liver.points[liver.surfaces["observed"][:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 1] < 0).all()
    assert 0.2 < len(liver.surfaces["observed"]) / len(liver.boundary) < 0.6
    assert not np.isin(liver.fixed, liver.surfaces["observed"]).any()


def test_vessels_and_tumour_are_closed_and_lie_inside(liver: Body) -> None:
    assert set(liver.inner) == {"vessel_portal", "vessel_hepatic", "tumour"}
    for surface in liver.inner.values():
        assert checked_surface(surface).volume > 0
        assert (embed(liver, surface.points).outside == 0).all()
    tumour = liver.inner["tumour"]
    assert tumour.volume == pytest.approx(4 / 3 * np.pi * 0.012**3, rel=0.05)


def test_no_inner_structure_cuts_another(liver: Body) -> None:
    points = [surface.points for surface in liver.inner.values()]
    gaps = [cKDTree(p).query(q)[0].min() for i, p in enumerate(points) for q in points[:i]]
    assert len(gaps) == 3 and min(gaps) > 0.001


def test_the_liver_phantom_is_the_same_each_time_and_in_any_thread(liver: Body) -> None:
    found: list[str] = []
    thread = threading.Thread(target=lambda: found.append(liver_phantom().fingerprint))
    thread.start()
    thread.join()
    assert found == [liver.fingerprint]


@pytest.mark.parametrize("cell_size", [0.0, 0.001, 0.1, float("nan")])
def test_the_liver_phantom_refuses_cells_that_lose_its_shape(cell_size: float) -> None:
    with pytest.raises(ValueError, match=r"cell_size: expected 0\.002 to 0\.02 m"):
        liver_phantom(cell_size)
