import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.metrics import (
    cell_volumes,
    dihedral_angles,
    displacement_gradients,
    mesh_quality,
    net_force_error,
    nodal_errors,
    nodal_volumes,
    relative_error,
    scaled_jacobians,
    target_errors,
    tetrahedron_quality,
    thesis_error,
)
from softtwin.meshes.shapes import beam

REGULAR = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)[[0, 2, 1, 3]]
CELL = np.arange(4)[None]
ROUNDING = 100 * np.finfo(float).eps


def test_errors_of_known_distances() -> None:
    truth = np.zeros((4, 3))
    found = np.array([[1, 0, 0], [0, 2, 0], [0, 0, 3], [0, 0, 0.0]])
    errors = nodal_errors(found, truth)
    assert errors.mean == pytest.approx(1.5) and errors.rms == pytest.approx(np.sqrt(3.5)) and errors.max == 3
    assert errors.p95 == pytest.approx(np.percentile([1, 2, 3, 0], 95))
    assert target_errors(found, truth) == errors
    assert "max 3e+03 mm" in str(errors)


def test_relative_and_thesis_errors_of_a_batch() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(5, 20, 3))
    found = truth * 1.1
    assert np.allclose(relative_error(found, truth), 0.1, rtol=ROUNDING * 10)
    assert np.allclose(thesis_error(found, truth), 0.1 * np.linalg.norm(truth.reshape(5, -1), axis=1) / 20)
    assert relative_error(found, truth).shape == thesis_error(found, truth).shape == (5,)


def test_a_relative_error_without_truth_is_infinite_or_zero() -> None:
    zero = np.zeros((2, 3))
    assert relative_error(zero, zero) == 0 and np.isinf(relative_error(zero + 1, zero))


def test_the_net_force_alone_counts() -> None:
    forces = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 2]])
    assert net_force_error(forces, forces.sum(axis=0)).newtons == 0
    assert net_force_error(forces[::-1], forces).relative == 0
    error = net_force_error(forces, [1, 2, 1.0])
    assert error.newtons == pytest.approx(1) and error.relative == pytest.approx(1 / np.sqrt(6))
    assert np.isinf(net_force_error(forces, np.zeros(3)).relative)


def test_arrays_that_do_not_match_are_refused() -> None:
    with pytest.raises(ValueError, match=r"expected one shape \(..., n, 3\), got \(2, 3\) and \(3, 3\)"):
        nodal_errors(np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="got NaN or infinity"):
        relative_error(np.full((2, 3), np.nan), np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"expected shapes \(n, 3\)"):
        net_force_error(np.zeros((2, 2)), np.zeros(3))


def test_a_regular_tetrahedron_is_ideal() -> None:
    assert tetrahedron_quality(REGULAR, CELL) == pytest.approx([1], rel=ROUNDING)
    assert scaled_jacobians(REGULAR, CELL) == pytest.approx([1], rel=ROUNDING)
    assert dihedral_angles(REGULAR, CELL) == pytest.approx(np.full((1, 6), np.degrees(np.arccos(1 / 3))), rel=ROUNDING)
    assert cell_volumes(REGULAR, CELL) == pytest.approx([8 / 3], rel=ROUNDING)


def test_quality_does_not_change_with_size_or_place() -> None:
    points = np.random.default_rng(4).normal(size=(4, 3))
    moved = 1e-3 * points + [1, 2, 3]
    # Differences of numbers near 3 that are 1e-3 apart keep 1e-3 / 3 of the precision.
    tolerance = 1e5 * np.finfo(float).eps
    assert tetrahedron_quality(moved, CELL) == pytest.approx(tetrahedron_quality(points, CELL), rel=tolerance)
    assert dihedral_angles(moved, CELL) == pytest.approx(dihedral_angles(points, CELL), rel=tolerance)


def test_a_flat_tetrahedron_has_no_quality_and_an_inverted_one_a_negative() -> None:
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    assert tetrahedron_quality(flat, CELL) == 0 and scaled_jacobians(flat, CELL) == 0
    assert tetrahedron_quality(REGULAR, CELL[:, [1, 0, 2, 3]]) == pytest.approx([-1], rel=ROUNDING)


def test_the_volumes_of_skewed_cells_fill_the_body(skewed: Body) -> None:
    assert cell_volumes(skewed.points, skewed.cells).sum() == pytest.approx(0.4 * 0.1 * 0.2, rel=ROUNDING)
    assert cell_volumes(skewed.points, skewed.cells).std() > 1e-6


def test_the_report_on_a_beam_of_cubes() -> None:
    quality = mesh_quality(beam((4, 2, 2), (0.4, 0.2, 0.2)))
    assert (quality.nodes, quality.cells, quality.kind) == (45, 16, "hexahedra")
    assert quality.volume == pytest.approx(0.016) and quality.volume_ratio == pytest.approx(1)
    assert quality.min_scaled_jacobian == pytest.approx(1) and np.isnan(quality.min_radius_ratio)
    assert quality.min_dihedral == pytest.approx(90) and quality.max_dihedral == pytest.approx(90)
    assert quality.min_edge == pytest.approx(0.1) and quality.max_edge == pytest.approx(0.1)
    assert "hexahedra                    16" in str(quality) and "16 litres" in str(quality)


def test_the_report_on_the_liver_phantom(liver: Body) -> None:
    quality = mesh_quality(liver)
    assert quality.volume == pytest.approx(liver.volume, rel=len(liver.cells) * np.finfo(float).eps)
    assert 0 < quality.min_radius_ratio < 1 and 0 < quality.min_dihedral < 70.6 < quality.max_dihedral < 180
    assert quality.min_edge < quality.mean_edge < quality.max_edge < 0.05


def test_plane_meshes_have_their_own_quality() -> None:
    """Quadrilaterals were taken for tetrahedra: four corners each."""
    x, y = np.meshgrid(np.linspace(0, 0.4, 5), np.linspace(0, 0.1, 3), indexing="ij")
    points, numbers = np.column_stack([x.ravel(), y.ravel()]), np.arange(15).reshape(5, 3)
    corners = (numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:])
    squares = np.stack([c.ravel() for c in corners], axis=1)
    quality = mesh_quality(Body(points, squares, {}))
    assert (quality.kind, quality.cells) == ("quadrilaterals", 8)
    assert quality.volume == pytest.approx(0.04, rel=ROUNDING)
    assert quality.min_scaled_jacobian == pytest.approx(0.05 * 0.1 / (0.05 * 0.1), rel=ROUNDING)
    assert quality.min_dihedral == pytest.approx(90) and quality.max_dihedral == pytest.approx(90)
    assert (quality.min_edge, quality.max_edge) == pytest.approx((0.05, 0.1))
    assert "quadrilaterals" in str(quality) and "area" in str(quality) and "400 cm^2" in str(quality)
    sheared = Body(points + points[:, 1:] * [0.5, 0], squares, {})
    assert mesh_quality(sheared).min_dihedral == pytest.approx(np.degrees(np.arctan(2.0)))
    triangles = Body(points, squares[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), {})
    assert mesh_quality(triangles).kind == "triangles" and mesh_quality(triangles).volume == pytest.approx(0.04)
    assert scaled_jacobians(np.array([[0, 0], [1, 0], [0.5, np.sqrt(0.75)]]), np.arange(3)[None]) == pytest.approx([1])


def test_displacement_gradients_of_a_linear_field_are_exact(any_beam: Body, rng: np.random.Generator) -> None:
    slope = rng.standard_normal((3, 3))
    for body in (any_beam, any_beam.quadratic()):
        found = displacement_gradients(body, body.points @ slope.T + rng.standard_normal(3))
        np.testing.assert_allclose(found, np.broadcast_to(slope, found.shape), atol=1e-12)
    with pytest.raises(ValueError, match="displacement: expected shape"):
        displacement_gradients(any_beam, np.zeros((3, 3)))


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_nodal_volumes_integrate_what_nodes_interpolate(cell: str, degree: int) -> None:
    """They add up to the volume, and integrate a linear field exactly: its mean is at the centre of a box."""
    body = beam((3, 2, 2), (0.3, 0.1, 0.2), cell)
    if degree == 2:
        body = body.quadratic()
    volumes = nodal_volumes(body)
    assert volumes.sum() == pytest.approx(0.3 * 0.1 * 0.2, rel=1e-12)
    centre = 0.5 * (body.points.min(axis=0) + body.points.max(axis=0))
    np.testing.assert_allclose(volumes @ body.points / volumes.sum(), centre, rtol=1e-12)


def test_nodal_volumes_of_a_sparse_grid_are_of_what_is_filled() -> None:
    body = beam((3, 2, 2), (0.3, 0.1, 0.2), "hexahedron")
    half = Body(body.points, body.cells, body.node_sets, fractions=np.linspace(0.2, 1.0, len(body.cells)))
    assert nodal_volumes(half).sum() == pytest.approx(half.volume, rel=1e-12)
    assert half.volume < 0.7 * body.volume
