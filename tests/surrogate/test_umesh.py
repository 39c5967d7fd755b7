"""U-Mesh: the grid that its tensor stands for, and bodies that have none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.grid import SparseGrid, sparse_grid
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate import twin
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.train import train
from softtwin.surrogate.umesh import UMesh, UMeshNetwork, lattice, tensor_places


def test_a_beam_fills_its_grid(small_beam: Body) -> None:
    positions, shape = lattice(small_beam)
    assert shape == (5, 3, 3)
    assert np.abs(small_beam.points - (small_beam.points.min(axis=0) + 0.1 * positions)).max() < 1e-12


def turned_box(spacing: float) -> SparseGrid:
    """The grid around a box that lies across it, whose corners stay empty."""
    box = beam((4, 2, 2), (0.4, 0.2, 0.2), "tetrahedron")
    used, corners = np.unique(box.boundary, return_inverse=True)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    return sparse_grid(Surface(box.points[used] @ turn.T, corners.reshape(-1, 3)), [0], spacing=spacing)


def test_the_cells_of_a_sparse_grid_keep_their_places() -> None:
    grid = turned_box(0.05)
    positions, shape = lattice(grid.body)
    assert np.array_equal(positions, grid.node_index) and shape == tuple(np.add(grid.shape, 1))
    assert len(positions) < np.prod(shape)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (lambda: beam((4, 2, 2), (0.4, 0.2, 0.2), "tetrahedron"), "got tetra cells"),
        (lambda: _moved(beam((4, 2, 2), (0.4, 0.2, 0.2))), r"got nodes up to 0\.1 cells away"),
    ],
    ids=["tetrahedra", "a node off the grid"],
)
def test_bodies_without_a_grid_are_refused(body: object, message: str) -> None:
    with pytest.raises(ValueError, match=rf"lattice\.body: .*{message}"):
        lattice(body())  # type: ignore[operator]


def _moved(body: Body) -> Body:
    points = body.points.copy()
    points[20, 0] += 0.01
    return Body(points, body.cells, {"fixed": body.fixed})


@pytest.mark.parametrize("shape", [(5, 3, 3), (3, 5, 4)])
def test_each_numbering_gives_every_node_a_place_of_its_own(shape: tuple[int, int, int]) -> None:
    positions = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    for numbering in ("short", "long"):
        places = tensor_places(positions, shape, numbering)
        assert len(np.unique(places, axis=0)) == len(positions)
        assert np.all(places >= 0) and np.all(places < shape)


def test_neighbours_in_the_body_are_neighbours_in_the_tensor_of_the_short_numbering_alone() -> None:
    shape = (20, 5, 5)
    positions = np.moveaxis(np.indices(shape), 0, -1)
    jumps = {}
    for numbering in ("short", "long"):
        places = tensor_places(positions.reshape(-1, 3), shape, numbering).reshape(*shape, 3)
        jumps[numbering] = max(np.abs(np.diff(places, axis=axis)).sum(axis=-1).max() for axis in range(3))
    assert jumps["short"] == 1 and jumps["long"] > 3


def test_forces_reach_their_nodes_and_no_others(small_beam: Body) -> None:
    """Of a network that passes its input on: one level, the first channels let through, nothing from below."""
    positions, shape = lattice(small_beam)
    loaded = np.array([7, 20])
    network = UMeshNetwork(torch.from_numpy(positions), torch.from_numpy(loaded), shape, 3, 1).double()
    network.requires_grad_(False)
    for name, weights in network.named_parameters():
        weights.zero_()
        if name in ("falls.0.0.weight", "falls.0.2.weight", "joins.0.0.weight", "joins.0.2.weight"):
            weights[range(3), range(3), 1, 1, 1] = 1.0
        elif name == "leave.weight":
            weights[range(3), range(3), 0, 0, 0] = 1.0
    forces = torch.arange(1.0, 7.0, dtype=torch.float64)[None]  # positive: the ReLUs let them pass
    moved = network(forces).reshape(-1, 3)
    expected = torch.zeros(len(small_beam.points), 3, dtype=torch.float64)
    expected[loaded] = forces.reshape(2, 3)
    assert torch.equal(moved, expected)


def test_the_grid_is_padded_to_what_the_levels_halve(small_beam: Body) -> None:
    positions, shape = lattice(small_beam)
    network = UMeshNetwork(torch.from_numpy(positions), torch.arange(4), shape, 2, 3)
    seen: list[tuple[int, ...]] = []
    network.falls[3].register_forward_hook(lambda module, inputs, values: seen.append(tuple(values.shape)))
    network(torch.zeros(2, 12))
    assert seen == [(2, 16, 1, 1, 1)]


@pytest.fixture(scope="module")
def sparse(write_data: Any, tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return write_data(tmp_path_factory.mktemp("sparse") / "data.zarr", turned_box(0.08).body)


def test_what_the_grid_holds_outside_of_the_body_is_not_learned_from(sparse: DataSet) -> None:
    """A masked loss: neither its value nor its derivative knows of the tensor where no node stands."""
    samples = sparse.samples("train")
    objective = UMesh(channels=3, levels=1).objective(sparse, samples, samples)
    positions, shape = lattice(sparse.body)
    assert len(positions) < 0.9 * np.prod(shape)
    added: list[torch.Tensor] = []
    objective.network.leave.register_forward_hook(lambda module, inputs, values: values + added[0] if added else values)
    batch = torch.arange(4)
    plain = objective.loss(batch).detach()
    padded = [size + size % 2 for size in shape]
    field = torch.zeros(4, 3, *padded, requires_grad=True)
    added.append(field)
    (slope,) = torch.autograd.grad(objective.loss(batch), field)
    occupied = torch.zeros(padded, dtype=torch.bool)
    occupied[tuple(torch.from_numpy(positions).T)] = True
    assert bool((slope[..., ~occupied] == 0.0).all()) and bool((slope[..., occupied] != 0.0).all())
    added[0] = torch.where(occupied, 0.0, 1e3).expand_as(field)
    assert torch.equal(objective.loss(batch).detach(), plain)


@pytest.mark.slow
def test_a_body_on_a_sparse_grid_is_learned_and_predicted(sparse: DataSet, tmp_path: Path) -> None:
    surrogate = train(sparse, TrainingPlan(UMesh(channels=12, levels=2), batch=8, epochs=30))
    assert evaluate(surrogate, sparse).relative_error.median < 0.7  # 1 for a prediction of nothing
    forces = np.zeros_like(sparse.body.points)
    forces[sparse.response.loaded] = sparse.samples("test").forces[0]
    state = surrogate.solve(forces)
    assert state.displacement.shape == sparse.body.points.shape
    twin.save(surrogate, tmp_path)
    again = twin.load(tmp_path, sparse.body).solve(forces)
    np.testing.assert_array_equal(again.displacement, state.displacement)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"channels": 0}, r"UMesh\.channels: expected at least 1, got 0"),
        ({"levels": 0}, r"UMesh\.levels: expected at least 1"),
        ({"numbering": "wide"}, r"UMesh\.numbering: expected 'short' or 'long', got 'wide'"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UMesh(**settings)  # type: ignore[arg-type]
