"""The reduced network: symmetries, basis, the plain arrays against torch, what holds by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate import reduced as reduced_module
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.pod import correction_modes
from softtwin.surrogate.reduced import Reduced, ReducedLesson
from softtwin.surrogate.symmetry import identity, symmetries


def _loaded(body: Body) -> np.ndarray:
    return np.setdiff1d(body.boundary_nodes, body.fixed)


def _lesson(data: DataSet, use_symmetries: bool = True) -> ReducedLesson:
    torch.manual_seed(0)
    samples = data.samples("train")
    return Reduced(modes=6, width=24, depth=2, symmetries=use_symmetries).lesson(data, samples, samples)


@pytest.mark.parametrize(
    ("size", "kind", "count"),
    [
        ((0.4, 0.2, 0.2), "hexahedron", 8),  # a square section: four turns, four mirrors
        ((0.4, 0.2, 0.1), "hexahedron", 4),  # a rectangle: one half turn, two mirrors
        ((0.4, 0.2, 0.2), "tetrahedron", 2),  # Kuhn's tetrahedra share one diagonal: its mirror remains
    ],
)
def test_a_beam_has_the_symmetries_of_its_mesh(size: tuple[float, float, float], kind: str, count: int) -> None:
    body = beam((4, 2, 2), size, kind)  # type: ignore[arg-type]
    group = symmetries(body, _loaded(body))
    assert len(group) == count
    assert np.array_equal(group[0].nodes, np.arange(len(body.points)))
    centre = body.points.mean(axis=0)
    for motion in group:
        moved = motion.apply((body.points - centre)[None])[0]  # positions as a field that moves with the body
        assert np.abs(moved - (body.points - centre)).max() < 1e-12


def test_a_turned_beam_keeps_the_symmetries_that_its_principal_axes_show() -> None:
    body = beam((4, 2, 3), (0.4, 0.2, 0.1))
    angle = 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turn = turn @ np.roll(np.roll(turn, 1, axis=0), 1, axis=1)
    turned = Body(body.points @ turn.T, body.cells, {"fixed": body.fixed})
    assert len(symmetries(turned, _loaded(turned))) == 4


def test_cells_that_are_not_as_full_break_the_symmetries_that_swap_them() -> None:
    body = beam((4, 2, 2), (0.4, 0.2, 0.2))
    middles = body.points[body.cells].mean(axis=1)
    alike = replace(body, fractions=np.where(middles[:, 0] > 0.3, 0.5, 1.0))
    thinner_above = replace(body, fractions=np.where(middles[:, 2] > 0.1, 0.5, 1.0))
    assert [len(symmetries(b, _loaded(b))) for b in (body, alike, thinner_above)] == [8, 8, 2]


def test_loads_on_one_side_leave_only_the_symmetries_of_that_side() -> None:
    body = beam((4, 2, 2), (0.4, 0.2, 0.2))
    top = np.flatnonzero(body.points[:, 2] > 0.19)
    assert len(symmetries(body, np.setdiff1d(top, body.fixed))) == 2


def test_modes_are_orthonormal_zero_at_fixed_nodes_and_span_the_snapshots(small_beam: Body) -> None:
    fields = np.random.default_rng(0).standard_normal((5, len(small_beam.points), 3))
    fields[:, small_beam.fixed] = 0.0
    modes = correction_modes(fields, small_beam.fixed, (identity(small_beam),), 20)
    flat = fields.reshape(5, -1)
    assert modes.shape[1] == 5
    assert np.abs(modes.T @ modes - np.eye(5)).max() < 1e-12
    assert np.abs(flat - flat @ modes @ modes.T).max() < 1e-12
    assert np.all(modes.reshape(-1, 3, 5)[small_beam.fixed] == 0.0)


def test_symmetric_modes_span_an_invariant_space(data: DataSet) -> None:
    basis = _lesson(data).basis
    assert len(basis.turns) == 8
    for turn in basis.turns:
        assert np.abs(turn @ turn.T - np.eye(basis.count)).max() < 1e-9


def test_snapshots_that_are_all_zero_are_refused(small_beam: Body) -> None:
    fields = np.zeros((3, len(small_beam.points), 3))
    with pytest.raises(ValueError, match="differ from the linear response"):
        correction_modes(fields, small_beam.fixed, (identity(small_beam),), 4)


def test_reduced_loss_is_the_full_loss_up_to_a_constant(data: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Differences of the loss between two networks agree with those of the loss in all 3n unknowns."""
    lesson = _lesson(data, use_symmetries=False)
    samples = data.samples("train")
    batch = torch.arange(len(samples))
    monkeypatch.setattr(reduced_module, "_SHARE", 1)  # the gradient's loss over all samples
    reduced, full = [], []
    for scale in (0.3, 1.0):
        lesson.network.output_scale.fill_(scale)
        reduced.append(lesson.loss(batch).item())
        full.append(_full_loss(data, lesson))
    assert abs(reduced[1] - reduced[0]) > 1e-2 * reduced[1]
    # float32 sums of losses of this size
    assert reduced[1] - reduced[0] == pytest.approx(full[1] - full[0], abs=1e-4 * reduced[1])


def _full_loss(data: DataSet, lesson: ReducedLesson) -> float:
    samples, network, basis = data.samples("train"), lesson.trained(), lesson.basis
    flat = samples.displacements.reshape(len(samples), -1)
    rms = np.sqrt((flat**2).sum(axis=1).mean())
    total = 0.0
    for i in range(len(samples)):
        load = samples.forces[i].ravel()
        here = network.linearised(torch.from_numpy(load @ basis.restricted))
        error = data.response.apply(samples.forces[i : i + 1]).ravel() + basis.modes @ here.values.numpy() - flat[i]
        cotangent = np.zeros_like(data.body.points)
        nodes = data.body.boundary_nodes
        cotangent[nodes] = np.tensordot(samples.probes[i], data.shapes[:, nodes], axes=1)
        gradient = cotangent.ravel() @ data.response.left @ data.response.right
        gradient = gradient + here.pull(torch.from_numpy(cotangent.ravel() @ basis.modes)).numpy() @ basis.restricted.T
        missed = np.sum((gradient - samples.adjoints[i].ravel()) ** 2) / np.sum(samples.adjoints[i] ** 2)
        total += error @ error / (np.linalg.norm(flat[i]) * rms + 0.01 * rms**2) + 0.03 * missed
    return total / len(samples)


def test_zero_load_gives_exactly_zero(reduced: Surrogate) -> None:
    assert np.all(reduced.solve(np.zeros_like(reduced.body.points)).displacement == 0.0)


def test_fixed_nodes_never_move(reduced: Surrogate, forces: np.ndarray) -> None:
    displacement = reduced.solve(50.0 * forces).displacement
    assert np.abs(displacement).max() > 0.0
    assert np.all(displacement[reduced.body.fixed] == 0.0)


def test_tangent_at_rest_is_the_linear_response(reduced: Surrogate, data: DataSet, forces: np.ndarray) -> None:
    linear = data.response.apply(forces[None, data.response.loaded])[0]
    rest = reduced.solve(np.zeros_like(forces))
    found = rest.push(forces.reshape(-1, 1)).reshape(-1, 3)
    assert np.abs(found - linear).max() <= 1e-14 * np.abs(linear).max()


def test_prediction_turns_with_the_load(reduced: Surrogate, forces: np.ndarray) -> None:
    group = symmetries(reduced.body, reduced.maps.loaded)
    assert len(group) == 8
    expected = reduced.solve(forces).displacement
    for motion in group:
        found = reduced.solve(motion.apply(forces[None])[0]).displacement
        assert np.abs(found - motion.apply(expected[None])[0]).max() < 1e-9 * np.abs(expected).max()
