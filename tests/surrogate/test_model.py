"""The surrogate as a forward model: states with derivatives, the reduced fast path, saving and loading."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from scipy.sparse import csr_array

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import CARD, WEIGHTS, TwinError, load, save

STEPS = 0.5 ** np.arange(3, 8)


def _direction(surrogate: Surrogate, seed: int, scale: float) -> np.ndarray:
    direction = np.zeros_like(surrogate.body.points)
    loaded = surrogate.encoder_decoder.loaded
    direction[loaded] = scale * np.random.default_rng(seed).standard_normal((len(loaded), 3))
    return direction


def _rates(remainders: list[float]) -> np.ndarray:
    assert min(remainders) > 0.0
    return np.log2(np.array(remainders[:-1]) / np.array(remainders[1:]))


def test_push_is_the_derivative(reduced: Surrogate, forces: np.ndarray) -> None:
    direction = _direction(reduced, 0, np.abs(forces).max())
    start = reduced.solve(forces)
    slope = start.jvp(direction.reshape(-1, 1)).reshape(-1, 3)
    moved = [reduced.solve(forces + h * direction).displacement for h in STEPS]
    remainders = [np.linalg.norm(u - start.displacement - h * slope) for h, u in zip(STEPS, moved, strict=True)]
    assert _rates(remainders)[-1] == pytest.approx(2.0, abs=0.1)


def test_pull_is_the_gradient(reduced: Surrogate, forces: np.ndarray) -> None:
    """Of the squared misfit, whose gradient with respect to the displacement is the displacement."""
    direction = _direction(reduced, 1, np.abs(forces).max())
    start = reduced.solve(forces)
    slope = float(np.vdot(start.vjp(start.displacement), direction))
    value = 0.5 * float(np.vdot(start.displacement, start.displacement))
    moved = [reduced.solve(forces + h * direction).displacement for h in STEPS]
    remainders = [abs(0.5 * float(np.vdot(u, u)) - value - h * slope) for h, u in zip(STEPS, moved, strict=True)]
    assert _rates(remainders)[-1] == pytest.approx(2.0, abs=0.1)


def test_perceptron_is_linear_between_its_kinks(perceptron: Surrogate, forces: np.ndarray) -> None:
    direction = _direction(perceptron, 2, 1e-7 * np.abs(forces).max())
    start = perceptron.solve(forces)
    slope = start.jvp(direction.reshape(-1, 1)).reshape(-1, 3)
    change = perceptron.solve(forces + direction).displacement - start.displacement
    # what cancels in the difference: round-off of values seven decades above it
    assert np.linalg.norm(change - slope) < 1e-6 * np.linalg.norm(change)


def test_a_push_of_changes_that_were_written_over_is_a_new_one(surrogate: Surrogate, forces: np.ndarray) -> None:
    """What does not depend on the state is remembered between pushes."""
    columns = np.stack([_direction(surrogate, seed, 1.0).ravel() for seed in range(3)], axis=1)
    states = surrogate.solve(forces), surrogate.solve(0.5 * forces)
    before = [state.jvp(columns) for state in states]
    columns *= 2.0
    for state, once in zip(states, before, strict=True):
        assert np.abs(state.jvp(columns) - 2.0 * once).max() < 1e-12 * np.abs(once).max()


def test_push_and_pull_are_adjoint(surrogate: Surrogate, forces: np.ndarray) -> None:
    state = surrogate.solve(forces)
    columns = np.stack([_direction(surrogate, seed, 1.0).ravel() for seed in range(3)], axis=1)
    cotangent = np.random.default_rng(9).standard_normal(surrogate.body.points.shape)
    forward = cotangent.ravel() @ state.jvp(columns)
    backward = state.vjp(cotangent).ravel() @ columns
    assert np.abs(forward).min() > 0.0
    assert np.abs(forward - backward).max() < 1e-11 * np.abs(forward).max()


def test_many_columns_at_once_equal_few(surrogate: Surrogate, forces: np.ndarray) -> None:
    """More columns than the network has coordinates take another way."""
    state = surrogate.solve(forces)
    columns = np.stack([_direction(surrogate, seed, 1.0).ravel() for seed in range(200)], axis=1)
    together = state.jvp(columns)
    apart = np.concatenate([state.jvp(columns[:, i : i + 1]) for i in range(200)], axis=1)
    assert np.abs(together - apart).max() < 1e-11 * np.abs(apart).max()


def test_a_state_stays_what_it_was(reduced: Surrogate, forces: np.ndarray) -> None:
    state = reduced.solve(forces)
    before, pulled = state.displacement.copy(), state.vjp(forces)
    other = reduced.solve(-2.0 * forces)
    assert np.array_equal(state.displacement, before) and np.array_equal(state.vjp(forces), pulled)
    assert np.abs(other.vjp(forces) - pulled).max() > 1e-3 * np.abs(pulled).max()


def test_the_reduced_surrogate_agrees_with_the_whole(surrogate: Surrogate, forces: np.ndarray) -> None:
    basis = np.stack([_direction(surrogate, seed, np.abs(forces).max()).ravel() for seed in range(4)], axis=1)
    nodes = np.array([40, 3, 17])
    c = np.array([0.3, -0.2, 0.5, 0.1])
    few = surrogate.reduced(nodes, basis).solve(c)
    whole = surrogate.solve((basis @ c).reshape(-1, 3))
    pushed = whole.jvp(basis).reshape(-1, 3, 4)[nodes].reshape(-1, 4)
    size = np.abs(whole.displacement).max()
    assert np.abs(few.full.displacement - whole.displacement).max() < 1e-11 * size
    # The rest is taken in single precision.
    assert np.abs(few.positions - whole.displacement[nodes]).max() < 1e-6 * size
    rows = csr_array(np.random.default_rng(3).standard_normal((5, 9)))
    assert np.abs(few.jacobian(rows) - rows @ pushed).max() < 1e-5 * np.abs(rows @ pushed).max()
    assert np.abs(few.moved(c).ravel() - pushed @ c).max() < 1e-5 * np.abs(pushed @ c).max()
    np.testing.assert_allclose(few.moved(c, 2), few.moved(c)[::2], rtol=1e-12)


def test_a_known_state_is_not_computed_again(surrogate: Surrogate, forces: np.ndarray) -> None:
    few = surrogate.reduced(np.array([3, 17]), np.stack([forces.ravel(), -0.5 * forces.ravel()], axis=1))
    state = few.solve(np.array([0.3, 0.1]))
    assert few.solve(np.array([0.3, 0.1]), state) is state
    assert few.solve(np.array([0.3, 0.2]), state) is not state
    assert few.combined(np.eye(2)).solve(np.array([0.3, 0.1]), state) is not state


def test_a_reduced_surrogate_takes_combinations_of_its_basis(surrogate: Surrogate, forces: np.ndarray) -> None:
    basis = np.stack([_direction(surrogate, seed, np.abs(forces).max()).ravel() for seed in range(4)], axis=1)
    matrix, nodes = np.random.default_rng(5).standard_normal((4, 2)), np.array([40, 3, 17])
    plain, whole = surrogate.reduced(nodes, basis @ matrix), surrogate.reduced(nodes, basis)
    combined = whole.combined(matrix)
    c = np.array([0.3, -0.2])
    assert (whole.count, combined.count) == (4, 2)
    np.testing.assert_allclose(combined.solve(c).positions, plain.solve(c).positions, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(combined.solve(c).moved(c), plain.solve(c).moved(c), rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(combined.solve(c).full.displacement, plain.solve(c).full.displacement, atol=1e-15)


def test_extent_is_one_at_the_farthest_load_of_the_training(reduced: Surrogate, data: DataSet) -> None:
    assert reduced.solve(np.zeros_like(reduced.body.points)).extrapolation_ratio is None
    known = with_domain(reduced, data)
    extents, distances = [], []
    for loads in data.samples("train").forces:
        forces = np.zeros_like(known.body.points)
        forces[data.response.loaded] = loads
        extents.append(known.solve(forces).extrapolation_ratio)
        distances.append(known.solve(forces).distance)
    assert max(extents) == pytest.approx(1.0, abs=0.2) and min(extents) < 0.9
    assert max(distances) == pytest.approx(1.0) and min(distances) < 0.9
    assert known.solve(3.0 * forces).extrapolation_ratio > 2.0 * known.solve(forces).extrapolation_ratio
    assert known.solve(3.0 * forces).distance == pytest.approx(3.0 * known.solve(forces).distance)


def test_a_state_says_whether_its_load_was_learned(reduced: Surrogate, data: DataSet, forces: np.ndarray) -> None:
    """By its distance, which knows no displacement, or by how far it moves the body."""
    assert reduced.solve(forces).is_inside is None is reduced.solve(forces).distance
    known = with_domain(reduced, data)
    domain, state = known.card["domain"], known.solve(forces)
    assert state.is_inside == (state.extrapolation_ratio <= 1.0)
    far = known.solve(1.5 / state.distance * forces)
    assert far.distance == pytest.approx(1.5) and far.is_inside is False
    largest = np.linalg.norm(state.displacement, axis=1).max()
    stiff = known.with_card(domain={**domain, "displacement_m": largest / 2.0}).solve(forces)
    assert (
        stiff.distance == state.distance < 1.0
        and stiff.extrapolation_ratio == pytest.approx(2.0)
        and stiff.is_inside is False
    )


def test_forces_where_none_were_trained_are_refused_by_name(surrogate: Surrogate) -> None:
    inside = int(np.setdiff1d(surrogate.body.free, surrogate.encoder_decoder.loaded)[0])
    bad = np.zeros_like(surrogate.body.points)
    bad[inside, 1] = 1e-9
    with pytest.raises(ValueError, match=rf"1 others, first \[{inside}\]"):
        surrogate.solve(bad)
    with pytest.raises(ValueError, match=rf"basis.*first \[{inside}\]"):
        surrogate.reduced([0], bad.reshape(-1, 1))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_forces_that_are_not_finite_are_refused(surrogate: Surrogate, value: float) -> None:
    with pytest.raises(ValueError, match="forces: expected finite numbers"):
        surrogate.solve(np.full_like(surrogate.body.points, value))


def test_wrong_shapes_are_refused(surrogate: Surrogate) -> None:
    count = surrogate.body.points.size
    with pytest.raises(ValueError, match=r"forces: expected shape \(45, 3\), got \(3,\)"):
        surrogate.solve(np.zeros(3))
    with pytest.raises(ValueError, match=rf"changes: expected shape \({count}, k\)"):
        surrogate.solve(np.zeros_like(surrogate.body.points)).jvp(np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"nodes: expected 0\.\.44, got 0\.\.45"):
        surrogate.reduced([0, 45], np.zeros((count, 2)))
    with pytest.raises(ValueError, match=r"coefficients: expected shape \(2,\), got \(3,\)"):
        surrogate.reduced([0], np.zeros((count, 2))).solve(np.zeros(3))


# ------------------------------------------------------------------ on disk


def test_a_loaded_surrogate_is_the_saved_one_bit_by_bit(
    surrogate: Surrogate, forces: np.ndarray, tmp_path: Path
) -> None:
    save(surrogate, tmp_path / "twin")
    again = load(tmp_path / "twin", surrogate.body)
    before, after = surrogate.solve(forces), again.solve(forces)
    assert np.array_equal(after.displacement, before.displacement)
    assert np.array_equal(after.vjp(forces), before.vjp(forces))
    assert again.card["architecture"] == surrogate.card["architecture"]
    assert {path.name for path in (tmp_path / "twin").iterdir()} == {WEIGHTS, CARD}


def test_maps_under_their_earlier_name_are_read(reduced: Surrogate, forces: np.ndarray, tmp_path: Path) -> None:
    save(reduced, tmp_path)
    tensors = load_file(tmp_path / WEIGHTS)
    assert {name.split(".")[0] for name in tensors} == {"maps", "core"}
    save_file({re.sub(r"^maps\.", "frame.", name): array for name, array in tensors.items()}, tmp_path / WEIGHTS)
    card = json.loads((tmp_path / CARD).read_text())
    card |= {"weights": hashlib.sha256((tmp_path / WEIGHTS).read_bytes()).hexdigest(), "format": 1}
    (tmp_path / CARD).write_text(json.dumps(card))
    again = load(tmp_path, reduced.body)
    np.testing.assert_array_equal(again.solve(forces).displacement, reduced.solve(forces).displacement)


def test_the_card_says_what_it_was_trained_on(reduced: Surrogate, data: DataSet, tmp_path: Path) -> None:
    save(reduced.with_card(held_out={"relative": 0.01}), tmp_path)
    card = json.loads((tmp_path / CARD).read_text())
    assert card["samples"] == {
        "train": len(data.samples("train")),
        "validation": len(data.samples("validation")),
        "rejected": {"unstable equilibrium": 64 // 5},
    }
    assert card["data"]["versions"] == {"closed form": "1"}
    assert card["plan"]["seed"] == 0
    assert card["body"] == data.body.fingerprint
    assert card["held_out"] == {"relative": 0.01}
    assert "not a medical device" in card["notice"]
    peaks = np.linalg.norm(data.samples("train").displacements, axis=2)
    assert card["domain"]["largest_displacement_m"] == peaks.max()


def test_an_empty_folder_is_no_twin(small_beam: Body, tmp_path: Path) -> None:
    with pytest.raises(TwinError, match=r"expected a twin with surrogate\.json"):
        load(tmp_path, small_beam)


def test_a_twin_of_another_body_is_refused(reduced: Surrogate, tmp_path: Path) -> None:
    save(reduced, tmp_path)
    with pytest.raises(TwinError, match="belongs to another body"):
        load(tmp_path, beam((4, 2, 2), (0.4, 0.2, 0.21)))


@pytest.mark.parametrize("damage", ["cut", "flip", "delete"])
def test_damaged_weights_are_refused(reduced: Surrogate, tmp_path: Path, damage: str) -> None:
    save(reduced, tmp_path)
    path = tmp_path / WEIGHTS
    content = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flip":
        content[-1] ^= 1
        path.write_bytes(content)
    else:
        path.unlink()
    expected = "cannot be read" if damage == "delete" else "truncated or changed"
    with pytest.raises(TwinError, match=expected):
        load(tmp_path, reduced.body)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text[: len(text) // 2], "truncated"),
        (lambda text: text.replace('"format": 2', '"format": 99'), "card of format 2"),
        (lambda text: text.replace('"weights"', '"heights"'), "lacks"),
        (lambda text: text.replace('"architecture": "reduced"', '"architecture": "oracle"', 1), "known architecture"),
    ],
)
def test_damaged_cards_are_refused(reduced: Surrogate, tmp_path: Path, edit: object, message: str) -> None:
    save(reduced, tmp_path)
    text = (tmp_path / CARD).read_text()
    changed = edit(text)  # type: ignore[operator]
    assert changed != text
    (tmp_path / CARD).write_text(changed)
    with pytest.raises(TwinError, match=message):
        load(tmp_path, reduced.body)
