"""A page at work without a browser: clouds of folders and iterators, bad ones, another engine, a misaligned camera."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.address import Address
from softtwin.app.config import ConfigError
from softtwin.app.page import server as page_server
from softtwin.app.page.camera import Shot, TrueStates, View, shot
from softtwin.app.page.controls import Controls
from softtwin.app.page.demo import PHANTOM, run_demo
from softtwin.app.page.figures import Figures
from softtwin.app.page.session import Session
from softtwin.app.page.stream import clouds_of, run_live, show
from softtwin.app.register import Scene
from softtwin.app.twin import Frame, Twin, find_twin
from softtwin.registration.verdict import Verdict

from .conftest import run


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[Figures]:
    """All figures that pages have shown."""
    figures = list[Figures]()
    plain = Controls.show

    def tell(self: Controls, found: Figures) -> None:
        figures.append(found)
        plain(self, found)

    monkeypatch.setattr(Controls, "show", tell)
    return figures


def answered(figures: list[Figures]) -> list[Figures]:
    return [found for found in figures if found.verdict is not None]


def shots(count: int, view: View = View()) -> Iterator[Shot]:  # noqa: B008  (it is frozen)
    body, states, rng = find_twin(PHANTOM).body, TrueStates.read(PHANTOM), np.random.default_rng(2)
    for number in range(count):
        yield shot(body, states, 1.0 + 0.1 * number, view, rng)


def slowly(session: Session, source: Any, told: list[Figures]) -> Iterator[Shot]:
    """The next cloud once the one before was answered."""
    import time

    for number, found in enumerate(source):
        yield found
        deadline = time.monotonic() + 240.0
        while len(answered(told)) <= number and time.monotonic() < deadline:
            time.sleep(0.02)


def test_a_folder_is_followed_and_a_cloud_that_is_none_is_refused_with_its_reason(
    tmp_path: Path, told: list[Figures]
) -> None:
    np.save(tmp_path / "cloud_1.npy", np.full((5, 3), np.nan))
    said = list[str]()
    run_live(PHANTOM, tmp_path, {}, idle=1.0, browser=False, say=said.append)
    assert answered(told)[-1].verdict is Verdict.REFUSED
    assert answered(told)[-1].reason
    assert "http://127.0.0.1:" in said[0] and "not a medical device" in said[0]


def test_an_iterator_of_clouds_is_shown_without_a_truth(told: list[Figures]) -> None:
    show(PHANTOM, [next(shots(1)).cloud], browser=False, say=lambda _: None)  # type: ignore[list-item]
    found = answered(told)[-1]
    assert found.verdict is Verdict.ACCEPTED
    assert not found.errors and np.isfinite(found.margins["tumour"])
    assert found.frame_time > 0 and found.age >= found.frame_time


def test_a_camera_that_stands_elsewhere_than_was_said_is_told(told: list[Figures]) -> None:
    cloud = next(shots(1)).cloud
    show(PHANTOM, [cloud], browser=False, say=lambda _: None)  # type: ignore[list-item]
    assert answered(told)[-1].pose_correction is None
    show(PHANTOM, [cloud + np.array([0.0, 0.0, 8e-3])], browser=False, say=lambda _: None)  # type: ignore[list-item]
    pose_correction = answered(told)[-1].pose_correction
    assert pose_correction is not None and 2e-3 < pose_correction[0] < 10e-3


@pytest.mark.parametrize(
    "opened",
    [lambda say: run_demo(browser=False, say=say), lambda say: show(PHANTOM, [], browser=False, say=say)],
    ids=["demo", "live"],
)
def test_ctrl_c_the_moment_the_address_is_said_closes_the_page(opened: Any) -> None:
    said = list[str]()

    def say(line: str) -> None:
        said.append(line)
        if len(said) == 1:
            raise KeyboardInterrupt

    opened(say)
    assert "http://" in said[0] and said[1:] == ["\nthe page is closed."]
    at_work = {thread.name for thread in threading.enumerate()}
    assert not at_work & {"softtwin hand", "softtwin brush"}  # Python would end in the middle of what they do


def test_the_organ_that_is_shown_is_the_one_that_was_registered(told: list[Figures]) -> None:
    home = find_twin(PHANTOM)
    with page_server.serving() as server:
        session = Session(server, home, is_simulated=True)
        session.run(slowly(session, shots(3), told))
        assert session.picture._cloud is not None and session.picture._cloud.visible
        assert sum(len(part) for part in session.picture._drawn) == len(session.picture.triangles)
    found = answered(told)[-1]
    assert found.errors["tumour"] < 2e-3 < np.linalg.norm(TrueStates.read(PHANTOM).at(1.2)[0], axis=1).max()


def test_a_misaligned_camera_is_found(told: list[Figures]) -> None:
    view = View(5e-4, rotation=np.deg2rad(4.0), translation=5e-3)
    with page_server.serving() as server:
        session = Session(server, find_twin(PHANTOM), is_simulated=True)
        session.controls._sliders[2].value, session.controls._sliders[3].value = 4.0, 5.0
        assert session.wishes.view.is_misaligned
        session.run(slowly(session, shots(2, view), told))
    found = answered(told)[-1]
    assert found.verdict is not Verdict.REFUSED
    assert found.errors["tumour"] < 5e-3  # the camera itself stands 5 mm and 4 degrees off


def test_another_engine_goes_on_where_the_first_was(told: list[Figures]) -> None:
    pytest.importorskip("dolfinx", reason="FEniCSx is absent")
    with page_server.serving() as server:
        session = Session(server, find_twin(PHANTOM), is_simulated=True)

        def switched() -> Iterator[Shot]:
            for number, found in enumerate(shots(2)):
                session.controls._engine.value = ("surrogate", "hybrid")[number]
                yield found

        session.run(slowly(session, switched(), told))
    assert [found.engine for found in answered(told)] == ["surrogate", "hybrid"]
    assert all(found.verdict is not Verdict.REFUSED for found in answered(told))


class Noted:
    """A learner that counts what it is asked for."""

    def __init__(self) -> None:
        self.calls = list[str]()

    def renew(self) -> None:
        self.calls.append("renew")

    def tell(self, frame: Frame) -> None:
        self.calls.append(f"tell {frame.judgement.verdict.value}")


def test_a_page_learns_from_each_frame_with_each_engine_that_can(told: list[Figures]) -> None:
    """The learner goes on where only the camera's pose is looked for anew, and ends with its engine."""
    pytest.importorskip("dolfinx", reason="FEniCSx is absent")
    learners, ended = list[Noted](), list[int]()

    @contextmanager
    def learning(twin: Twin) -> Iterator[Noted]:
        learners.append(Noted())
        yield learners[-1]
        ended.append(len(answered(told)))

    with page_server.serving() as server:
        session = Session(server, find_twin(PHANTOM), is_simulated=True, learning=learning)

        def switched() -> Iterator[Shot]:
            for number, found in enumerate(shots(4)):
                session.controls._sliders[2].value = (0.0, 4.0, 4.0, 4.0)[number]
                session.controls._engine.value = ("surrogate", "surrogate", "reference", "hybrid")[number]
                yield found

        session.run(slowly(session, switched(), told))
    assert [found.engine for found in answered(told)] == ["surrogate", "surrogate", "reference", "hybrid"]
    assert [[call.split()[0] for call in each.calls] for each in learners] == [["renew", "tell"] * 2, ["renew", "tell"]]
    assert ended == [2, 4]


def test_a_page_says_what_it_learned_and_keeps_nothing_unasked(tmp_path: Path, told: list[Figures]) -> None:
    np.save(tmp_path / "cloud_1.npy", next(shots(1)).cloud)
    before, said = (PHANTOM / "surrogate.json").read_bytes(), list[str]()
    run_live(PHANTOM, tmp_path, {}, idle=1.0, learn=True, browser=False, say=said.append)
    assert answered(told)[-1].verdict is Verdict.ACCEPTED
    assert any("learned" in line for line in said)
    assert (PHANTOM / "surrogate.json").read_bytes() == before and not (PHANTOM / "as-built").exists()


@pytest.mark.parametrize(
    ("asked", "options", "message"),
    [
        ({"keep": True}, {}, r"--keep: expected --learn beside it"),
        (
            {"learn": True},
            {"model": "torch"},
            r"registration\.model: expected a twin that registers with its surrogate",
        ),
    ],
)
def test_what_cannot_be_learned_is_refused_before_the_page_opens(
    tmp_path: Path, asked: dict[str, bool], options: dict[str, str], message: str
) -> None:
    said = list[str]()
    with pytest.raises(ConfigError, match=message):
        run_live(PHANTOM, tmp_path, options, browser=False, say=said.append, **asked)
    assert not any("http://" in line for line in said)


def test_clouds_of_a_peer_are_heard_in_its_own_unit_and_axes() -> None:
    """A second process sends them over a socket; the page's source has them in metres and LPS."""
    pytest.importorskip("pyigtl", reason="pyigtl is absent")
    from .test_openigtlink import PLACES, process

    scene, heard = Scene.of(PHANTOM, {}, "mm", "ras"), list[Any]()
    with process() as other:
        address = Address("127.0.0.1", other.listen(room=0))
        clouds = iter(clouds_of(address, scene, say=lambda _: None))
        listening = threading.Thread(target=lambda: heard.append(next(clouds)))
        listening.start()
        other.accept()
        other.send(kind="POINT", device="camera", places=PLACES, polygons=[], version=2, time=1.0)
        listening.join()
        clouds.close()  # type: ignore[attr-defined]
    np.testing.assert_allclose(heard[0], 1e-3 * np.array(PLACES) * [-1, -1, 1], atol=1e-6)


def test_what_cannot_be_shown_is_said_before_a_page_opens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="SOURCE: expected a folder"):
        run_live(PHANTOM, tmp_path / "none", {}, browser=False)
    assert "expected a twin folder" in run(capsys, "live", tmp_path, tmp_path, "--no-browser", code=2)
    assert "--idle: " in run(capsys, "live", PHANTOM, tmp_path, "--idle", -1, "--no-browser", code=2)
    with page_server.serving() as server:
        taken = server.get_port()
        for command in (["demo"], ["live", PHANTOM, tmp_path], ["pick", PHANTOM / "organ.toml"]):
            assert "--port: expected a free port" in run(capsys, *command, "--port", taken, "--no-browser", code=2)
