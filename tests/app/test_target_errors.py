"""A twin held against landmarks that it never saw: errors, regions, verdicts, what is not counted, what is refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.target_errors import CaseErrors, describe, evaluation_section, find_evaluations, summary
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import embed
from softtwin.registration.pose import Pose
from softtwin.registration.uncertainty import margins_of

from .conftest import run

CAMERA = Pose.identity().moved(np.array([0.05, -0.03, 0.04, 0.01, 0.02, -0.01]), np.zeros(3))
COUNT = 40


@pytest.fixture(scope="module")
def phantom() -> Path:
    import softtwin.app.twin

    return Path(softtwin.app.twin.__file__).parent / "twins" / "phantom"


@pytest.fixture(scope="module")
def body(phantom: Path) -> Body:
    with Twin.open(phantom) as twin:
        return twin.body


@pytest.fixture(scope="module")
def places(body: Body) -> np.ndarray:
    """Inside the organ at rest, (l, 3), metres."""
    rng = np.random.default_rng(0)
    return body.points[body.cells[rng.choice(len(body.cells), COUNT, replace=False)]].mean(axis=1)


@pytest.fixture(scope="module")
def truths(phantom: Path) -> list[np.ndarray]:
    """Two true states, (n, 3), metres."""
    with np.load(phantom / "truth.npz") as stored:
        sizes = np.linalg.norm(stored["coefficients"], axis=1)
        chosen = stored["coefficients"][np.argsort(sizes)[[-1, len(sizes) // 2]]]
        return [(stored["modes"] @ one).reshape(-1, 3).astype(np.float64) for one in chosen]


@pytest.fixture
def folder(tmp_path: Path, body: Body, places: np.ndarray, truths: list[np.ndarray]) -> Path:
    """Two clouds that a camera has seen, and the landmarks in each frame, in millimetres; at rest in metres."""
    for name in ("clouds", "moved"):
        (tmp_path / name).mkdir()
    carried, header = embed(body, places), "name,x,y,z"
    rows = [f"p{number}," + ",".join(map(str, place)) for number, place in enumerate(places)]
    (tmp_path / "rest.csv").write_text("\n".join([header, *rows]) + "\n")
    for number, truth in enumerate(truths):
        rng = np.random.default_rng(number)
        cloud = partial_view(body, truth, (-0.3, -1.0, 0.25), 1000, 5e-4, rng, "observed")
        np.savetxt(tmp_path / "clouds" / f"frame_{number}.txt", 1e3 * CAMERA.apply(cloud))
        moved = 1e3 * CAMERA.apply(places + carried.displace(truth))
        lines = [f"p{place}," + ",".join(map(str, where)) for place, where in enumerate(moved)]
        (tmp_path / "moved" / f"frame_{number}.csv").write_text("\n".join([header, *reversed(lines)]) + "\n")
    np.savetxt(
        tmp_path / "camera.txt",
        np.vstack([np.hstack([CAMERA.rotation, 1e3 * CAMERA.translation[:, None]]), [0, 0, 0, 1]]),
    )
    return tmp_path


def evaluated(capsys: pytest.CaptureFixture[str], phantom: Path, folder: Path, *words: object, code: int = 0) -> str:
    given = ["evaluate", phantom, "--cloud", folder / "clouds", "--landmarks", folder / "rest.csv", folder / "moved"]
    return run(capsys, *given, "--unit", "mm", "--output", folder / "out", *words, code=code)


def test_landmarks_are_found_within_their_regions(capsys, phantom: Path, folder: Path, places: np.ndarray) -> None:
    """The camera stands where it is said, or is searched for near there; the files' rows are paired by name."""
    for words in (["--start", folder / "camera.txt", "--pose", "fixed"], ["--start", folder / "camera.txt"]):
        said = evaluated(capsys, phantom, folder, *words)
        assert "2 clouds:" in said and "not a medical device" in said
        told = json.loads((folder / "out" / "evaluation.json").read_text())
        figures = told["all"]
        assert figures["landmarks"] == 2 * COUNT and figures["outside"] == figures["without_result"] == 0
        assert figures["error_m"]["mean"] < 0.25 * figures["without_deformation_m"]["mean"]
        assert figures["within"]["0.5"] <= figures["within"]["0.9"] <= figures["within"]["0.95"]
        assert figures["within"]["0.95"] > 0.8 and figures["slope_of_error_by_movement"] < 0.5
        levels, shares = np.transpose(figures["curve"])
        assert (np.diff(levels) > 0).all() and (np.diff(shares) >= 0).all()
        assert sum(told["verdicts"].values()) == 2
    with (folder / "out" / "landmarks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * COUNT
    errors = np.array([float(row["error_m"]) for row in rows])
    assert errors.mean() == pytest.approx(figures["error_m"]["mean"])
    worst = max(rows, key=lambda row: float(row["error_m"]))
    assert (worst["cloud"], worst["landmark"]) == (figures["worst"]["cloud"], figures["worst"]["name"])
    inside = np.mean([float(row["error_m"]) <= float(row["margin90_m"]) for row in rows])
    assert inside == pytest.approx(figures["within"]["0.9"])
    assert find_evaluations(folder) == [folder / "out"]
    shown = evaluation_section(folder / "out")
    assert shown["chart"] is not None and shown["lines"] == describe(told).splitlines()
    (folder / "out" / "evaluation.json").write_text("{}")
    with pytest.raises(ValueError, match=r"out/evaluation\.json: damaged"):
        evaluation_section(folder / "out")


def test_rows_without_names_are_paired_in_order(capsys, phantom: Path, folder: Path, body, places, truths) -> None:
    """One cloud and one file; a landmark beside the organ is not counted, and said."""
    beside = np.vstack([places, body.points.max(axis=0) + 0.05])
    np.savetxt(folder / "rest.txt", beside)
    moved = np.vstack([places + embed(body, places).displace(truths[0]), beside[-1]])
    np.savetxt(folder / "moved.txt", 1e3 * CAMERA.apply(moved))
    said = run(
        capsys, "evaluate", phantom, "--cloud", folder / "clouds" / "frame_0.txt", "--landmarks", folder / "rest.txt",
        folder / "moved.txt", "--unit", "mm", "--start", folder / "camera.txt", "--output", folder / "out",
    )  # fmt: skip
    assert "1 landmarks outside the organ at rest are not counted" in said
    (case,) = json.loads((folder / "out" / "evaluation.json").read_text())["cases"]
    assert case["landmarks_counted"] == COUNT and case["outside"] == 1
    assert case["landmarks"][-1]["is_outside"] and case["landmarks"][0]["name"] == "1"
    assert all("margins_m" in row for row in case["landmarks"][:-1])  # one outside takes no other's region away
    words = [
        "evaluate",
        phantom,
        "--cloud",
        folder / "clouds" / "frame_0.txt",
        "--unit",
        "mm",
        "--output",
        folder / "o",
    ]
    np.savetxt(folder / "short.txt", 1e3 * CAMERA.apply(moved[:-3]))
    said = run(capsys, *words, "--landmarks", folder / "rest.txt", folder / "short.txt", code=2)
    assert f"expected as many rows as there are places in the organ at rest, {COUNT + 1}, got {COUNT - 2}" in said
    moved[3] = np.nan
    np.savetxt(folder / "nan.txt", moved)
    said = run(capsys, *words, "--landmarks", folder / "rest.txt", folder / "nan.txt", code=2)
    assert "got 1 of 41 rows without a place" in said


def test_landmarks_that_were_moved_are_seen_to_be_off(capsys, phantom: Path, folder: Path) -> None:
    """Two centimetres: hardly any region holds; with as much localisation error, most do."""
    for file in (folder / "moved").iterdir():
        head, *rows = file.read_text().splitlines()
        parts = [row.split(",") for row in rows]
        file.write_text(
            "\n".join([head, *(",".join([*part[:-1], str(float(part[-1]) + 20.0)]) for part in parts)]) + "\n"
        )
    words = ["--start", folder / "camera.txt", "--pose", "fixed"]
    evaluated(capsys, phantom, folder, *words)
    off = json.loads((folder / "out" / "evaluation.json").read_text())["all"]
    evaluated(capsys, phantom, folder, *words, "--localisation-error", 0.02)
    wide = json.loads((folder / "out" / "evaluation.json").read_text())["all"]
    assert off["error_m"]["mean"] == wide["error_m"]["mean"] > 0.015
    assert off["within"]["0.95"] < 0.1 and wide["within"]["0.95"] > 0.9
    assert wide["expected_error_m"] > np.sqrt(3.0) * 0.02


def test_a_cloud_that_is_refused_counts_as_without_result(capsys, phantom: Path, folder: Path) -> None:
    np.savetxt(folder / "clouds" / "frame_1.txt", np.full((40, 3), 9e3))
    said = evaluated(capsys, phantom, folder, "--start", folder / "camera.txt")
    told = json.loads((folder / "out" / "evaluation.json").read_text())
    assert f"{COUNT} landmarks have no result" in said
    assert told["verdicts"]["refused"] == 1 and told["all"]["without_result"] == COUNT
    refused = next(case for case in told["cases"] if case["verdict"] == "refused")
    assert "error_m" not in refused and refused["reasons"]


def test_what_cannot_be_compared_is_said(capsys, phantom: Path, folder: Path) -> None:
    said = run(capsys, "evaluate", phantom, "--landmarks", folder / "rest.csv", folder / "moved", code=2)
    assert "--cloud" in said
    (folder / "moved" / "frame_1.csv").unlink()
    assert "without landmarks, left out: frame_1.txt" in evaluated(
        capsys, phantom, folder, "--start", folder / "camera.txt"
    )
    text = (folder / "rest.csv").read_text()
    (folder / "rest.csv").write_text(text.replace("p", "q"))
    assert "expected landmarks that the body has" in evaluated(capsys, phantom, folder, code=2)
    rows = [row.split(",") for row in text.splitlines()[1:]]
    far = [",".join([row[0], *(str(1e3 + float(x)) for x in row[1:])]) for row in rows]
    (folder / "rest.csv").write_text("name,x,y,z\n" + "\n".join(far) + "\n")
    said = evaluated(capsys, phantom, folder, "--start", folder / "camera.txt", code=2)
    assert "expected places inside the organ at rest, got 40 outside of it" in said and "unit, axes and frame" in said


def test_landmarks_that_a_frame_does_not_show_are_named(capsys, phantom: Path, folder: Path) -> None:
    shown = (folder / "moved" / "frame_1.csv").read_text().splitlines()
    (folder / "moved" / "frame_1.csv").write_text("\n".join(shown[:-8]) + "\n")  # the file has the last ones first
    said = evaluated(capsys, phantom, folder, "--start", folder / "camera.txt", "--pose", "fixed")
    assert "landmarks that frame_1.txt does not show, left out: p0, p1, p2, p3, p4 and 3 more" in said
    told = json.loads((folder / "out" / "evaluation.json").read_text())
    assert told["all"]["landmarks"] == 2 * COUNT - 8
    moved = folder / "moved" / "frame_0.csv"
    words = ["--cloud", folder / "clouds", "--landmarks", folder / "rest.csv", moved, "--unit", "mm"]
    said = run(capsys, "evaluate", phantom, *words, code=2)
    assert "error: --landmarks: expected a folder with a file for each cloud" in said


def test_figures_are_those_of_known_errors() -> None:
    """Errors drawn from their covariances lie in regions as often as these say; half as large ones more often."""
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((4000, 3, 3)) * 1e-3
    covariances = roots @ roots.transpose(0, 2, 1)
    drawn = np.einsum("pij,pj->pi", roots, rng.standard_normal((4000, 3)))
    names, none = tuple(map(str, range(4000))), np.zeros(4000, dtype=bool)
    moved = np.full(4000, 0.01)
    for factor, wanted in ((1.0, (0.5, 0.9, 0.95)), (0.5, (0.9, 0.99, 1.0))):
        errors = factor * np.linalg.norm(drawn, axis=1)
        case = CaseErrors("a", "accepted", (), names, moved, errors, covariances, none)
        told = summary([case])
        for level, share in zip(("0.5", "0.9", "0.95"), wanted, strict=True):
            assert told["all"]["within"][level] == pytest.approx(share, abs=0.04)
        assert told["all"]["expected_error_m"] == pytest.approx(
            np.sqrt(np.mean(np.linalg.norm(drawn, axis=1) ** 2)), rel=0.05
        )
    assert margins_of(covariances[:1], 0.9)[0] > margins_of(covariances[:1], 0.5)[0]
