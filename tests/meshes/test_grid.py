from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Body, BodyError, Surface
from softtwin.meshes.checks import compacted
from softtwin.meshes.embedding import outer, outer_nodes
from softtwin.meshes.grid import SparseGrid, gridded, sparse_grid
from softtwin.meshes.metrics import mesh_quality
from softtwin.meshes.shapes import beam

EPS = np.finfo(float).eps
TURN = Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix()  # so that nothing lines up with the grid


def _box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Surface:
    surface = compacted(beam((1, 1, 1), (1, 1, 1), "hexahedron").boundary_surface)
    return Surface((surface.points - 0.5) * size + centre, surface.triangles)


def _joined(first: Surface, second: Surface) -> Surface:
    triangles = np.concatenate([first.triangles, second.triangles + len(first.points)])
    return Surface(np.concatenate([first.points, second.points]), triangles)


def _turned(surface: Surface) -> Surface:
    return Surface(surface.points @ TURN.T, surface.triangles)


@pytest.fixture(scope="module")
def organ(liver: Body) -> Surface:
    return compacted(liver.boundary_surface)


@pytest.fixture(scope="module")
def grid(organ: Surface) -> SparseGrid:
    right = np.flatnonzero(organ.points[:, 0] < -0.08)
    left = np.flatnonzero(organ.points[:, 0] > 0.08)
    return sparse_grid(organ, right, spacing=0.012, node_sets={"left": left}, depth=2)


def test_the_volume_converges_to_that_of_a_sphere_with_order_two(ball: Surface) -> None:
    surface, spacing, radius = _turned(ball), 0.0137, 0.05
    parts = spacing / 2.0 ** np.arange(4)
    volumes = [sparse_grid(surface, [0], spacing=spacing, depth=depth).volume for depth in range(4)]
    errors = np.abs(np.array(volumes) / ball.volume - 1)
    # A tangent plane misses the sphere by r^2 / 2R, over a part's h x h on average by h^2 / 12R: with the sphere's
    # area over its volume, 3 / R, that is (h / 2R)^2. Parts are cut obliquely and in the middle, so half more.
    assert (errors < 1.5 * (parts / (2 * radius)) ** 2).all()
    assert np.log2(errors[0] / errors[-1]) / 3 == pytest.approx(2, abs=0.3)


def test_a_flat_cut_is_exact_at_every_depth() -> None:
    size = np.array([0.11, 0.09, 0.1])
    box = _turned(_box(tuple(size)))
    grids = [sparse_grid(box, [0], spacing=0.01, depth=depth, smallest=1e-6) for depth in (0, 1, 3)]
    fractions = [{tuple(at): f for at, f in zip(g.index, g.fractions, strict=True)} for g in grids]
    first = grids[0]
    centres = (first.origin + (first.index + 0.5) * first.spacing) @ TURN
    reach = np.linalg.norm(first.spacing) / 2
    faces = (np.abs(size / 2 - np.abs(centres)) < reach).sum(axis=1)
    once = [tuple(at) for at in first.index[faces == 1]]
    assert len(once) > 300
    exact = np.array([fractions[2][at] for at in once])
    assert ((exact > 0.01) & (exact < 0.99)).sum() > 200
    for found in fractions[:2]:
        # Of shares that are sums of up to 512 parts, each off by the distances' round-off over a part's edge.
        assert np.allclose([found[at] for at in once], exact, rtol=0, atol=1e4 * EPS)


@pytest.mark.parametrize("resolution", [{"spacing": 0.02}, {"cells_per_axis": (5, 3, 4)}])
def test_a_box_that_fits_the_grid_has_whole_cells_only(resolution: dict[str, object]) -> None:
    box = _box((0.1, 0.06, 0.08), centre=(0.3, -0.2, 0.1))
    grid = sparse_grid(box, [0], **resolution)  # type: ignore[arg-type]
    assert grid.shape == (5, 3, 4)
    assert len(grid.body.cells) == 60
    assert len(grid.body.points) == 6 * 4 * 5
    assert (grid.fractions == 1).all()
    assert grid.volume == pytest.approx(box.volume, rel=100 * EPS)


def test_a_box_between_grid_lines_cuts_products_of_shares() -> None:
    # Three cells along each axis, of which the outer ones are cut at 5/8: where parts of depth 3 meet.
    grid = sparse_grid(_box((0.09, 0.09, 0.09)), [0], spacing=0.04, depth=3)
    share = np.array([0.625, 1, 0.625])
    assert grid.shape == (3, 3, 3)
    assert np.allclose(grid.fractions, share[grid.index].prod(axis=1), rtol=0, atol=1e3 * EPS)


def test_a_cavity_is_left_out() -> None:
    cavity = _box((0.06, 0.06, 0.06))
    shell = _joined(_box((0.1, 0.1, 0.1)), Surface(cavity.points, cavity.triangles[:, ::-1]))
    grid = sparse_grid(shell, [0], spacing=0.02)
    assert len(grid.body.cells) == 5**3 - 3**3
    assert (grid.fractions == 1).all()


def test_the_grid_of_a_beam_is_the_beam() -> None:
    expected = beam()
    surface = compacted(expected.boundary_surface)
    grid = sparse_grid(surface, np.flatnonzero(surface.points[:, 0] == 0), cells_per_axis=(19, 4, 4))
    assert np.array_equal(grid.body.cells, expected.cells)
    assert np.allclose(grid.body.points, expected.points, rtol=0, atol=10 * EPS)
    # All nodes of the cells that hold a fixed vertex: here the first two layers.
    assert np.array_equal(grid.body.fixed, np.flatnonzero(grid.node_index[:, 0] <= 1))


def test_the_enclosing_grid_places_cells_and_nodes(grid: SparseGrid) -> None:
    assert np.allclose(grid.body.points, grid.origin + grid.node_index * grid.spacing, rtol=0, atol=10 * EPS)
    centres = grid.origin + (grid.index + 0.5) * grid.spacing
    assert np.allclose(grid.body.points[grid.body.cells].mean(axis=1), centres, rtol=0, atol=10 * EPS)
    assert grid.index.max(axis=0).tolist() == [count - 1 for count in grid.shape]


def test_the_fractions_do_not_depend_on_where_the_surface_is(ball: Surface) -> None:
    here = _turned(ball)
    there = Surface(here.points + np.array([0.7, -0.3, 0.9]), here.triangles)
    first, second = (sparse_grid(surface, [0], spacing=0.02) for surface in (here, there))
    assert np.array_equal(first.index, second.index)
    # Rounding of the moved points, eps x 1 m, over the edge of a part, 2.5 mm, in sums over 512 parts.
    assert np.allclose(first.fractions, second.fractions, rtol=0, atol=1e4 * EPS)


def test_weights_are_trilinear_in_a_kept_cell(grid: SparseGrid, organ: Surface) -> None:
    assert grid.weights.shape == (len(organ.points), len(grid.body.points))
    assert np.allclose(grid.weights.sum(axis=1), 1, rtol=0, atol=10 * EPS)
    assert grid.weights.data.min() > -1e-8
    rows = np.sort(grid.weights.indices.reshape(-1, 8), axis=1)
    cells = {tuple(sorted(cell)) for cell in grid.body.cells.tolist()}
    assert all(tuple(row) in cells for row in rows.tolist())


def test_a_linear_field_is_carried_exactly(grid: SparseGrid, organ: Surface) -> None:
    def field(points: np.ndarray) -> np.ndarray:
        return points @ TURN + [0.1, -0.2, 0.3]

    # Weights carry the rounding of positions, eps x 0.2 m, over the cell's edge, 12 mm.
    assert np.abs(grid.carry(field(grid.body.points)) - field(organ.points)).max() < 100 * EPS


def test_spread_forces_do_the_same_work(grid: SparseGrid, organ: Surface) -> None:
    rng = np.random.default_rng(0)
    forces, displacement = rng.normal(size=organ.points.shape), rng.normal(size=grid.body.points.shape)
    work = np.vdot(forces, grid.carry(displacement))
    assert np.vdot(grid.spread(forces), displacement) == pytest.approx(work, abs=EPS * forces.size)


def test_spread_forces_keep_their_sum_and_moment(grid: SparseGrid, organ: Surface) -> None:
    forces = np.random.default_rng(1).normal(size=organ.points.shape)
    nodal = grid.spread(forces)
    assert np.allclose(nodal.sum(axis=0), forces.sum(axis=0), rtol=0, atol=EPS * forces.size)
    moments = [np.cross(at, f).sum(axis=0) for at, f in ((grid.body.points, nodal), (organ.points, forces))]
    assert np.allclose(*moments, rtol=0, atol=EPS * forces.size)


def test_a_fixed_vertex_cannot_move(grid: SparseGrid, organ: Surface) -> None:
    displacement = np.random.default_rng(2).normal(size=grid.body.points.shape)
    displacement[grid.body.fixed] = 0
    carried = grid.carry(displacement)
    assert (carried[organ.points[:, 0] < -0.08] == 0).all()
    assert (carried[organ.points[:, 0] > 0.08] != 0).all()


def test_other_sets_are_mapped_in_the_same_way(grid: SparseGrid, organ: Surface) -> None:
    left = organ.points[:, 0] > 0.08
    assert np.array_equal(grid.body.node_sets["left"], np.unique(grid.weights.indices.reshape(-1, 8)[left]))


def test_small_cells_are_dropped_unless_they_hold_a_vertex(ball: Surface) -> None:
    surface = _turned(ball)
    every, most = (sparse_grid(surface, [0], spacing=0.008, smallest=smallest) for smallest in (1e-3, 0.3))
    assert every.fractions.min() >= 1e-3
    assert most.fractions.min() == 0.3
    assert len(most.fractions) < len(every.fractions)
    holders = {tuple(sorted(nodes)) for nodes in most.weights.indices.reshape(-1, 8).tolist()}
    assert all(tuple(sorted(nodes)) in holders for nodes in most.body.cells[most.fractions == 0.3].tolist())


@pytest.mark.parametrize("centre", [(0.2, 0.0, 0.0), (0.1, 0.1, 0.0), (0.1, 0.1, 0.1)])
def test_pieces_that_are_apart_or_share_an_edge_or_a_corner_are_refused(centre: tuple[float, float, float]) -> None:
    pair = _joined(_box((0.1, 0.1, 0.1)), _box((0.1, 0.1, 0.1), centre))
    with pytest.raises(BodyError, match=r"hang together by their faces, got 2 pieces of \[125, 125\] cells"):
        sparse_grid(pair, [0], spacing=0.02)


def test_work_in_small_blocks_gives_the_same(ball: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = sparse_grid(ball, [0], spacing=0.02)
    monkeypatch.setattr("softtwin.meshes.grid._AT_ONCE", 1000)
    assert np.array_equal(sparse_grid(ball, [0], spacing=0.02).fractions, whole.fractions)


def test_a_grid_that_is_fixed_everywhere_is_refused(ball: Surface) -> None:
    with pytest.raises(BodyError, match="every node is fixed"):
        sparse_grid(ball, [0], spacing=0.2)


def _with_a_stray_vertex(ball: Surface) -> Surface:
    return Surface(np.concatenate([ball.points, [[0, 0, 0]]]), ball.triangles)


def _with_a_flat_triangle(ball: Surface) -> Surface:
    a, b, c = ball.triangles[0]
    middle = len(ball.points)
    points = np.concatenate([ball.points, [ball.points[[a, b]].mean(axis=0)]])
    return Surface(points, np.concatenate([ball.triangles[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]]))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda s: Surface(s.points, s.triangles[1:]),
            "surface: expected a closed surface of one winding, got 3 edges",
        ),
        (lambda s: Surface(s.points, s.triangles[[0, *range(len(s.triangles))]]), "3 met twice in one"),
        (lambda s: Surface(s.points, s.triangles[:, ::-1]), r"surface: expected triangles that wind outward, got .* -"),
        (_with_a_stray_vertex, "surface: expected every vertex to belong to a triangle, got 1 of 259"),
        (_with_a_flat_triangle, "surface: expected triangles higher than 1e-07 of their longest edge, got 1 flat"),
    ],
)
def test_a_surface_without_an_inside_is_refused(
    ball: Surface, damage: Callable[[Surface], Surface], message: str
) -> None:
    with pytest.raises(BodyError, match=message):
        sparse_grid(damage(ball), [0], spacing=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spacing": 0.0}, "spacing: expected a positive length in metres, got 0.0"),
        ({"spacing": np.nan}, "spacing: expected a positive length in metres, got nan"),
        ({"spacing": 1e-5}, "expected at most 2000000 cells in the enclosing grid, got 10000 x 10000 x 10000"),
        ({"spacing": None}, "expected one of spacing and cells_per_axis, got neither or both"),
        ({"cells_per_axis": (4, 4, 4)}, "expected one of spacing and cells_per_axis, got neither or both"),
        ({"spacing": None, "cells_per_axis": (4, 4)}, r"cells_per_axis: expected three whole numbers .* got \(4, 4\)"),
        ({"spacing": None, "cells_per_axis": (4, 0, 4)}, r"cells_per_axis: expected three whole numbers"),
        ({"depth": -1}, "depth: expected a whole number from 0 to 6, got -1"),
        ({"depth": 1.5}, "depth: expected a whole number from 0 to 6, got 1.5"),
        ({"smallest": 0.0}, "smallest: expected a fraction between 0 and 1, got 0.0"),
        ({"fixed": []}, "fixed: expected at least one surface vertex, got none"),
        ({"fixed": [258]}, r"fixed: expected vertex numbers in 0..257, got 258..258"),
        ({"fixed": [0.5]}, "fixed: expected a list of vertex numbers, got float64"),
        ({"node_sets": {"tip": [-1]}}, r"node_sets\['tip'\]: expected vertex numbers in 0..257"),
        ({"node_sets": {"fixed": [1]}}, "node_sets: expected names other than 'fixed'"),
    ],
)
def test_what_makes_no_grid_is_refused(ball: Surface, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sparse_grid(**{"surface": ball, "fixed": [0], "spacing": 0.02, **arguments})  # type: ignore[arg-type]


def test_a_field_of_another_grid_is_refused(grid: SparseGrid) -> None:
    with pytest.raises(ValueError, match=r"displacement: expected shape \(\d+, 3\), got \(7, 3\)"):
        grid.carry(np.zeros((7, 3)))
    with pytest.raises(ValueError, match=r"forces: expected shape \(\d+, 3\), got \(7, 3\)"):
        grid.spread(np.zeros((7, 3)))


def test_a_gridded_body_keeps_its_surface_sets_and_inner_structures(liver: Body) -> None:
    seen = liver.boundary[::2]
    held = liver.boundary_nodes[liver.points[liver.boundary_nodes, 0] > 0.08]
    liver = Body(liver.points, liver.cells, {**liver.node_sets, "held": held}, {"observed": seen}, liver.inner)
    body = gridded(liver, 0.012)
    surface = outer(body)
    assert body.kind.name == "hexahedron" and body.inner.keys() == liver.inner.keys()
    assert body.volume == pytest.approx(liver.volume, rel=0.02)
    assert mesh_quality(body).volume == pytest.approx(body.volume)
    assert np.array_equal(surface.rest.points[surface.rest.triangles], liver.points[liver.boundary])
    assert np.array_equal(surface.rest.points[body.surfaces["observed"]], liver.points[seen])
    assert np.isin(liver.points[held], surface.rest.points[surface.vertices_of(body.node_sets["held"])]).all()


def test_the_skin_follows_its_cells_and_gives_them_its_forces(liver: Body) -> None:
    body = gridded(liver, 0.012)
    surface, rng = outer(body), np.random.default_rng(2)
    skin = surface.rest.points
    assert np.abs(surface.moved(body.points @ TURN).points - (skin + skin @ TURN)).max() < 1e4 * EPS
    forces = rng.standard_normal(skin.shape)
    nodal = surface.spread(forces)
    assert np.allclose(nodal.sum(axis=0), forces.sum(axis=0), atol=1e3 * EPS)
    moments = (np.cross(points, f).sum(axis=0) for points, f in ((body.points, nodal), (skin, forces)))
    assert np.allclose(*moments, atol=1e3 * EPS)
    touched = np.flatnonzero(nodal.any(axis=1))
    assert np.array_equal(touched, outer_nodes(body)) and len(touched) < len(body.points)
    held = surface.vertices_of(body.fixed)
    still = np.where(np.isin(np.arange(len(body.points)), body.fixed)[:, None], 0.0, rng.standard_normal((1, 3)))
    assert len(held) and not surface.carried(still)[held].any()


def test_without_a_skin_the_boundary_is_the_surface(liver: Body) -> None:
    surface = outer(liver)
    assert surface.weights is None and outer(liver) is surface
    assert np.array_equal(surface.rest.triangles, liver.boundary)
    assert np.array_equal(outer_nodes(liver), liver.boundary_nodes)
    assert np.array_equal(surface.vertices_of(liver.fixed), np.intersect1d(liver.fixed, liver.boundary_nodes))
    field = np.ones_like(liver.points)
    assert surface.carried(field) is field and surface.spread(field) is field
    assert np.array_equal(surface.nodes_of([5, 3, 5]), [3, 5])
