import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.metrics import scaled_jacobians
from softtwin.meshes.shapes import beam
from softtwin.meshes.smoothing import improved, outer_faces


@pytest.fixture
def crooked() -> Body:
    """A beam of tetrahedra, an inner node pushed nearly through a face of its cells."""
    bar = beam((4, 3, 3), (0.4, 0.3, 0.3), "tetrahedron")
    inner = np.setdiff1d(np.arange(len(bar.points)), bar.boundary_nodes)
    points = bar.points.copy()
    points[inner[::2]] += np.array([0.045, 0.04, -0.042])
    return Body(points, bar.cells, {})


def test_bad_cells_become_good_and_the_box_keeps_its_shape(crooked: Body) -> None:
    assert scaled_jacobians(crooked.points, crooked.cells).min() < 0.15
    points, cells = improved(crooked.points, crooked.cells, 0.25)
    assert scaled_jacobians(points, cells).min() >= 0.25
    # Flat cells may go from the edges of the box, no more.
    assert Body(points, cells, {}).volume == pytest.approx(crooked.volume, rel=0.1)


def test_the_same_mesh_is_improved_the_same_way(crooked: Body) -> None:
    first, second = (improved(crooked.points, crooked.cells, 0.3) for _ in range(2))
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])


def test_a_good_mesh_stays_as_it_is(crooked: Body) -> None:
    points, cells = improved(crooked.points, crooked.cells, 0.0)
    assert np.array_equal(points, crooked.points) and np.array_equal(cells, crooked.cells)


def test_outer_faces_are_the_boundary(crooked: Body) -> None:
    faces, outer = outer_faces(crooked.cells)
    assert sorted(map(sorted, faces[outer].tolist())) == sorted(map(sorted, crooked.boundary.tolist()))
    corner = crooked.cells[:, :, None]
    assert not (faces == corner).any()  # face i is opposite to corner i
