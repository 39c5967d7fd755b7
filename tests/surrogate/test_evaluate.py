"""Held-out errors: what is printed is what is defined."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.evaluate import (
    DEFINITIONS,
    cosine,
    evaluate,
    jacobian_errors,
    registration_cosines,
    spread,
    table,
)
from softtwin.surrogate.model import Surrogate


def _predictions(surrogate: Surrogate, data: DataSet) -> np.ndarray:
    forces = np.zeros((len(data.samples("test")), *data.body.points.shape))
    forces[:, data.response.loaded] = data.samples("test").forces
    return np.stack([surrogate.solve(load).displacement for load in forces])


def test_errors_follow_their_definitions(surrogate: Surrogate, data: DataSet) -> None:
    error = _predictions(surrogate, data) - data.samples("test").displacements
    truth = data.samples("test").displacements
    found = evaluate(surrogate, data)
    distances = np.sqrt((error**2).sum(axis=2))
    assert found.nodal_error.mean == pytest.approx(distances.mean())
    assert found.largest_error.mean == pytest.approx(distances.max(axis=1).mean())
    norms = np.sqrt((error**2).sum(axis=(1, 2)))
    assert found.thesis_error.mean == pytest.approx(norms.mean() / 45)
    relative = norms / np.sqrt((truth**2).sum(axis=(1, 2)))
    assert found.relative_error.median == pytest.approx(np.median(relative))
    assert found.signal_to_noise.median == pytest.approx(np.median(20.0 * np.log10(1.0 / relative)))
    assert found.displacement_norm.max == pytest.approx(np.sqrt((truth**2).sum(axis=(1, 2))).max())


def test_gradients_of_the_reduced_network_point_where_the_truth_does(
    reduced: Surrogate, data: DataSet, closed_form: object
) -> None:
    assert evaluate(reduced, data).gradient_cosine.median > 0.99
    samples = data.samples("test")
    loads = {u.tobytes(): f for u, f in zip(samples.displacements, samples.forces, strict=True)}

    def adjoint(displacement: np.ndarray, cotangent: np.ndarray) -> np.ndarray:
        load = np.zeros_like(cotangent)
        load[data.response.loaded] = loads[displacement.tobytes()]
        return closed_form.adjoint(load, cotangent)  # type: ignore[attr-defined]

    cosines = registration_cosines(reduced, data, samples, adjoint)
    assert len(cosines) == len(samples)
    assert np.median(cosines) > 0.99


def test_rejected_draws_are_counted_and_left_out(reduced: Surrogate, data: DataSet) -> None:
    found = evaluate(reduced, data)
    assert found.rejected == {"unstable equilibrium": 3}  # draws 84, 89 and 94 of 80..95
    assert found.samples == 13
    assert evaluate(reduced, data, limit=5).rejected == {"unstable equilibrium": 1}


def test_the_table_prints_every_definition(surrogate: Surrogate, data: DataSet) -> None:
    text = table({"this one": evaluate(surrogate, data)})
    for _, symbol, definition, _ in DEFINITIONS:
        assert f"{symbol}: {definition}" in text
    assert "13 accepted test samples averaged, 3 draws rejected (3 unstable equilibrium)" in text


def test_spread_of_known_values() -> None:
    found = spread(np.arange(101.0))
    assert (found.mean, found.median, found.p5, found.p95, found.max) == (50.0, 50.0, 5.0, 95.0, 100.0)


def test_cosine_of_known_angles() -> None:
    x, y = np.array([[1.0, 0.0]]), np.array([[1.0, 1.0]])
    assert cosine(x, y) == pytest.approx(np.sqrt(0.5))
    assert cosine(x, -3.0 * x) == -1.0
    assert cosine(x, 0.0 * x) == 0.0


def test_a_surrogate_of_another_body_is_refused(reduced: Surrogate, data: DataSet) -> None:
    other = Surrogate(beam((4, 2, 2), (0.4, 0.2, 0.3)), reduced.encoder_decoder, reduced.network, reduced.card)
    with pytest.raises(ValueError, match="another body"):
        evaluate(other, data)


def test_data_of_another_material_are_refused(
    reduced: Surrogate, data: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = {**data.header["plan"], "material": "neo-hookean", "young_modulus": 5000.0, "poisson_ratio": 0.45}
    learned = reduced.with_card(data={"plan": own})
    for plan in (own, data.header["plan"]):  # the same, and a data set that does not say
        monkeypatch.setitem(data.header, "plan", plan)
        assert evaluate(learned, data).samples == 13
    for change in ({"young_modulus": 4500.0}, {"poisson_ratio": 0.3}, {"material": "linear"}):
        (name, value), *_ = change.items()
        monkeypatch.setitem(data.header, "plan", {**own, **change})
        message = rf"evaluate\.data: expected the material .* learned \({name} {own[name]}\), got {name} {value} in"
        with pytest.raises(ValueError, match=message):
            evaluate(learned, data)


def test_a_split_without_accepted_samples_is_refused(reduced: Surrogate, make_data: Callable[..., DataSet]) -> None:
    with pytest.raises(ValueError, match=r"evaluate\.split: expected accepted samples in the test split"):
        evaluate(reduced, make_data(rejected="test"))


def test_errors_of_the_jacobian_are_those_of_its_columns(reduced: Surrogate, data: DataSet) -> None:
    """Against one derivative at a time, and zero for a reference that is the surrogate itself."""
    samples = data.samples("test", 2)
    loaded = data.response.loaded
    truth = np.random.default_rng(0).standard_normal((data.body.points.size, 3 * len(loaded)))
    expected = []
    for load in samples.forces:
        forces = np.zeros_like(data.body.points)
        forces[loaded] = load
        state, missed = reduced.solve(forces), 0.0
        for column, entry in enumerate((3 * loaded[:, None] + np.arange(3)).ravel()):
            unit = np.zeros((data.body.points.size, 1))
            unit[entry] = 1.0
            missed += float(((state.jvp(unit)[:, 0] - truth[:, column]) ** 2).sum())
        expected.append(np.sqrt(missed) / np.linalg.norm(truth))
    np.testing.assert_allclose(jacobian_errors(reduced, data, samples, lambda c, u: truth), expected, rtol=1e-9)
    entries = (3 * loaded[:, None] + np.arange(3)).ravel()
    estimated = jacobian_errors(reduced, data, samples, lambda c, u: truth @ c[entries], probes=400)
    np.testing.assert_allclose(estimated, expected, rtol=0.02)
    own = {u.tobytes(): f for u, f in zip(samples.displacements, samples.forces, strict=True)}

    def itself(columns: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        forces = np.zeros_like(data.body.points)
        forces[loaded] = own[displacement.tobytes()]
        return reduced.solve(forces).jvp(columns)

    assert jacobian_errors(reduced, data, samples, itself).max() == 0.0
