"""`softtwin data`: what is in a data set, samples for ParaView, several sets as one."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.io import read_fields
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.reference.data.merge import merge
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.summary import summary
from softtwin.reference.data.writing import drop_block
from softtwin.reference.differentiate import differentiate
from softtwin.reference.generate import Plan, generate, plan_from_header
from softtwin.reference.solve.problem import NewtonOptions

from .conftest import run

pytestmark = pytest.mark.fenicsx
COUNTS = {"train": 7, "validation": 3, "test": 4}
PLAN = Plan(loads=LoadPlan(modes=4, displacement=0.1), samples=COUNTS, block=4)


def body() -> Body:
    return beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron")


def made(folder: Path, **changes: object) -> DataSet:
    found = generate(folder / "data.zarr", body(), replace(PLAN, **changes))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return made(tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def second(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    samples = {"train": 5, "validation": 2, "test": 2, "calibration": 3}
    return made(tmp_path_factory.mktemp("second"), seed=1, samples=samples, block=2)


# ---------------------------------------------------------------------- show


def test_what_is_in_a_set_is_said(capsys, first: DataSet) -> None:
    text = run(capsys, "data", "show", first.path)
    assert "4 of 4 blocks finished, 0 damaged" in text
    for words in (
        "train        7 accepted",
        "test         4 accepted",
        "Newton iterations",
        first.identity,
        "neo-hookean",
    ):
        assert words in text


def test_figures_are_those_of_the_samples(first: DataSet) -> None:
    found = summary(first)
    every = [first.samples(split) for split in COUNTS]
    peaks = np.concatenate([np.linalg.norm(each.displacements, axis=2).max(axis=1) for each in every])
    draws = np.concatenate([each.draws for each in every])
    expected = np.percentile(1e3 * peaks, (0, 5, 50, 95, 100))
    np.testing.assert_allclose(found.spread["largest nodal displacement, mm"], expected)
    assert found.extremes["most moved"] == draws[np.argmax(peaks)]
    assert found.extremes["least moved"] == draws[np.argmin(peaks)]
    assert found.jacobians is None and found.origin["seed"] == 0


def test_draws_that_were_rejected_are_counted_by_reason(capsys, tmp_path: Path) -> None:
    loads = LoadPlan(modes=4, amplitude=5.0)  # newtons a node: far too much for this beam
    data = made(tmp_path, loads=loads, newton=NewtonOptions(max_load_steps=1))
    found, rejected = summary(data), data.rejected()
    assert sum(counts.get("not converged", 0) for counts in found.draws.values()) == len(rejected.draws) > 0
    assert sum(counts.get("accepted", 0) for counts in found.draws.values()) == 14 - len(rejected.draws) > 0
    assert f"{found.draws['test']['not converged']} not converged" in run(capsys, "data", "show", data.path)


def test_missing_and_damaged_blocks_are_said_and_not_counted(capsys, first: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(first.path, path)
    drop_block(path, 0)
    chunk = next(each for each in (path / "samples" / "displacements" / "c" / "1").rglob("*") if each.is_file())
    chunk.write_bytes(chunk.read_bytes()[:10])
    found = summary(DataSet(path))
    assert found.missing == 1 and list(found.damaged) == [1]
    assert found.draws["train"] == {}
    assert "block 1 is damaged" in run(capsys, "data", "show", path)


# ---------------------------------------------------------------------- export


def test_the_extremes_can_be_looked_at(capsys, first: DataSet, tmp_path: Path) -> None:
    text = run(capsys, "data", "export", first.path, tmp_path / "out")
    files = sorted((tmp_path / "out").glob("*.vtu"))
    draws = {int(file.stem.split("-")[1]) for file in files}
    assert draws == set(summary(first).extremes.values()) and all(file.name in text for file in files)
    for file in files:
        draw = int(file.stem.split("-")[1])
        row = first.rows(range(draw, draw + 1))
        grid = pyvista.read(file)
        np.testing.assert_allclose(grid.point_data["displacement"], row["displacements"][0])
        np.testing.assert_allclose(grid.points, first.body.points + row["displacements"][0], atol=1e-6)
        np.testing.assert_allclose(grid.point_data["force"][first.response.loaded], row["forces"][0])
        picture = pyvista.read(file.with_suffix(".png"))
        assert picture.dimensions[0] > 300 and len(np.unique(picture.active_scalars, axis=0)) > 50
    assert read_fields(files[0]) is not None


def test_chosen_draws_alone_are_exported(capsys, first: DataSet, tmp_path: Path) -> None:
    run(capsys, "data", "export", first.path, tmp_path / "out", "--draw", 2, "--draw", 9)
    assert sorted(file.name for file in (tmp_path / "out").glob("*.vtu")) == ["draw-000002.vtu", "draw-000009.vtu"]


@pytest.mark.parametrize("draw", [-1, 10_000])
def test_draws_that_are_not_there_are_refused(capsys, first: DataSet, tmp_path: Path, draw: int) -> None:
    text = run(capsys, "data", "export", first.path, tmp_path / "out", f"--draw={draw}", code=2)
    assert f"expected a finished draw of {first.path}, got {draw}" in text


# ---------------------------------------------------------------------- merge


def test_a_merged_set_has_the_draws_of_all_where_they_were(
    capsys, first: DataSet, second: DataSet, tmp_path: Path
) -> None:
    text = run(capsys, "data", "merge", first.path, second.path, tmp_path / "both.zarr")
    assert "26 equilibria accepted, 0 rejected" in text
    both = DataSet(tmp_path / "both.zarr")
    for split in ("train", "validation", "test", "calibration"):
        parts = [each.samples(split) for each in (first, second)]
        found = both.samples(split)
        for name in ("forces", "displacements", "probes", "adjoints"):
            np.testing.assert_array_equal(getattr(found, name), np.concatenate([getattr(part, name) for part in parts]))
    assert both.missing_blocks() == [] and both.damaged_blocks() == {}
    origins = [entry["identity"] for entry in both.header["merged"]]
    assert origins == [first.identity, second.identity]
    assert "merged from" in run(capsys, "data", "show", both.path)


def test_smooth_draws_are_merged_where_they_are_as_smooth(first: DataSet, tmp_path: Path) -> None:
    """The first set has none; they stay a split of their own, which its plan knows of."""
    counts = {"train": 3, "validation": 2, "test": 2, "smooth": 3}
    parts = [
        made(tmp_path / str(seed), seed=seed, samples=counts, loads=replace(PLAN.loads, smoothness=length))
        for seed, length in ((1, 0.1), (2, 0.1), (3, 0.2))
    ]
    both = merge([first, *parts[:2]], tmp_path / "both.zarr")
    found, wanted = both.samples("smooth"), [part.samples("smooth") for part in parts[:2]]
    np.testing.assert_array_equal(found.forces, np.concatenate([part.forces for part in wanted]))
    learned = [each.samples("train").displacements for each in (first, *parts[:2])]
    np.testing.assert_array_equal(both.samples("train").displacements, np.concatenate(learned))
    plan = plan_from_header(both.header)
    assert plan.loads.smoothness == 0.1 and plan.samples["smooth"] == 6
    with pytest.raises(DataSetError, match=r"expected smooth draws of one correlation length .* got 0\.1 and 0\.2 m"):
        merge([parts[0], parts[2]], tmp_path / "other.zarr")


def test_a_merged_set_is_gone_on_with_as_far_as_nothing_is_drawn_anew(
    first: DataSet, second: DataSet, tmp_path: Path
) -> None:
    """Jacobians are made on it; a damaged block is not, for its draws are another set's."""
    both = merge([first, second], tmp_path / "both.zarr")
    modes = np.linalg.qr(np.random.default_rng(0).standard_normal((both.body.points.size, 3)))[0]
    modes.reshape(-1, 3, 3)[both.body.fixed] = 0.0
    differentiate(both.path, modes)
    assert summary(both).jacobians == (3, 0)
    plan = plan_from_header(both.header)
    assert generate(both.path, both.body, plan) is not None
    drop_block(both.path, 1)
    with pytest.raises(DataSetError, match=r"was merged from others and lacks blocks.*merge again"):
        generate(both.path, both.body, plan)


def test_a_draw_in_two_sets_is_refused(first: DataSet, tmp_path: Path) -> None:
    """The same seed with other counts would put a draw that was learned from among those held out."""
    other = made(tmp_path, samples={"train": 4, "validation": 4, "test": 4})
    with pytest.raises(DataSetError, match=r"expected draws that differ, got \d+ that are in more than one set"):
        merge([first, other], tmp_path / "both.zarr")
    assert not (tmp_path / "both.zarr").exists()


def test_draws_of_a_load_path_stay_together_and_apart_from_those_of_other_sets(tmp_path: Path) -> None:
    """Three draws of two paths lend their second path to no other set, in a set merged from merged ones either."""
    counts = {"train": 1, "validation": 1, "test": 1}
    parts = [
        made(tmp_path / str(seed), seed=seed, ramp=2, samples={**counts, "calibration": count})
        for seed, count in enumerate((3, 4, 3))
    ]
    both = merge(parts[:2], tmp_path / "both.zarr")
    whole = merge([both, parts[2]], tmp_path / "whole.zarr")
    held = whole.samples("calibration")
    loads = held.forces.reshape(len(held), -1)
    ways = loads / np.linalg.norm(loads, axis=1)[:, None]
    is_one_path = np.abs(ways @ ways.T - 1.0) < 1e-12  # sizes of one load
    paths = whole.load_paths("calibration", held.draws)
    assert len(held) == 10 and len(np.unique(paths)) == 6
    np.testing.assert_array_equal(paths[:, None] == paths[None], is_one_path)
    first = parts[0].samples("calibration")
    assert parts[0].load_paths("calibration", first.draws).tolist() == [0, 0, 1]
    assert len(np.unique(whole.load_paths("train", whole.samples("train").draws))) == 3


@pytest.mark.parametrize("order", [1, -1])
def test_sets_with_other_numbers_of_draws_a_path_are_refused(tmp_path: Path, order: int) -> None:
    """Merged, the sixteen draws of two paths would pass for as many paths, and bounds be the narrower for it."""
    counts = {"train": 1, "validation": 1, "test": 1}
    singly = made(tmp_path / "singly", samples={**counts, "calibration": 12})
    ramps = made(tmp_path / "ramps", seed=1, ramp=8, block=8, samples={**counts, "calibration": 16})
    with pytest.raises(
        DataSetError, match=r"as many draws of each load path, got .* with \d and \d \(samples\.load_path\)"
    ):
        merge([singly, ramps][::order], tmp_path / "both.zarr")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"young_modulus": 4000.0}, r"expected one material and support, got .*young_modulus \(5000\.0, 4000\.0\)"),
        (
            {"material": "linear-elastic"},
            r"expected one material and support, got .*material \(neo-hookean, linear-elastic\)",
        ),
        ({"loads": LoadPlan(modes=3, displacement=0.1)}, r"expected gradients for the same modes"),
    ],
)
def test_sets_that_do_not_belong_together_are_refused(
    first: DataSet, tmp_path: Path, changes: dict, message: str
) -> None:
    other = made(tmp_path, seed=2, samples={"train": 1, "validation": 1, "test": 1}, **changes)
    with pytest.raises(DataSetError, match=message):
        merge([first, other], tmp_path / "both.zarr")


def test_sets_of_two_bodies_are_refused(capsys, first: DataSet, tmp_path: Path) -> None:
    counts = {"train": 1, "validation": 1, "test": 1}
    other = generate(
        tmp_path / "data.zarr", beam((5, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), replace(PLAN, samples=counts)
    )
    assert other is not None
    text = run(capsys, "data", "merge", first.path, other.path, tmp_path / "both.zarr", code=2)
    assert "expected one body" in text


def test_what_is_there_is_not_written_over(first: DataSet, second: DataSet) -> None:
    with pytest.raises(DataSetError, match="expected a folder that is not there yet"):
        merge([first, second], second.path)
    with pytest.raises(DataSetError, match="expected at least two data sets"):
        merge([first], first.path.with_name("other.zarr"))


def test_unfinished_sets_are_refused(first: DataSet, second: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(first.path, path)
    drop_block(path, 0)
    with pytest.raises(DataSetError, match=r"block 0 of .* was never finished"):
        merge([DataSet(path), second], tmp_path / "both.zarr")
