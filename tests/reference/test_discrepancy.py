"""Errors as patterns, put together and kept in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.reference.data.discrepancy import (
    Discrepancy,
    DiscrepancyError,
    discrepancy_of,
    read_discrepancy,
    write_discrepancy,
)


@pytest.fixture
def errors(hexahedral_beam: Body) -> np.ndarray:
    rng = np.random.default_rng(0)
    patterns = rng.standard_normal((3, hexahedral_beam.points.size))
    return rng.standard_normal((40, 3)) @ patterns


def test_errors_of_a_few_patterns_leave_nothing_out(errors: np.ndarray, hexahedral_beam: Body) -> None:
    found, bounded = discrepancy_of(errors, hexahedral_beam, 8)
    assert bounded == 0 and found.modes.shape[1] == 3
    np.testing.assert_allclose(found.modes @ found.modes.T, errors.T @ errors / len(errors), atol=1e-10)
    assert found.rest.max() < 1e-12


def test_errors_of_nothing_have_no_patterns_and_change_no_other(errors: np.ndarray, hexahedral_beam: Body) -> None:
    none, _ = discrepancy_of(np.zeros_like(errors), hexahedral_beam, 8)
    assert none.modes.shape == (errors.shape[1], 0)
    some, _ = discrepancy_of(errors, hexahedral_beam, 2)
    both = some.beside(none)
    np.testing.assert_array_equal(both.modes, some.modes)
    np.testing.assert_array_equal(both.rest, some.rest)
    assert both.places == pytest.approx(some.places)


def test_two_sources_add_their_covariances(hexahedral_beam: Body) -> None:
    n = len(hexahedral_beam.points)
    one = Discrepancy(np.ones((3 * n, 1)), np.full(n, 3.0), 10.0)
    two = Discrepancy(np.full((3 * n, 2), 2.0), np.full(n, 4.0), 20.0)
    both = one.beside(two)
    assert both.modes.shape == (3 * n, 3)
    np.testing.assert_allclose(both.rest, 5.0)
    assert both.places == pytest.approx(25.0 / (9.0 / 10.0 + 16.0 / 20.0))


def test_a_file_gives_back_what_was_written(errors: np.ndarray, hexahedral_beam: Body, tmp_path: Path) -> None:
    found, _ = discrepancy_of(errors, hexahedral_beam, 2)
    write_discrepancy(tmp_path / "doubt.npz", found, hexahedral_beam, {"attachment": 0.004})
    again, made_of = read_discrepancy(tmp_path / "doubt.npz", hexahedral_beam)
    np.testing.assert_array_equal(again.modes, found.modes)
    np.testing.assert_array_equal(again.rest, found.rest)
    assert again.places == found.places and made_of == {"attachment": 0.004}
    assert [path.name for path in tmp_path.iterdir()] == ["doubt.npz"]


def test_files_that_cannot_be_used_are_refused(
    errors: np.ndarray, hexahedral_beam: Body, tetrahedral_beam: Body, tmp_path: Path
) -> None:
    file = tmp_path / "doubt.npz"
    with pytest.raises(DiscrepancyError, match="cannot be read"):
        read_discrepancy(file, hexahedral_beam)
    write_discrepancy(file, discrepancy_of(errors, hexahedral_beam, 2)[0], hexahedral_beam, {})
    with pytest.raises(DiscrepancyError, match="belongs to another body"):
        read_discrepancy(file, tetrahedral_beam)
    file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(DiscrepancyError, match="cannot be read"):
        read_discrepancy(file, hexahedral_beam)
    file.write_bytes(b"words")
    with pytest.raises(DiscrepancyError, match="cannot be read"):
        read_discrepancy(file, hexahedral_beam)


def test_of_three_samples_nothing_is_said(errors: np.ndarray, hexahedral_beam: Body) -> None:
    with pytest.raises(ValueError, match="errors: expected at least 4 samples, got 3"):
        discrepancy_of(errors[:3], hexahedral_beam, 2)
