"""What an organ may be otherwise: alternatives of it, solved and compared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.shapes import liver_phantom
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.generate import Plan, generate
from softtwin.reference.model_error import ModelErrorEnsemble, differences, forget, shifted
from softtwin.reference.solve.problem import Problem

PLAN = Plan(
    loads=LoadPlan(patches=1, displacement=0.02, modes=20),
    samples={"train": 6, "validation": 1, "test": 1},
    block=2,
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    made = generate(tmp_path_factory.mktemp("alternatives") / "data.zarr", liver_phantom(0.02), PLAN)
    assert made is not None
    return made


def test_no_shift_holds_the_same_nodes_and_a_long_one_others(data: DataSet) -> None:
    body = data.body
    np.testing.assert_array_equal(shifted(body, np.zeros(3)), body.fixed)
    away = shifted(body, np.array([0.04, 0.0, 0.0]))
    moved = body.points[away].mean(axis=0) - body.points[body.fixed].mean(axis=0)
    assert moved[0] > 0.01 and np.isin(away, body.boundary_nodes).all()


def test_an_error_is_the_alternative_less_the_model(data: DataSet) -> None:
    """Poisson's ratio alone, so that the same can be solved here."""
    found = differences(data.path, ModelErrorEnsemble(poisson_ratio=(0.3, 0.3)), 3)
    samples, body = data.samples("train"), data.body
    with Problem(body, replace(PLAN, poisson_ratio=0.3).build_material(), PLAN.newton) as problem:
        for error, loads, known in zip(found.errors, samples.forces, samples.displacements, strict=False):
            forces = np.zeros_like(body.points)
            forces[data.response.loaded] = loads
            off = problem.solve(forces).displacement - known
            size = np.linalg.norm(known, axis=1).max()
            np.testing.assert_allclose(error.reshape(-1, 3), off / size, atol=1e-6)
    assert found.failed == 0 and np.abs(found.errors).max() > 1e-3


def test_another_mesh_carries_the_loads_and_the_nodes(data: DataSet) -> None:
    """Linear tetrahedra of another size move the same way, farther or less far: what holds them, and the loads, stay.

    No two meshes are alike (see `solidify`), so nothing is asked of single figures.
    """
    pytest.importorskip("pytetwild")
    found = differences(data.path, ModelErrorEnsemble(meshes=2), 6)
    lengths = np.linalg.norm(found.errors.reshape(len(found.errors), -1, 3), axis=2)
    assert len(found.errors) > 1  # of the coarser mesh hardly more than three nodes are held
    assert len(list((data.path.parent / "doubt").rglob("mesh_*.vtu"))) == 2
    assert (lengths.max(axis=1) > 1e-3).all()  # no alternative is the model's own mesh
    own = data.samples("train").displacements
    own = own / np.linalg.norm(own, axis=2).max(axis=1)[:, None, None]
    assert lengths.mean() < np.linalg.norm(own, axis=2).mean()  # nearer to the model's states than those are to rest
    others = found.errors.reshape(-1, 1, *own.shape[1:]) + own  # each on top of every state: one of them is its own
    along = (others * own).sum(axis=(2, 3)) / (np.linalg.norm(others, axis=(2, 3)) * np.linalg.norm(own, axis=(1, 2)))
    assert (along.max(axis=1) > 0.9).all()
    again = differences(data.path, ModelErrorEnsemble(meshes=2), 6)
    np.testing.assert_array_equal(again.errors, found.errors)
    forget(data.path)


def test_another_mesh_of_the_same_cells_changes_nothing(data: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    body = data.body
    same = type("Solid", (), {"points": body.points, "cells": body.cells})
    monkeypatch.setattr("softtwin.reference.model_error.solidify", lambda surface, node_count: same)
    found = differences(data.path, ModelErrorEnsemble(meshes=1), 3)
    assert (
        found.failed == 0 and np.abs(found.errors).max() < 1e-5
    )  # of the largest displacement: the solver's tolerance
    forget(data.path)


def test_draws_are_the_same_however_often_they_were_interrupted(data: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = ModelErrorEnsemble(attachment=0.02)
    forget(data.path)
    whole = differences(data.path, asked, 6)
    kept = sorted((data.path.parent / "doubt").rglob("*.npy"))
    assert len(kept) == 2
    kept[0].unlink()
    again = differences(data.path, asked, 6)
    np.testing.assert_array_equal(again.errors, whole.errors)
    few = differences(data.path, asked, 3)
    np.testing.assert_array_equal(few.errors, whole.errors[: len(few.errors)])


def test_other_draws_throw_these_away(data: DataSet) -> None:
    differences(data.path, ModelErrorEnsemble(attachment=0.02), 2)
    differences(data.path, ModelErrorEnsemble(attachment=0.01), 2)
    assert len(list((data.path.parent / "doubt").iterdir())) == 1
    forget(data.path)
    assert not (data.path.parent / "doubt").exists()


def test_what_nothing_holds_counts_as_failed(data: DataSet) -> None:
    found = differences(data.path, ModelErrorEnsemble(attachment=10.0), 4)  # metres: most shifts leave the organ
    assert len(found.errors) + found.failed == 4 and found.failed > 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "expected something that may be otherwise"),
        ({"attachment": -1.0}, "attachment: expected a length of 0 m or more"),
        ({"poisson_ratio": (0.4, 0.3)}, "poisson_ratio: expected 0 <= least <= largest < 0.5"),
        ({"poisson_ratio": (0.4, 0.5)}, "poisson_ratio: expected 0 <= least <= largest < 0.5"),
    ],
)
def test_what_cannot_be_asked_is_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ModelErrorEnsemble(**values)  # type: ignore[arg-type]


def test_bad_requests_are_refused(data: DataSet) -> None:
    with pytest.raises(ValueError, match="count: expected at least 1, got 0"):
        differences(data.path, ModelErrorEnsemble(attachment=0.01), 0)


def test_a_file_of_the_folder_of_draws_is_whole_or_not_there(data: DataSet) -> None:
    differences(data.path, ModelErrorEnsemble(attachment=0.01), 2)
    names = {path.name for path in Path(data.path.parent / "doubt").rglob("*") if path.is_file()}
    assert names == {"0.npy"}
