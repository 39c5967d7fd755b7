"""The report: whole on a full workspace, honest on an empty one, and silent about the machine."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softtwin.app import pictures, report, sequences
from softtwin.app.config import Config
from softtwin.app.export import Exporter
from softtwin.app.pictures import Studio, camera_side, inner_colours, view_of
from softtwin.app.record import Recorder
from softtwin.app.report import figure, public_config, report_stage, without_paths
from softtwin.app.sequences import find_registrations
from softtwin.app.twin import Frame, Twin
from softtwin.app.workspace import Workspace
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import write_body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import LinearResponse
from softtwin.reference.data.writing import create, write_block
from softtwin.registration.hyperparameters import Hyperparameters
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.block import Estimate
from softtwin.registration.pose import Pose
from softtwin.registration.result import Moved, Registration
from softtwin.registration.uncertainty import Uncertainty
from softtwin.registration.verdict import Check, Code, Judgement, Verdict

SPLITS = {"train": 4, "validation": 2, "test": 2}
COMMANDS = {
    "organ": "softtwin mesh",
    "modes": "softtwin generate",
    "data": "softtwin generate",
    "surrogate": "softtwin train",
    "registration": "softtwin quickstart",
    "sequences": "softtwin register",
}


class Page(HTMLParser):
    """What a browser would see: elements with their attributes, and the text outside of style."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._in_style = False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._in_style = tag == "style"

    def handle_data(self, data: str) -> None:
        self.text += "" if self._in_style else data

    def handle_endtag(self, tag: str) -> None:
        self._in_style = False

    def pictures(self) -> list[str]:
        return [attributes["alt"] or "" for tag, attributes in self.elements if tag == "img"]


def box(centre: tuple[float, float, float], half: float) -> Surface:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    return Surface(np.array(centre) + half * corners, np.array(faces))


@pytest.fixture(scope="module")
def body() -> Body:
    plain = beam((6, 2, 2), (0.6, 0.2, 0.2), "tetrahedron")
    front = plain.boundary[(plain.points[plain.boundary][:, :, 1] == 0).all(axis=1)]
    inner = {"tumour": box((0.4, 0.1, 0.1), 0.03), "<b>vessel</b>": box((0.2, 0.1, 0.1), 0.02)}
    return replace(plain, surfaces={"observed": front}, inner=inner)


def bends(body: Body, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Smooth displacements that grow from the fixed side, the first the smallest, (count, n, 3)."""
    shape = body.points[:, :1] ** 2 * np.array([[0.0, 0.1, 0.3]])
    return np.linspace(0.3, 1.0, count)[:, None, None] * shape


def make_data(path: Path, body: Body, blocks: int = 4) -> None:
    loaded = np.setdiff1d(body.boundary_nodes, body.fixed)[:5]
    response = LinearResponse(loaded, np.zeros((3 * len(body.points), 15)), np.eye(15))
    header = {"block": 2, "samples": SPLITS, "versions": {"dolfinx": "0.5.2"}}
    create(path, header, body, response, bends(body, 3), np.array([0.1, 0.2, 0.3]))
    for block in range(blocks):
        arrays: dict[str, Any] = {name: np.zeros(2) for name in ("energy", "residual")}
        arrays |= {name: np.full(2, 4, dtype=np.int32) for name in ("iterations", "load_steps", "negative_pivots")}
        arrays |= {"forces": np.zeros((2, 5, 3)), "adjoints": np.zeros((2, 5, 3)), "probes": np.zeros((2, 3))}
        arrays |= {"displacements": bends(body, 2), "reason": np.array([0, 1 if block == 0 else 0], dtype=np.uint8)}
        write_block(path, block, arrays)


def make_validation(folder: Path, body: Body) -> None:
    true = bends(body, 3)
    predicted = true * np.array([1.01, 1.02, 1.05])[:, None, None]
    errors, sizes = np.linalg.norm(predicted - true, axis=2).mean(axis=1), np.linalg.norm(true, axis=2).max(axis=1)
    np.savez(
        folder / "validation.npz",
        displacements_true=true,
        displacements_predicted=predicted,
        errors_mean_m=errors,
        sizes_m=sizes,
    )
    (folder / "validation.json").write_text(
        json.dumps({"table": f"mean error 1 mm, from {folder.resolve()}/data.zarr"})
    )


def make_demo(folder: Path, body: Body) -> None:
    folder.mkdir()
    truth = bends(body, 1)[0]
    seen = np.unique(body.surfaces["observed"])
    np.save(folder / "truth.npy", truth)
    np.save(folder / "cloud.npy", (body.points + truth)[seen])
    forces = np.zeros_like(body.points)
    forces[-1] = (0.0, 0.3, 0.4)
    for name, part in (("surrogate", 0.9), ("reference", 0.99)):
        np.savez(folder / f"{name}.npz", displacement=part * truth, forces=part * forces, true_forces=forces)
        row: dict[str, Any] = {"net_force_deviation_N": [0.0, 0.03, 0.04], "seconds": 0.25, "iterations": 7}
        row |= {"outcome": "most_iterations", "verdict": "doubtful", "reasons": [f"the {name} gave up"]}
        (folder / name).mkdir()
        (folder / name / "registration.json").write_text(json.dumps({"frames": [row]}))


class Still:
    """A model without mechanics: what registered frames look like is another test's matter."""

    def __init__(self, body: Body) -> None:
        self.body = body


def make_registration(folder: Path, body: Body, frames: int = 4, entries: dict[str, Any] | None = None) -> None:
    """Frames as `softtwin register` writes them: all good but the second, which is refused, and a cloud without use."""
    twin = Twin(Still(body), Config.model_validate(entries or {"body": {"unit": "mm"}}))  # type: ignore[arg-type]
    shapes = bends(body, frames)
    bounds = iter([(2e-4, ()), (3e-4, ()), (4e-4, ("it lies 3 times as far out",)), (5e-4, ())])

    def bounded(found: Registration) -> SimpleNamespace:
        mean, reasons = next(bounds)
        return SimpleNamespace(mean=mean, largest=9e-4, confidence=0.9, is_inside=not reasons, reasons=reasons)

    twin.bounded = bounded  # type: ignore[method-assign, assignment]
    with Recorder(Exporter(twin, folder)) as recorder:
        for number, shape in enumerate(shapes):
            refused = number == 1
            verdict = Judgement.of((some_check(refused),))
            state = SimpleNamespace(displacement=shape)
            forces, net, covariance = np.full_like(shape, 0.01), np.array([0.0, 0.3, 0.4]), 1e-4 * np.eye(3)
            still, shift = Pose.identity(), np.zeros_like(shape)
            moved = Moved(state, shift, still, still, forces, net, covariance)  # type: ignore[arg-type]
            scales = Hyperparameters(5e-3 if refused else 5e-4, 0.01, 1e-6, 0.1, 1.0)
            solved = SimpleNamespace(
                local=SimpleNamespace(problem=SimpleNamespace(shared=None, pose=None, cloud=np.zeros((100, 3)))),
                posterior=SimpleNamespace(scales=scales, informed=3.0),
                rms_distance=float("nan") if refused else 5e-4,
                is_kept=np.ones(100, dtype=bool),
                outcome=Outcome.CONVERGED,
                evaluations=5,
                trace=(),
            )
            result = Registration(moved, solved, verdict, None, 0.1)  # type: ignore[arg-type]
            vars(result).update(
                uncertainty=Uncertainty(1e-3 * np.ones((shape.size, 1)), np.zeros(len(shape))),
                estimates=(Estimate("Young's modulus", "Pa", 4000.0, (3900.0, 12345.0), 0.3, 0.2),),
                force_over_modulus=None,
            )
            recorder.add(Frame(number, verdict, result, 0.1, body.points + shape), f"cloud_{number}.ply")
        recorder.add(Frame(frames, Judgement(Verdict.REFUSED, ("an empty cloud.",)), None, 0.0), "empty.ply")


def some_check(refused: bool) -> Check:
    worst, reason = (Verdict.REFUSED, "too <far>") if refused else (Verdict.ACCEPTED, "")
    return Check(
        Code.MISFIT, worst, 5e-3 if refused else 5e-4, 2e-3, "m", law="log-normal", p_value=0.25, reason=reason
    )


def workspace(root: Path, **entries: Any) -> Workspace:
    return Workspace(Config.model_validate({"folder": "run", **entries}), root)


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory, body: Body) -> Workspace:
    root = tmp_path_factory.mktemp("full")
    space = workspace(
        root,
        body={
            "source": str(root / "scans" / "<i>liver & co.stl"),
            "fixed": "veins.ply",
            "inner": {"tumour": str(root / "t.stl")},
        },
    )
    space.folder.mkdir()
    write_body(space.body, body)
    make_data(space.data, body)
    make_validation(space.folder, body)
    make_demo(space.folder / "demo", body)
    make_registration(space.folder / "registrations" / "morning", body)
    (space.folder / "stages.json").write_text(json.dumps({"mesh": {"seconds": 5.0}, "generate": {"seconds": 45.0}}))
    return space


@pytest.fixture(scope="module")
def page(full: Workspace) -> Page:
    if problem := report.rendering_problem():
        pytest.skip(problem)
    return Page(report_stage(full))


@pytest.fixture
def no_rendering(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "rendering_problem", lambda: "no driver here")


def test_full_report_has_a_picture_of_everything(page: Page, full: Workspace) -> None:
    words = page.pictures()
    organ, modes, samples, charts, registration, sequences = 3, 3, 6, 2, 6, 4
    assert len(words) == organ + modes + samples + charts + registration + sequences
    assert all(words)
    assert "There is no" not in page.text
    assert (full.folder / "report.html").stat().st_size < 6e6


def test_pictures_are_not_empty(body: Body) -> None:
    if problem := report.rendering_problem():
        pytest.skip(problem)
    view = view_of(camera_side(body), [body.points])
    image = pictures._render(view, report.organ_layers(body), 200)
    assert image.shape[1:] == (200, 4)
    covered = (image[:, :, 3] > 0).mean()
    assert 0.2 < covered < 0.95  # the body is in the middle of a transparent ground


def test_figures_are_those_of_the_files(page: Page) -> None:
    text = " ".join(page.text.split())
    assert "7 equilibria accepted" in text
    assert "1 not converged" in text
    # The surrogate was given 90 % of the truth, the reference 99 %: their forces are off by as much.
    assert "0.050 N (10 %)" in text
    assert "0.005 N (1 %)" in text
    assert "0.450 ± 0.050" in text
    assert "50 s" in text  # all stages together


def test_frames_are_drawn_where_they_lie_whatever_they_were_written_in(tmp_path: Path, body: Body) -> None:
    """Their files are in metres and RAS, of an organ that nobody has said the axes of."""
    written = {"output_frame": "ras", "output_unit": "m"}
    make_registration(tmp_path, body, 2, {"body": {"source": "liver.stl", "unit": "mm"}, "registration": written})
    found = sequences.sequence_section(tmp_path, body, Studio("no pictures"))
    assert found["coordinates"].startswith("Files: m, RAS. Forces: newtons, RAS.")
    assert any("taken as LPS" in note for note in found["notes"])
    place = Coordinates(**json.loads((tmp_path / "registration.json").read_text())["files_in"])
    drawn = sequences._displacement(tmp_path / "frame_0000.vtu", body, place)
    np.testing.assert_allclose(drawn, bends(body, 2)[0], atol=1e-12)


def test_target_errors_before_and_after(full: Workspace, body: Body) -> None:
    section = report.registration_section(full, Studio("no pictures"))
    before, surrogate, reference = (row["targets"]["tumour"] for row in section["rows"])
    assert section["shown"] == ["tumour"]
    assert before > 0
    assert surrogate == pytest.approx(0.1 * before, rel=1e-9)  # it was given 90 % of the truth
    assert reference == pytest.approx(0.01 * before, rel=1e-9)
    assert section["across"]["targets"]["tumour"] == pytest.approx(0.09 * before, rel=1e-9)
    assert section["rows"][0]["distance"] > section["rows"][2]["distance"]


def test_median_and_worst_sample_are_chosen(full: Workspace) -> None:
    rows = report.surrogate_section(full, Studio("no pictures"))["rows"]
    with np.load(full.folder / "validation.npz") as arrays:
        errors = np.sort(arrays["errors_mean_m"])
    assert [row["name"] for row in rows] == ["median", "worst"]
    assert [row["error"] for row in rows] == pytest.approx(errors[1:].tolist())


def test_the_users_own_registrations_are_shown(page: Page) -> None:
    text = " ".join(page.text.split())
    assert "5 frames with the surrogate, forces on all loaded nodes: 3 accepted, 2 refused." in text
    assert "Files: mm, LPS. Forces: newtons, LPS." in text and "Pose: metres, LPS, as the clouds." in text
    assert "Worst frame (1): refused, too <far>." in text
    assert "Frame 1: 1 check" in text and "misfit5 mmat most 2 mm0.25refused" in text
    assert "empty.ply" in text and "an empty cloud." in text
    assert "Young's modulus 4000 Pa (3900 to 12345), not told by the cloud" in text
    assert "0.500 ± 0.017" in text and "90 %: x -0.016 to +0.016" in text
    assert "y +0.284 to +0.316" in text and "z +0.384 to +0.416" in text
    assert "/ E: (+0, +60, +80) mm²" in text  # by the configuration's 5000 Pa
    assert "directions seen" in text and "3.0" in text
    assert [words.split(" frame")[0] for words in page.pictures() if " frame (" in words] == ["first", "worst", "last"]
    assert "surrogate: the surrogate gave up." in text and "most iterations" in text


def test_the_networks_bounds_are_shown_beside_the_frames(page: Page, full: Workspace) -> None:
    text = " ".join(page.text.split())
    assert "network off, mean (mm)" in text and "no bound" in text
    assert "a bound that 90 % of the loads like those of its calibration keep" in text
    rows = json.loads((full.folder / "registrations" / "morning" / "registration.json").read_text())["frames"]
    assert [row["network"]["is_inside"] for row in rows[:4]] == [True, True, False, True]
    assert rows[2]["network"]["reasons"] == ["it lies 3 times as far out"]


def test_registrations_elsewhere_are_named(full: Workspace, tmp_path: Path, body: Body, no_rendering: None) -> None:
    make_registration(tmp_path / "evening", body, frames=1)
    found = find_registrations(full.folder, [tmp_path / "evening", tmp_path / "evening"])
    assert [folder.name for folder in found] == ["morning", "evening"]
    page = Page(report_stage(full, [tmp_path / "evening"]))
    assert "evening" in page.text and "no picture: no driver here" in page.text
    with pytest.raises(ValueError, match=r"--registrations: expected a folder with registration\.json"):
        find_registrations(full.folder, [tmp_path])


def test_a_registration_that_cannot_be_shown_spoils_nothing_else(full: Workspace, tmp_path: Path, body: Body) -> None:
    studio = Studio("no pictures")
    make_registration(tmp_path / "other", beam((3, 2, 2), (0.6, 0.2, 0.2), "tetrahedron"), frames=1)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "registration.json").write_text('{"frames": []}')
    made = report._sequences(full, studio, find_registrations(full.folder, [tmp_path / "other", tmp_path / "old"]))
    assert ["missing" in section for section in made["every"]] == [False, True, True]
    assert "another body" in made["every"][1]["missing"] and "register again" in made["every"][2]["missing"]


def test_a_long_sequence_lists_what_was_not_accepted(body: Body) -> None:
    rows = [{"frame": i, "verdict": "refused" if i in (50, 60) else "accepted"} for i in range(100)]
    listed = [row["frame"] for row in sequences._listed(rows)]
    assert len(listed) == sequences._LISTED and {0, 50, 60, 99} <= set(listed) and listed == sorted(listed)


def test_file_needs_nothing_else(page: Page) -> None:
    for tag, attributes in page.elements:
        assert tag not in ("script", "link", "iframe", "object")
        for name in ("src", "srcset", "href"):
            address = attributes.get(name)
            assert address is None or address.startswith(("data:image/png;base64,", "#"))


def test_names_are_escaped(page: Page, full: Workspace) -> None:
    assert "<i>liver & co" in page.text
    assert "<b>vessel</b>" in page.text
    raw = (full.folder / "report.html").read_text(encoding="utf-8")
    assert "<i>liver" not in raw
    assert "<b>vessel" not in raw


def test_no_folder_of_the_machine_is_told(page: Page, full: Workspace) -> None:
    assert "mean error 1 mm, from data.zarr" in page.text
    assert 't.stl"' in page.text
    for folder in (full.root, full.folder, Path.home(), Path(report.__file__).parent):
        assert f"{folder}/" not in page.text
        assert f"{folder.resolve()}/" not in page.text


def test_empty_workspace_names_every_command(tmp_path: Path, no_rendering: None) -> None:
    page = Page(report_stage(workspace(tmp_path)))
    assert "Nothing has been made here yet." in page.text
    for command in COMMANDS.values():
        assert command in page.text
    assert page.pictures() == []
    assert "Research software: not a medical device" in page.text


def test_each_section_names_its_command(tmp_path: Path) -> None:
    space = workspace(tmp_path)
    for name, command in COMMANDS.items():
        if name == "sequences":
            continue  # made from folders, not from the workspace
        section = report._guarded(report._SECTIONS[name], space, Studio("no pictures"))
        if name in ("surrogate", "registration"):
            assert set(section) == {"missing"}
        assert command in section["missing"]


def test_unfinished_data_set_says_how_far_it_is(tmp_path: Path, body: Body) -> None:
    space = workspace(tmp_path)
    make_data(space.data, body, blocks=3)
    studio = Studio("no pictures")
    assert "3 of 4 blocks" in report._guarded(report.data_section, space, studio)["missing"]
    assert report.modes_section(space, studio)["count"] == 3


def test_without_rendering_the_report_says_so(full: Workspace, no_rendering: None) -> None:
    page = Page(report_stage(full))
    assert len(page.pictures()) == 3  # the charts do not need it
    assert "no picture: no driver here" in page.text
    assert "7 equilibria accepted" in page.text


@pytest.mark.parametrize(
    ("file", "section"),
    [
        ("body.vtu", "organ"),
        ("validation.npz", "surrogate"),
        ("validation.json", "surrogate"),
        ("demo/cloud.npy", "registration"),
    ],
)
def test_damaged_file_spoils_its_section_only(
    full: Workspace, tmp_path: Path, body: Body, file: str, section: str, capfd: pytest.CaptureFixture[str]
) -> None:
    space = workspace(tmp_path)
    space.folder.mkdir()
    write_body(space.body, body)
    make_validation(space.folder, body)
    make_demo(space.folder / "demo", body)
    studio = Studio("no pictures")
    assert "missing" not in report._guarded(report._SECTIONS[section], space, studio)
    path = space.folder / file
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    found = report._guarded(report._SECTIONS[section], space, studio)
    assert found["missing"]
    assert str(tmp_path) not in found["missing"]


def test_arrays_of_another_body_are_refused(tmp_path: Path, body: Body) -> None:
    space = workspace(tmp_path)
    space.folder.mkdir()
    write_body(space.body, beam((3, 2, 2), (0.6, 0.2, 0.2), "tetrahedron"))
    make_validation(space.folder, body)
    message = report._guarded(report.surrogate_section, space, Studio("no pictures"))["missing"]
    assert "displacements_true" in message
    assert f"{len(body.points)}, 3" in message


def test_view_holds_all_points_and_keeps_lengths(body: Body, rng: np.random.Generator) -> None:
    towards = np.array([0.3, -1.0, 0.4])
    view = view_of(towards, [body.points])
    flat = (body.points - view.centre) @ np.column_stack([view.right, view.up])
    assert (np.abs(flat) < view.half).all()
    axes = np.stack([view.right, view.up, view.towards])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-14)  # a few roundings of unit vectors
    assert np.linalg.det(axes) > 0  # not mirrored


def test_camera_looks_at_the_observed_side(body: Body) -> None:
    assert camera_side(body)[1] < 0  # the observed side is at y = 0, facing -y
    assert np.isfinite(camera_side(beam((3, 2, 2), (0.6, 0.2, 0.2)))).all()


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.0, "0"), (0.0123456, "0.0123"), (17.25, "17.2"), (1430.2, "1,430"), (2e-7, "2.00e-07"), (float("nan"), "nan")],
)
def test_figures_are_readable(value: float, words: str) -> None:
    assert figure(value) == words


def test_tumours_stand_out() -> None:
    colours = inner_colours(["vessel_a", "Tumor_1", "vessel_b", "tumour"])
    assert colours["Tumor_1"] == colours["tumour"]
    assert len({colours["vessel_a"], colours["vessel_b"], colours["tumour"]}) == 3


def test_paths_are_cut_and_the_rest_is_kept(tmp_path: Path) -> None:
    space = workspace(tmp_path)
    told = (
        f"block 3 in {space.folder.resolve()}/data.zarr, /opt/some/where.py; 3 N/m, mean / max, https://zenodo.org/a/b"
    )
    assert without_paths(told, space) == "block 3 in data.zarr, where.py; 3 N/m, mean / max, https://zenodo.org/a/b"


def test_public_config_keeps_what_is_relative() -> None:
    config = Config.model_validate(
        {
            "folder": "here",
            "body": {"source": "/data/a/liver.stl", "zones": {"s": "/data/s.npy"}, "fixed": "in/veins.ply"},
        }
    )
    public = public_config(config)
    assert (public.folder, public.body.source, public.body.zones) == ("here", "liver.stl", {"s": "s.npy"})
    assert public.body.fixed == "in/veins.ply"
    assert public.loads == config.loads


def test_template_stands_beside_the_module() -> None:
    template = Path(report.__file__).with_name("report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://", template)
