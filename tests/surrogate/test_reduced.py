"""The reduced network: symmetries, basis, the plain arrays against torch, what holds by construction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.reference.data.jacobians import prepare_jacobians, read_jacobians, stored_modes, write_jacobians
from softtwin.surrogate import reduced as reduced_module
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.pod import correction_modes, learned_basis
from softtwin.surrogate.reduced import Reduced, ReducedObjective
from softtwin.surrogate.symmetry import identity, symmetries
from softtwin.surrogate.train import train

from .conftest import ClosedForm


def _loaded(body: Body) -> np.ndarray:
    return np.setdiff1d(body.boundary_nodes, body.fixed)


def _lesson(data: DataSet, use_symmetries: bool = True) -> ReducedObjective:
    torch.manual_seed(0)
    samples = data.samples("train")
    return Reduced(modes=6, width=24, depth=2, symmetries=use_symmetries).objective(data, samples, samples)


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
    objective = _lesson(data, use_symmetries=False)
    samples = data.samples("train")
    batch = torch.arange(len(samples))
    monkeypatch.setattr(reduced_module, "_SHARE", 1)  # the gradient's loss over all samples
    reduced, full = [], []
    for scale in (0.3, 1.0):
        objective.network.output_scale.fill_(scale)
        reduced.append(objective.loss(batch).item())
        full.append(_full_loss(data, objective))
    assert abs(reduced[1] - reduced[0]) > 1e-2 * reduced[1]
    # float32 sums of losses of this size
    assert reduced[1] - reduced[0] == pytest.approx(full[1] - full[0], abs=1e-4 * reduced[1])


def _full_loss(data: DataSet, objective: ReducedObjective) -> float:
    samples, network, basis = data.samples("train"), objective.trained(), objective.basis
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
        gradient = gradient + here.vjp(torch.from_numpy(cotangent.ravel() @ basis.modes)).numpy() @ basis.restricted.T
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
    found = rest.jvp(forces.reshape(-1, 1)).reshape(-1, 3)
    assert np.abs(found - linear).max() <= 1e-14 * np.abs(linear).max()


def test_prediction_turns_with_the_load(reduced: Surrogate, forces: np.ndarray) -> None:
    group = symmetries(reduced.body, reduced.encoder_decoder.loaded)
    assert len(group) == 8
    expected = reduced.solve(forces).displacement
    for motion in group:
        found = reduced.solve(motion.apply(forces[None])[0]).displacement
        assert np.abs(found - motion.apply(expected[None])[0]).max() < 1e-9 * np.abs(expected).max()


@pytest.fixture
def differentiated(make_data: Any) -> DataSet:
    """The closed form's data with its Jacobians in six modes."""
    data = make_data()
    train = data.samples("train")
    modes = learned_basis(data, train, 6, True).modes
    prepare_jacobians(data, modes)
    loaded, truth = data.response.loaded, ClosedForm(data.body)
    rows, size = (3 * loaded[:, None] + np.arange(3)).ravel(), data.header["block"]
    values = np.zeros((data.block_count * size, modes.shape[1], modes.shape[1]))
    squares = np.zeros(len(values))
    for draw, given in zip(train.draws, train.forces, strict=True):
        forces = np.zeros_like(data.body.points)
        forces[loaded] = given
        columns = np.stack([truth.adjoint(forces, mode.reshape(-1, 3)).ravel() for mode in modes.T], axis=1)[rows]
        values[draw], squares[draw] = modes[rows].T @ columns, np.square(columns).sum()
    for block in range(len(data.split_draws("train")) // size):
        part = slice(block * size, (block + 1) * size)
        write_jacobians(data.path, block, values[part], squares[part])
    return DataSet(data.path)


def test_the_loss_of_jacobians_is_their_frobenius_error(differentiated: DataSet) -> None:
    """Over all directions of a basis in place of random ones, for samples and their images."""
    objective = _lesson(differentiated)
    modes, rows = objective.basis.modes, objective.basis.restricted
    count = len(differentiated.samples("train"))
    assert objective.whole and objective.basis.count == 6 and objective.sample_count == 8 * count
    batch = torch.tensor([3, count + 3, 5 * count + 7])
    found = 0.0
    for shift in range(6):
        objective.directions = torch.roll(torch.eye(6), shift, 0)
        found += float(objective._jacobian_loss(batch).detach())
    train, truth = differentiated.samples("train"), ClosedForm(differentiated.body)
    group, expected = symmetries(differentiated.body, differentiated.response.loaded), 0.0
    for number in batch.tolist():
        motion, forces = group[number // count], np.zeros((1, *differentiated.body.points.shape))
        forces[0, differentiated.response.loaded] = train.forces[number % count]
        load = motion.apply(forces)[0]
        columns = np.stack([truth.adjoint(load, mode.reshape(-1, 3)).ravel() for mode in modes.T], axis=1)
        at = (3 * differentiated.response.loaded[:, None] + np.arange(3)).ravel()
        missing = columns[at] - (objective.response.left @ objective.response.right).T @ modes
        single = objective.network.double()
        coordinates = torch.from_numpy(rows.T @ load.ravel()[at])[None]
        jacobian = torch.func.jacrev(lambda x, net=single: net(x)[0])(coordinates)[:, 0].detach().numpy()
        part = missing - rows @ np.linalg.lstsq(rows, missing, rcond=None)[0]  # what no network between these can have
        error = np.square(missing - rows @ jacobian.T).sum() - np.square(part).sum()
        expected += error / np.square(columns[at]).sum()
    assert found == pytest.approx(expected / 3, rel=1e-3)


@pytest.mark.slow
def test_jacobians_are_learned_from(differentiated: DataSet, data: DataSet) -> None:
    """In the coordinates of the modes, in all directions, on samples that were not learned from."""
    plans = [TrainingPlan(Reduced(6, 32, 2, weight), samples=12, epochs=1000) for weight in (0.0, 0.3)]
    truth, loaded, test = ClosedForm(data.body), data.response.loaded, data.samples("test")
    modes = stored_modes(differentiated)
    columns = np.zeros_like(modes)
    rows = (3 * loaded[:, None] + np.arange(3)).ravel()
    columns[rows] = modes[rows]

    def error(surrogate: Surrogate) -> float:
        found = []
        for given in test.forces:
            forces = np.zeros_like(data.body.points)
            forces[loaded] = given
            exact = np.stack([truth.adjoint(forces, m.reshape(-1, 3)).ravel() for m in modes.T]) @ columns
            missed = modes.T @ surrogate.solve(forces).jvp(columns) - exact
            found.append(np.linalg.norm(missed) / np.linalg.norm(exact))
        return float(np.median(found))

    without, with_jacobians = (train(differentiated, plan) for plan in plans)
    assert error(with_jacobians) < 0.6 * error(without)


@pytest.mark.parametrize("name", ["values", "squares"])
def test_jacobians_that_are_not_finite_are_refused(differentiated: DataSet, name: str) -> None:
    """Their checksum is right: nothing was damaged on the way."""
    draws = differentiated.samples("train").draws
    stored, size = read_jacobians(differentiated, draws), differentiated.header["block"]
    assert stored is not None
    arrays = {"values": np.zeros((size, 6, 6)), "squares": np.ones(size)}
    arrays[name].flat[0] = np.nan
    write_jacobians(differentiated.path, 0, arrays["values"], arrays["squares"])
    assert draws[0] == 0
    with pytest.raises(DataSetError, match=rf"Jacobians: expected finite numbers in .*, got 1 of {len(draws)} samples"):
        train(DataSet(differentiated.path), TrainingPlan(Reduced(modes=6, width=16), epochs=1))


def test_fewer_modes_than_the_jacobians_are_of_are_refused(differentiated: DataSet) -> None:
    samples = differentiated.samples("train")
    with pytest.raises(ValueError, match=r"Reduced\.modes: expected at least the 6 .* got 4"):
        Reduced(modes=4).objective(differentiated, samples, samples)
    assert not Reduced(modes=4, sobolev=0.0).objective(differentiated, samples, samples).whole
