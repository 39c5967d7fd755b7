"""Clouds as they come: the newest wins, only whole files are read, what is late or dropped is said."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from softtwin.app.config import ConfigError
from softtwin.app.live import answers, keeping_up, register_live
from softtwin.app.record import RECORD
from softtwin.app.register import CloudFile
from softtwin.app.streams import Mailbox, WatchedFolder, fed
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.export import Coordinates
from softtwin.registration.outcome import Outcome

from .conftest import pulled, run, seen_cloud

# Who runs tests in the background may have Ctrl-C ignored, and programs inherit that.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from softtwin.app.cli import main
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def cloud(plain_twin: Twin) -> np.ndarray:
    return seen_cloud(plain_twin, pulled(plain_twin.body, (0.0, 0.06, -0.2)))


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds


# ---------------------------------------------------------------------- the mailbox


def test_the_newest_cloud_is_taken_and_the_others_are_counted() -> None:
    clock = Clock()
    box = Mailbox(clock)
    for number in range(3):
        clock.now = float(number)
        box.put(np.full((1, 3), number))
    taken = box.take()
    assert taken is not None and taken.cloud[0, 0] == 2 and taken.at == 2.0 and taken.dropped == 2
    box.put(np.zeros((1, 3)))
    taken = box.take()
    assert taken is not None and taken.dropped == 0


def test_what_lies_in_a_closed_mailbox_is_still_taken() -> None:
    box = Mailbox()
    box.put(np.zeros((1, 3)))
    box.close()
    assert box.take() is not None and box.take() is None
    with pytest.raises(CloudError, match=r"Mailbox\.put: expected an open mailbox"):
        box.put(np.zeros((1, 3)))


def test_who_waits_is_woken_from_another_thread() -> None:
    box, found = Mailbox(), []
    waiting = threading.Thread(target=lambda: found.append(box.take()))
    waiting.start()
    box.put(np.ones((1, 3)))
    waiting.join(timeout=30.0)
    assert not waiting.is_alive() and found[0].cloud[0, 0] == 1


def test_a_source_that_fails_is_told_where_the_clouds_are_taken() -> None:
    def broken():
        yield np.zeros((1, 3))
        raise OSError("the camera was unplugged")

    box = fed(broken())
    with pytest.raises(OSError, match="unplugged"):
        for _ in range(2):
            box.take()


# ---------------------------------------------------------------------- the folder


def watched(folder: Path, writes: dict[int, list[tuple[str, str]]], idle: float = 0.5) -> list[str]:
    """Names that a watch gives while files are written between its looks, by the number of the look."""
    clock, looks = Clock(), [0]

    def sleep(seconds: float) -> None:
        looks[0] += 1
        clock.wait(seconds)
        for name, content in writes.get(looks[0], []):
            (folder / name).write_text(content)
            os.utime(folder / name, ns=(looks[0], looks[0]))

    source = WatchedFolder(folder, lambda path: CloudFile(path, Coordinates()), 0.1, idle, clock, sleep)
    return [file.path.name for file in source]


def test_files_are_given_once_by_number_when_they_are_whole(tmp_path: Path) -> None:
    (tmp_path / "cloud_10.xyz").write_text("0 0 0\n")
    (tmp_path / "cloud_9.xyz").write_text("0 0 0\n")
    (tmp_path / "notes.md").write_text("no cloud")
    (tmp_path / ".cloud_11.xyz").write_text("0 0 0\n")  # as a program writes that renames it when it is whole
    growing = {2: [("cloud_12.xyz", "0 0")], 3: [("cloud_12.xyz", "0 0 0\n1 1 1\n")]}
    assert watched(tmp_path, growing) == ["cloud_9.xyz", "cloud_10.xyz", "cloud_12.xyz"]


def test_a_file_that_grows_is_waited_for(tmp_path: Path) -> None:
    growing = {look: [("cloud_1.xyz", "0 0 0\n" * look)] for look in range(1, 9)}
    late = {look: [*growing.get(look, []), ("cloud_2.xyz", "0 0 0\n")] for look in (4,)}
    assert watched(tmp_path, {**growing, **late}) == ["cloud_2.xyz", "cloud_1.xyz"]


def test_an_empty_file_and_an_empty_folder_are_nothing(tmp_path: Path) -> None:
    assert watched(tmp_path / "later", {}) == []
    assert watched(tmp_path, {1: [("cloud_1.xyz", "")]}) == []


def test_a_folder_that_disappears_is_said_and_waited_for(tmp_path: Path) -> None:
    folder, clock, said, looks = tmp_path / "Kamera ä", Clock(), list[str](), [0]

    def write() -> None:
        folder.mkdir()
        (folder / "Wolke 1.xyz").write_text("0 0 0\n")
        (folder / "kept.xyz").write_text("0 0 0\n")
        os.utime(folder / "kept.xyz", ns=(1, 1))  # it comes back as it was

    def sleep(seconds: float) -> None:
        looks[0] += 1
        clock.wait(seconds)
        if looks[0] == 4:
            shutil.rmtree(folder)
        elif looks[0] == 8:
            write()

    write()
    source = WatchedFolder(folder, lambda path: CloudFile(path, Coordinates()), 0.1, 1.0, clock, sleep, said.append)
    assert [file.path.name for file in source] == ["Wolke 1.xyz", "kept.xyz", "Wolke 1.xyz"]
    assert said == [f"{folder}: no such folder, waiting", f"{folder}: there again"]


@pytest.mark.parametrize("option", ["every", "idle"])
def test_times_that_are_none_are_refused(tmp_path: Path, option: str) -> None:
    with pytest.raises(ValueError, match=rf"WatchedFolder\.{option}: expected a positive time in seconds, got 0\.0"):
        WatchedFolder(tmp_path, lambda path: CloudFile(path, Coordinates()), **{option: 0.0})


# ---------------------------------------------------------------------- answers


def test_answers_say_how_old_they_are_and_what_was_dropped(plain_twin: Twin, cloud: np.ndarray) -> None:
    clock = Clock()
    box = Mailbox(clock)
    box.put(cloud[:10])
    box.put(cloud)
    clock.now = 0.25
    box.close()
    (answer,) = answers(Sequence(plain_twin, "tip"), box, budget=None, clock=clock)
    assert answer.age == 0.25 and answer.dropped == 1 and not answer.is_late
    assert answer.frame.judgement.is_usable


def test_an_answer_after_its_time_is_late_and_the_best_so_far(plain_twin: Twin, cloud: np.ndarray) -> None:
    box = Mailbox()
    box.put(cloud)
    box.close()
    (answer,) = answers(Sequence(plain_twin, "tip"), box, budget=1e-6)
    assert answer.is_late
    found = answer.frame.registration
    assert found is not None and found.outcome is Outcome.OUT_OF_TIME
    assert "the time for it was over" in answer.frame.judgement.reasons[0]  # before all that may come of it
    enough = Sequence(plain_twin, "tip").register(cloud, time.monotonic() + 600.0).registration
    assert enough is not None and enough.outcome is Outcome.CONVERGED


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_is_a_positive_time(plain_twin: Twin, tmp_path: Path, budget: float) -> None:
    with pytest.raises(ConfigError, match="--budget: expected a finite number > 0, in seconds"):
        register_live(plain_twin, Mailbox(), tmp_path, budget=budget)


def test_a_stream_is_recorded_with_garbage_in_it(plain_twin: Twin, cloud: np.ndarray, tmp_path: Path) -> None:
    said: list[str] = []
    taken = threading.Semaphore(0)

    def camera():
        for each in (cloud, np.full((50, 3), np.nan), cloud + 5.0, cloud):
            yield each
            taken.acquire(timeout=60.0)  # the next comes when this one is answered

    def say(line: str) -> None:
        said.append(line)
        taken.release()

    rows = register_live(plain_twin, fed(camera()), tmp_path, zone="tip", formats=(), say=say)
    assert [row["verdict"] for row in rows] == ["accepted", "refused", "refused", "accepted"]
    assert all(row["age_s"] > 0.0 and row["dropped"] == 0 and not row["is_late"] for row in rows)
    assert "ms old" in said[0]
    record = json.loads((tmp_path / RECORD).read_text())
    assert [row["verdict"] for row in record["frames"]] == [row["verdict"] for row in rows]
    assert keeping_up(rows).startswith("4 frames, ") and keeping_up([]) == "no cloud has come"


def test_frames_of_another_organ_in_between_are_refused_and_the_stream_goes_on(
    plain_twin: Twin, cloud: np.ndarray, tmp_path: Path
) -> None:
    """The frame after them is as if they had not been: it starts from the last one that could be used."""
    chance, taken = np.random.default_rng(2), threading.Semaphore(0)
    ball = chance.standard_normal((400, 3))
    other = 0.06 * ball / np.linalg.norm(ball, axis=1)[:, None] + plain_twin.body.points.mean(axis=0)

    def camera():
        for each in (cloud, other, other, other, cloud):
            yield each
            taken.acquire(timeout=60.0)

    rows = register_live(plain_twin, fed(camera()), tmp_path, zone="tip", formats=(), say=lambda line: taken.release())
    assert [row["verdict"] for row in rows] == ["accepted", "refused", "refused", "refused", "accepted"]
    assert all("do not match" in row["reasons"][0] for row in rows[1:4])
    apart = np.array(rows[4]["net_force_N"]) - rows[0]["net_force_N"]
    assert (np.abs(apart) < 0.2 * np.array(rows[0]["net_force_deviation_N"])).all()
    assert rows[4]["evaluations"] < rows[0]["evaluations"]


def test_a_stream_of_nothing_usable_says_so(plain_twin: Twin, tmp_path: Path) -> None:
    with pytest.raises(CloudError, match="no cloud could be registered"):
        register_live(plain_twin, fed([np.full((50, 3), np.nan)]), tmp_path, zone="tip", formats=())


# ---------------------------------------------------------------------- the command line


def test_words_that_do_not_go_together_are_refused(mesh_folder: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "file.xyz").write_text("0 0 0\n")
    for arguments, words in (
        (("--idle", 1.0), "--idle: expected --watch"),
        (("--watch", "--truth", tmp_path / "file.xyz"), "--watch: expected one folder or igtl://... and no --truth"),
        (("--watch", "--budget", 0.0), "--budget: expected a finite number > 0, in seconds"),
    ):
        assert words in run(capsys, "register", mesh_folder, tmp_path / "file.xyz", *arguments, code=2)
    assert "--idle: " in run(capsys, "register", mesh_folder, tmp_path, "--watch", "--idle", -1.0, code=2)
    assert "expected a folder" in run(capsys, "register", mesh_folder, tmp_path / "file.xyz", "--watch", code=2)


@pytest.mark.fenicsx
def test_a_folder_is_watched_until_it_is_interrupted(small_quickstart: Path, tmp_path: Path) -> None:
    """A program of its own, clouds renamed into its folder while it runs, Ctrl-C at the end."""
    folder, output = tmp_path / "camera", tmp_path / "out"
    folder.mkdir()
    cloud = np.load(small_quickstart / "demo" / "cloud.npy")
    command = [sys.executable, "-c", PROGRAM, "register", str(small_quickstart), str(folder), "--watch"]
    command += ["--budget", "60", "--output", str(output)]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process,
        ExitStack() as ended,
    ):
        ended.callback(process.kill)  # whatever fails here, nothing is waited for
        assert process.stdout is not None
        assert "results in mm, LPS" in process.stdout.readline()
        for number in range(2):
            np.savetxt(folder / ".next.xyz", cloud)
            (folder / ".next.xyz").rename(folder / f"cloud_{number}.xyz")
            line = process.stdout.readline()
            assert f"frame   {number}: accepted" in line and "ms old" in line, line
        (folder / "cloud_2.xyz").write_text("0 0 0\n1 1")  # a writer that died
        assert "refused" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=120) == 130
    record = json.loads((output / RECORD).read_text())
    assert record["counts"] == {"accepted": 2, "doubtful": 0, "refused": 1}
    assert all(row["age_s"] > 0.0 for row in record["frames"])
