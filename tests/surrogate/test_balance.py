"""How far predictions are from balance: against the truth of a body, and what each figure counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.surrogate.balance import balance, predictions
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.residual import ElasticBody


def test_figures_are_those_of_each_prediction(surrogate: Surrogate, soft: DataSet) -> None:
    body, samples = ElasticBody(soft.body, soft.material), soft.samples("test")
    forces, found = predictions(surrogate, soft, samples)
    residuals, gaps = [], []
    for b, u, truth in zip(forces, found, samples.displacements, strict=True):
        b, u, truth = (torch.from_numpy(field)[None] for field in (b, u, truth))
        residuals.append(float(body.residual(u * body.free, b)))
        gaps.append(
            float((body.potential(u * body.free, b) - body.potential(truth, b)) / body.potential(truth, b).abs())
        )
    counted = []

    def pivots(displacement: np.ndarray) -> int:
        assert not displacement[soft.body.fixed].any()
        counted.append(displacement)
        return len(counted) % 2

    figures = balance(surrogate, soft, negative_pivots=pivots)
    assert figures.residual is not None and figures.energy_gap is not None
    assert (figures.samples, figures.inside_out, figures.indefinite) == (13, 0, 7)
    assert figures.residual.mean == pytest.approx(np.mean(residuals), rel=1e-9)
    assert figures.energy_gap.max == pytest.approx(np.max(gaps), rel=1e-9)
    at_rest = surrogate.solve(np.zeros_like(soft.body.points)).displacement
    assert figures.at_rest == pytest.approx(np.linalg.norm(at_rest, axis=1).mean())
    assert (figures.at_rest == 0.0) == (surrogate.card["architecture"] == "reduced")
    assert (figures.at_fixed_nodes == 0.0) == (surrogate.card["architecture"] == "reduced")


def test_predictions_inside_out_are_counted_and_in_no_average(reduced: Surrogate, soft: DataSet) -> None:
    """Forty times too large and the other way: NaN must not hide in a mean."""
    encoder_decoder = replace(
        reduced.encoder_decoder,
        left=-40.0 * reduced.encoder_decoder.left,
        decode=-40.0 * reduced.encoder_decoder.decode,
    )
    wild = Surrogate(reduced.body, encoder_decoder, reduced.network, reduced.card)
    figures = balance(wild, soft)
    assert 0 < figures.inside_out <= figures.samples
    assert figures.residual is None or np.isfinite(figures.residual.mean)
    assert figures.indefinite is None


def test_what_cannot_be_judged_is_refused(reduced: Surrogate, data: DataSet) -> None:
    with pytest.raises(DataSetError, match="expected a known material"):
        balance(reduced, data)
    other = Surrogate(beam((4, 2, 2), (0.4, 0.2, 0.3)), reduced.encoder_decoder, reduced.network, reduced.card)
    with pytest.raises(ValueError, match=r"balance\.data: .* another body"):
        balance(other, data)
