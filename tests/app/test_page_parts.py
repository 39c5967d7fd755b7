"""The parts of the live page that need no browser: simulated camera, colours, figures, glide, picked words."""

import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is absent")

from softtwin.app.config import Config, ConfigError, read_config, to_toml
from softtwin.app.organ import make_body
from softtwin.app.page.bands import COLOURS, SCALES, UNINFORMED, banded
from softtwin.app.page.brush import Brush
from softtwin.app.page.camera import POINTS, TrueStates, View, pose_of, shot
from softtwin.app.page.controls import engines_here
from softtwin.app.page.figures import Figures, figures_html, legend_html
from softtwin.app.page.pick import ball_words, hit, run_pick, subject_of, write_fixed
from softtwin.app.page.recording import Recording
from softtwin.app.page.scene import PER_METRE, Picture
from softtwin.app.page.server import serving
from softtwin.app.page.values import near_cloud
from softtwin.meshes.attachment import Ball, parse_region
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.embedding import is_carried_along, outer, target_points
from softtwin.meshes.export import Coordinates
from softtwin.meshes.shapes import beam, liver_phantom
from softtwin.registration.verdict import Verdict


@pytest.fixture(scope="module")
def body() -> Body:
    return liver_phantom(0.02)


@pytest.fixture
def states(body: Body, rng: np.random.Generator) -> TrueStates:
    modes = 1e-3 * rng.standard_normal((body.points.size, 2))
    return TrueStates(modes, rng.standard_normal((8, 2)), rng.standard_normal((8, 3)))


def test_true_states_go_through_their_equilibria_and_close(rng: np.random.Generator) -> None:
    modes, coefficients, net = rng.standard_normal((12, 2)), rng.standard_normal((6, 2)), rng.standard_normal((6, 3))
    states = TrueStates(modes, coefficients, net)
    for number in range(6):
        moved, force = states.at(2 * np.pi * number / 6)
        assert np.allclose(moved.ravel(), modes @ coefficients[number])
        assert np.allclose(force, net[number])
    assert np.allclose(states.at(0.0)[0], states.at(2 * np.pi)[0])
    step = 1e-6  # the spline is smooth where it closes
    assert np.allclose(states.at(step)[0] - states.at(0.0)[0], states.at(0.0)[0] - states.at(-step)[0], atol=1e-9)


def test_the_camera_has_the_noise_the_share_and_the_pose_that_are_asked(body: Body, states: TrueStates) -> None:
    def seen(view: View) -> Any:
        return shot(body, states, 1.0, view, np.random.default_rng(3))

    plain, noisy, part = seen(View(0.0)), seen(View(2e-3)), seen(View(0.0, share=0.3))
    added = noisy.cloud - plain.cloud  # the same chance chooses the same places
    assert added.std() == pytest.approx(2e-3, rel=4 / np.sqrt(2 * added.size))  # four deviations of such an estimate
    assert len(plain.cloud) == POINTS and len(part.cloud) == round(0.3 * POINTS)
    view = View(0.0, rotation=0.1, translation=5e-3)
    misaligned = seen(view)
    assert view.is_misaligned and not View().is_misaligned
    assert np.allclose(pose_of(view, body).inverse().apply(misaligned.cloud), plain.cloud, atol=1e-12)
    assert pose_of(view, body).angle_to(pose_of(View(), body)) == pytest.approx(0.1)


def test_states_that_are_not_there_are_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"demo: expected true states in .*truth\.npz"):
        TrueStates.read(tmp_path)


def test_every_triangle_is_in_one_band_and_in_the_right_one() -> None:
    triangles = np.arange(15).reshape(5, 3)
    values = np.repeat([np.nan, 0.5e-3, 1.5e-3, 3e-3, 9e-3], 3)
    found = banded(triangles, values, SCALES["error"])
    assert len(found) == 1 + len(COLOURS)
    for number, part in enumerate(found):
        assert np.array_equal(part, triangles[number : number + 1])
    assert [len(part) for part in banded(triangles, None, SCALES["error"])] == [5, 0, 0, 0, 0]


def test_a_cloud_beside_the_surface_is_told_as_far_as_it_is(body: Body) -> None:
    surface = outer(body).rest
    corner = surface.points[surface.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    cloud = (corner.mean(axis=1) + 1e-3 * normal / np.linalg.norm(normal, axis=1, keepdims=True))[:200]
    found = near_cloud(body, np.zeros_like(body.points), cloud)
    told = found[np.isfinite(found)]
    assert len(told) and told.max() <= 1e-3 + 1e-9  # another triangle may be nearer, none is farther
    assert np.median(told) == pytest.approx(1e-3, rel=1e-6)
    assert np.isnan(found).any()


def test_figures_have_their_units_and_what_is_unknown_is_said_to_be() -> None:
    text = figures_html(
        Figures("registration", Verdict.DOUBTFUL, "a <reason>", {"tumour": 1.24e-3, "vein": np.inf}, {"tumour": 4e-4},
                net_force=0.5, net_force_deviation=0.1, frame_time=0.04, age=0.06, dropped=3)
    )  # fmt: skip
    for words in ("doubtful", "a &lt;reason&gt;", "1.2 mm", "0.4 mm", "unknown", "0.50 ± 0.10 N", "40 ms", "60 ms"):
        assert words in text
    assert "nan" not in text and "inf" not in text and "camera" not in text
    elsewhere = figures_html(Figures("registration", Verdict.ACCEPTED, pose_correction=(3.21e-3, np.deg2rad(1.24))))
    assert "camera elsewhere by" in elsewhere and "3.2 mm, 1.2°" in elsewhere
    assert "above 4 mm" in legend_html(SCALES["error"], has_uninformed=False)
    partly = Figures("registration", Verdict.ACCEPTED, "", {"vein": 1e-3, "tumour": 1e-3},
                     outside={"vein": 0.3, "tumour": 0.0})  # fmt: skip
    assert figures_html(partly).count("30 % of it outside the organ: not known") == 1
    assert figures_html(partly).count("outside the organ") == 1


def test_the_brush_reaches_the_answer_in_steps_and_rests() -> None:
    drawn = list[Any]()
    brush = Brush(lambda moved: drawn.append(moved.max()), np.zeros((4, 3)))
    try:
        brush.glide(np.full((4, 3), 0.5e-2))
        time.sleep(0.3)
        brush.glide(np.full((4, 3), 1e-2))
        deadline = time.monotonic() + 60.0
        while brush.shown.max() < 1e-2 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert drawn == sorted(drawn) and len(drawn) > 3 and drawn[-1] == 1e-2
        count = len(drawn)
        time.sleep(0.2)
        assert len(drawn) == count  # at rest
        brush.jump(np.full((4, 3), 2e-2))
        assert drawn[-1] == brush.shown.max() == 2e-2
    finally:
        brush.close()


def test_the_picture_moves_vertices_in_place_and_gives_places_back(body: Body) -> None:
    with serving() as server:
        picture = Picture(server, body)
        band = picture._bands[0]
        picture.move(np.full_like(body.points, 1e-2))
        rest = outer(body).rest.points[outer(body).vertices]
        assert np.allclose(band.vertices / PER_METRE + picture.centre, rest + 1e-2, atol=1e-6)  # single precision
        place = np.array([0.01, 0.02, 0.03])
        assert np.allclose(picture.place_of(tuple(picture.placed(place))), place, atol=1e-7)
        picture.name_margins({"tumour": 2.345e-3, "vessel_portal": np.inf})
        assert picture._labels["tumour"].text == "tumour ± 2.3 mm"
        assert picture._labels["vessel_portal"].text == "vessel portal"


def test_what_lies_outside_the_organ_is_drawn_as_not_known(body: Body) -> None:
    vein = body.inner["vessel_portal"]
    away = vein.points + np.array([0.0, 0.0, 0.3 * np.ptp(body.points[:, 2])])
    body = body.with_inner(vein=Surface(away, vein.triangles))
    outside = is_carried_along(body, target_points(body)["vein"])
    assert 0.0 < outside.mean() < 1.0
    with serving() as server:
        picture = Picture(server, body)
        known, unknown = picture._inner["vein"]
        assert not outside[known.faces].any() and outside[unknown.faces].any(axis=1).all()
        assert len(known.faces) + len(unknown.faces) == len(vein.triangles)
        assert known.color != unknown.color and unknown.color == UNINFORMED
        assert len(picture._inner["tumour"]) == 1
        picture.move(np.full_like(body.points, 1e-2))
        assert np.array_equal(known.vertices, unknown.vertices)
        picture.name_margins({"vein": 1e-3, "tumour": 1e-3})
        assert picture._labels["vein"].text == "vein ± 1.0 mm inside the organ"
        assert picture._labels["tumour"].text == "tumour ± 1.0 mm"


def test_a_recording_is_one_page_with_the_scene_in_it(body: Body) -> None:
    done, pages = threading.Event(), list[str]()
    with serving() as server:
        picture = Picture(server, body)
        recording = Recording(server, 0.3, lambda page: (pages.append(page), done.set()))  # type: ignore[arg-type,func-returns-value]
        recording.mark()
        picture.move(np.full_like(body.points, 1e-2))
        assert done.wait(60)
        picture.move(np.zeros_like(body.points))  # goes on after the end
        recording.mark()
    assert pages[0].lstrip().lower().startswith("<!doctype html") and "__VISER_EMBED_DATA__" in pages[0]


def test_without_fenicsx_the_reference_is_not_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softtwin.app.page.controls.find_spec", lambda _: None)
    assert engines_here() == ("surrogate", "torch")
    monkeypatch.setattr("softtwin.app.page.controls.find_spec", lambda _: SimpleNamespace())
    assert engines_here() == ("surrogate", "hybrid", "reference", "torch")
    assert engines_here(has_network=False) == ("reference", "torch")


@pytest.mark.parametrize("place", [Coordinates("mm", "ras"), Coordinates("m", "lps"), Coordinates("cm", "lps")])
def test_picked_words_mean_the_ball_that_was_picked(place: Coordinates) -> None:
    centre, radius = np.array([0.0123, -0.0456, 0.1011]), 0.015
    found = parse_region(ball_words(centre, radius, place), place.unit)
    assert isinstance(found, Ball)
    assert np.allclose(place.directions(found.centre), centre, atol=6e-5)  # half of the last digit
    assert found.radius == pytest.approx(radius, abs=6e-5)


def test_picked_words_make_the_attachment_of_a_configuration(tmp_path: Path) -> None:
    file = tmp_path / "organ.toml"
    file.write_text(to_toml(Config.model_validate({"body": {"source": "beam", "unit": "mm"}})))
    subject = subject_of(read_config(file)[0].body, tmp_path, file)
    place = hit(subject.surface, np.array([2.0, 0.125, 0.125]), np.array([-1.0, 0.0, 0.0]))
    assert place is not None and place[0] == pytest.approx(1.0)  # the beam's end
    before = file.read_text()
    write_fixed(file, ball_words(place, 0.2, subject.coordinates))
    assert [line for line in before.splitlines() if not line.startswith("fixed = ")] == [
        line for line in file.read_text().splitlines() if not line.startswith("fixed = ")
    ]
    known, root = read_config(file)
    fixed = make_body(known.body, root).points[make_body(known.body, root).fixed]
    assert len(fixed) and np.linalg.norm(fixed - place, axis=1).max() <= 0.2 + 1e-4


def test_a_ray_beside_the_organ_hits_nothing() -> None:
    rest = beam().boundary_surface
    assert hit(rest, np.array([2.0, 5.0, 0.0]), np.array([-1.0, 0.0, 0.0])) is None
    assert isinstance(rest, Surface)


def test_pick_wants_an_organ(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"pick: expected a surface or a mesh"):
        run_pick(Config().body.model_copy(update={"source": ""}), tmp_path, None)
