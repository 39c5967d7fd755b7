"""Patterns of a surrogate's errors: what they hold of errors that they were not made from, and that twins keep them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.discrepancy import discrepancy_of
from softtwin.surrogate import discrepancy
from softtwin.surrogate.discrepancy import relative_errors, smooth_errors, with_discrepancy
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import load, save


def test_patterns_hold_most_of_held_out_errors(reduced: Surrogate, data: DataSet) -> None:
    known = with_discrepancy(reduced, data)
    assert reduced.discrepancy is None
    modes = known.discrepancy.modes
    missing = relative_errors(known, data, data.samples("test"))
    basis = np.linalg.qr(modes)[0]
    rest = missing - (missing @ basis) @ basis.T
    assert (rest**2).sum() < 0.3 * (missing**2).sum()
    assert np.abs(modes.reshape(*known.body.points.shape, -1)[known.body.fixed]).max() < 1e-12
    assert known.discrepancy.rest.shape == known.body.points.shape[:1]
    assert known.discrepancy.rest.max() > 0.0 and (known.discrepancy.rest**2).mean() < (missing**2).mean()


def test_their_size_is_that_of_the_errors(reduced: Surrogate, data: DataSet) -> None:
    """The covariance of the patterns has the trace of the validation errors, as far as it is not cut off."""
    missing = relative_errors(reduced, data, data.samples("validation"))
    every = with_discrepancy(reduced, data, maximum=len(missing)).discrepancy
    few = with_discrepancy(reduced, data, maximum=2).discrepancy
    np.testing.assert_allclose((every.modes**2).sum(), (missing**2).sum() / len(missing))
    assert few.modes.shape[1] == 2 and few.rest.sum() > every.rest.sum()


def test_one_error_far_above_the_others_does_not_speak_for_all(
    reduced: Surrogate, data: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample on another branch, say: it counts, as some times the median of the others."""
    before = with_discrepancy(reduced, data, maximum=2)
    missing = relative_errors(reduced, data, data.samples("validation"))
    missing[3] *= 1e3 * np.median(np.linalg.norm(missing, axis=1)) / np.linalg.norm(missing[3])
    monkeypatch.setattr(discrepancy, "relative_errors", lambda *_: missing)
    after = with_discrepancy(reduced, data, maximum=2)
    assert after.card["discrepancy"]["bounded"] == before.card["discrepancy"]["bounded"] + 1
    assert (after.discrepancy.modes**2).sum() < 10.0 * (before.discrepancy.modes**2).sum()
    assert (after.discrepancy.rest**2).sum() < 10.0 * (before.discrepancy.rest**2).sum()


def test_a_saved_twin_keeps_them(reduced: Surrogate, data: DataSet, tmp_path: Path) -> None:
    known = with_discrepancy(reduced, data, maximum=3)
    save(known, tmp_path)
    again = load(tmp_path, known.body).discrepancy
    np.testing.assert_array_equal(again.modes, known.discrepancy.modes)
    np.testing.assert_array_equal(again.rest, known.discrepancy.rest)
    assert again.places == known.discrepancy.places > 1.0


def test_smooth_samples_count_beside_the_validation_samples(
    reduced: Surrogate, data: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the test samples stand for them; one is made too large for the surrogate's domain."""
    smooth = data.samples("test")
    smooth.forces[2] *= 100.0
    monkeypatch.setitem(data.header["samples"], "smooth", len(smooth))
    real = DataSet.samples
    monkeypatch.setattr(DataSet, "samples", lambda it, split, *_: smooth if split == "smooth" else real(it, split))
    known = with_domain(reduced, data)
    missing = relative_errors(known, data, data.samples("validation"))
    inside = np.delete(relative_errors(known, data, smooth), 2, axis=0)
    both = np.concatenate([missing, inside])
    found = with_discrepancy(known, data, maximum=len(both))
    assert found.card["discrepancy"]["samples"] == len(both) and found.card["discrepancy"]["smooth"] == len(inside)
    np.testing.assert_allclose(smooth_errors(known, data), inside)
    expected, _ = discrepancy_of(both, data.body, len(both), discrepancy._BOUND)
    np.testing.assert_allclose((found.discrepancy.modes**2).sum(), (expected.modes**2).sum())


def test_too_few_samples_say_nothing(reduced: Surrogate, data: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    three = data.samples("validation", 3)
    monkeypatch.setattr(DataSet, "samples", lambda *_: three)
    assert with_discrepancy(reduced, data).discrepancy is None
