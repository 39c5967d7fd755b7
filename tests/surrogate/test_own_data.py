"""Data from one's own simulator: learned like the reference's, and refused where it cannot be what it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSetError
from softtwin.reference.data.materials import Energy, NeoHookean
from softtwin.surrogate.balance import balance
from softtwin.surrogate.discrepancy import with_discrepancy
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.evaluate import evaluate, table
from softtwin.surrogate.from_arrays import data_set_from_arrays
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.train import train

COUNT = 160
PLAN = TrainingPlan(Reduced(modes=6, width=32, depth=2), epochs=400)


@pytest.fixture(scope="module")
def arrays(small_beam: Body, closed_form: Any) -> tuple[np.ndarray, np.ndarray]:
    """Forces in newtons and displacements in metres of a simulator with a closed form."""
    rng = np.random.default_rng(4)
    forces = np.zeros((COUNT, *small_beam.points.shape))
    loaded = np.setdiff1d(small_beam.boundary_nodes, small_beam.fixed)
    shapes = closed_form.shapes[:, loaded]
    forces[:, loaded] = 0.05 * np.einsum("sk,kni->sni", rng.uniform(-1.0, 1.0, (COUNT, len(shapes))), shapes)
    return forces, np.stack([closed_form.solve(one) for one in forces])


def made(path: Path, body: Body, arrays: tuple[np.ndarray, np.ndarray], **options: Any) -> Any:
    given = {"length_unit": "m", "force_unit": "N", **options}
    return data_set_from_arrays(path / "data.zarr", body, *arrays, **given)


def test_every_sample_is_in_one_split_as_it_came(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    """In other units, too; blocks are filled up with draws that nobody sees."""
    forces, displacements = arrays
    data = made(tmp_path, small_beam, (1e3 * forces, 1e2 * displacements), length_unit="cm", force_unit="mN")
    found = [data.samples(split) for split in ("train", "validation", "test")]
    assert [len(samples) for samples in found] == [128, 16, 16] and len(data.rejected().draws) == 0
    assert data.missing_blocks() == [] and data.damaged_blocks() == {}
    stored = np.concatenate([samples.displacements for samples in found])
    order = np.argsort(stored.sum(axis=(1, 2)))
    known = np.argsort(displacements.sum(axis=(1, 2)))
    np.testing.assert_allclose(stored[order], displacements[known], rtol=1e-12)
    loads = np.concatenate([samples.forces for samples in found])[order]
    np.testing.assert_allclose(loads, forces[known][:, data.response.loaded], rtol=1e-12)


def test_splits_can_be_said(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    splits = {"train": np.arange(40), "validation": np.arange(40, 50), "test": np.arange(50, COUNT)}
    data = made(tmp_path, small_beam, arrays, splits=splits)
    np.testing.assert_array_equal(data.samples("test").displacements, arrays[1][50:])


def test_a_surrogate_learns_from_it(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    """Better than the linear map of least squares, which the data set brings; nothing is said of gradients."""
    data = made(tmp_path, small_beam, arrays)
    surrogate = with_discrepancy(with_domain(train(data, PLAN), data), data)
    found, test = evaluate(surrogate, data), data.samples("test")
    linear = data.response.apply(test.forces)
    missed = np.linalg.norm(linear - test.displacements, axis=(1, 2)) / np.linalg.norm(test.displacements, axis=(1, 2))
    assert found.relative_error.median < 0.5 * np.median(missed)
    assert found.gradient_cosine is None and " cos " not in table({"own": found}).partition("\n\n")[0]
    with pytest.raises(DataSetError, match="expected a known material"):
        balance(surrogate, data)


def test_with_a_material_the_linear_response_is_that_at_rest(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    law = NeoHookean(20.0, 0.4)
    data = made(tmp_path, small_beam, arrays, material=law)
    body = ElasticBody(small_beam, law)
    load = 1e-7 * torch.from_numpy(arrays[0][:1])
    moved = torch.from_numpy(data.response.apply(load.numpy()[:, data.response.loaded]))
    assert float(body.residual(moved, load)) < 1e-4
    assert data.material.parameters == law.parameters
    assert balance(train(data, replace(PLAN, epochs=20)), data).samples == 16


def test_the_fitted_map_is_exact_where_the_simulator_is_linear(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    forces, _ = arrays
    mixing = np.random.default_rng(1).standard_normal((forces[0].size, forces[0].size))
    mixing.reshape(-1, 3, forces[0].size)[small_beam.fixed] = 0.0
    # neighbours move alike: averaged over all nodes but for a little
    fields = 1e-2 * (forces.reshape(COUNT, -1) @ mixing.T).reshape(forces.shape)
    smooth = fields.mean(axis=1, keepdims=True) * small_beam.points[:, :1] / 0.4
    data = made(tmp_path, small_beam, (forces, smooth))
    test = data.samples("test")
    np.testing.assert_allclose(data.response.apply(test.forces), test.displacements, atol=1e-9 * np.abs(smooth).max())


def _changed(field: np.ndarray, at: Any, value: float) -> np.ndarray:
    copy = field.copy()
    copy[at] = value
    return copy


WRONG: dict[str, tuple[Any, dict[str, Any], str]] = {
    "shape": (lambda b, u: (b[:, 1:], u), {}, r"\.forces: expected shape \(s, 45, 3\)"),
    "empty": (lambda b, u: (b[:0], u[:0]), {}, r"\.forces: expected shape .*s >= 1"),
    "nan": (lambda b, u: (b, _changed(u, (2, 5, 0), np.nan)), {}, r"\.displacements: expected finite.* got 1 samples"),
    "counts": (lambda b, u: (b[1:], u), {}, r"as many forces as displacements, got 159 and 160"),
    "unit": (lambda b, u: (b, 1e3 * u), {}, r"\.length_unit: .* are they in another unit\?"),
    "nothing said": (lambda b, u: (b, u), {"length_unit": None, "force_unit": None}, r"\.force_unit: .* got none"),
    "no length unit": (lambda b, u: (b, u), {"length_unit": None}, r"\.length_unit: expected one of m, .*, got none"),
    "another unit": (
        lambda b, u: (b, u),
        {"length_unit": "inch"},
        r"\.length_unit: expected one of m, cm, mm, got 'inch'",
    ),
    "another force unit": (lambda b, u: (b, u), {"force_unit": "lbf"}, r"\.force_unit: expected one of N, mN, kN"),
    "zeros": (lambda b, u: (0 * b, 0 * u), {}, "got zeros alone"),
    "reactions": (lambda b, u: (_changed(b, (slice(None), 0), 0.1), u), {}, r"\.forces: .*reactions are not part"),
    "attachment": (lambda b, u: (b, u + 0.01), {}, r"\.displacements: expected fixed nodes at rest"),
    "too few": (lambda b, u: (b[:2], u[:2]), {}, r"\.splits: expected samples in each split, got too few: 2"),
    "overlap": (lambda b, u: (b, u), {"splits": {"train": [0, 1], "validation": [1], "test": [2]}}, "at most once"),
    "names": (lambda b, u: (b, u), {"splits": {"train": [0], "val": [1], "test": [2]}}, r"\.splits: expected train"),
    "material": (
        lambda b, u: (b, u),
        {"material": Energy(lambda F, mu: mu, {"mu": 1.0})},
        r"\.material: expected one of .* constant parameters",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_refused_and_nothing_is_written(
    name: str, tmp_path: Path, small_beam: Body, arrays: Any
) -> None:
    change, options, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        made(tmp_path, small_beam, change(*arrays), **options)
    assert list(tmp_path.iterdir()) == []


def test_units_have_no_default(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    with pytest.raises(ValueError, match=r"data_set_from_arrays\.force_unit: expected one of N, mN, kN, got none"):
        data_set_from_arrays(tmp_path / "data.zarr", small_beam, *arrays)
    assert list(tmp_path.iterdir()) == []


def test_another_node_order_is_seen(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    """Fixed nodes left in their place, so that only the neighbours tell."""
    free = small_beam.free
    order = np.arange(len(small_beam.points))
    order[free] = np.random.default_rng(0).permutation(free)
    with pytest.raises(ValueError, match=r"nodes of one cell that differ .* the node order is not that of the body"):
        made(tmp_path, small_beam, (arrays[0], arrays[1][:, order]))
    whole = np.random.default_rng(0).permutation(len(order))
    with pytest.raises(ValueError, match=r"expected fixed nodes at rest.* node order"):
        made(tmp_path, small_beam, (arrays[0], arrays[1][:, whole]))


def test_what_is_there_stays(tmp_path: Path, small_beam: Body, arrays: Any) -> None:
    made(tmp_path, small_beam, arrays)
    with pytest.raises(DataSetError, match="expected a folder that is not there yet"):
        made(tmp_path, small_beam, arrays)
