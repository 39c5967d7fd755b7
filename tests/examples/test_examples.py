"""Every example runs, and says what it promises."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import design_a_phantom
import follow_a_stream
import numpy as np
import own_forward_model
import own_simulator
import pytest
import register_a_cloud

from softtwin.reference.data.dataset import DataSet

EXAMPLES = {
    "register_a_cloud",
    "follow_a_stream",
    "own_forward_model",
    "own_simulator",
    "train_through_equilibria",
    "design_a_phantom",
    "run_exported_graphs",
    "openigtlink_camera",
    "ros2_pointcloud",
}
EXAMPLES_FOLDER = Path(own_forward_model.__file__).parent


def test_every_example_is_tested_here() -> None:
    folder = Path(own_forward_model.__file__).parent
    assert {path.stem for path in folder.glob("*.py")} == EXAMPLES


def test_register_a_cloud(small_quickstart: Path, capsys) -> None:
    """The tumour moved by more than 5 mm; the small twin, of 24 samples, finds it to a quarter of that."""
    assert register_a_cloud.main(small_quickstart) < 2e-3
    assert "the tumour was" in capsys.readouterr().out


def test_follow_a_stream(small_quickstart: Path, capsys) -> None:
    verdicts = follow_a_stream.main(small_quickstart)
    assert [number for number, verdict in enumerate(verdicts) if verdict == "refused"] == [2]
    assert "frame 2: refused: cloud" in capsys.readouterr().out


def test_own_forward_model(capsys) -> None:
    assert own_forward_model.main() == pytest.approx(0.0, abs=0.02)  # half a millimetre of noise on 40 mm of movement
    assert "accepted" in capsys.readouterr().out


def test_own_simulator(tmp_path: Path, capsys) -> None:
    """A linear map of the same samples is off by a fifth: the simulator stiffens twofold."""
    assert own_simulator.main(tmp_path) < 0.05
    assert "accepted test samples averaged" in capsys.readouterr().out


@pytest.mark.fenicsx
def test_train_through_equilibria(capsys) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    import train_through_equilibria

    assert train_through_equilibria.main() < 0.1
    assert capsys.readouterr().out.count("% off") == 5


def test_design_a_phantom(tmp_path: Path, capsys) -> None:
    """The stiffness that was asked for, and the derivative that led there, which differences agree with."""
    tumour, strain = design_a_phantom.main(tmp_path / "design.png")
    assert strain == pytest.approx(design_a_phantom.WANTED, abs=2 * design_a_phantom.CLOSE)
    assert 1.5 * design_a_phantom.TISSUE < tumour < 20.0 * design_a_phantom.TISSUE
    assert (tmp_path / "design.png").stat().st_size > 10_000
    assert "found with" in capsys.readouterr().out
    phantom = design_a_phantom.Phantom()
    there = phantom.state(tumour)
    slope = phantom.slope(there, tumour)
    ends = [phantom.strain(phantom.state(tumour * float(np.exp(step)), there).displacement) for step in (1e-3, -1e-3)]
    assert slope == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-3)


def test_run_exported_graphs(small_quickstart: Path, tmp_path: Path, capsys) -> None:
    """After `softtwin export`, which writes into the twin's folder."""
    pytest.importorskip("onnxruntime", reason="onnxruntime is absent")
    import run_exported_graphs

    from softtwin.app.cli import main

    twin = Path(shutil.copytree(small_quickstart / "twin", tmp_path / "twin"))
    main(["export", str(twin), "--directions", "5"])
    assert run_exported_graphs.main(twin) < 0.05
    assert "graphs written to" in capsys.readouterr().out


# Who runs tests in the background may have Ctrl-C ignored, and programs inherit that.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from softtwin.app.cli import main
main(sys.argv[1:])
"""


def test_openigtlink_camera(small_quickstart: Path, tmp_path: Path) -> None:
    """Two programs, as the example says: one registers until Ctrl-C, one is the camera."""
    pytest.importorskip("pyigtl", reason="pyigtl is absent")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = str(probe.getsockname()[1])
    register = [
        "-c",
        PROGRAM,
        "register",
        str(small_quickstart),
        f"igtl://:{port}",
        "--watch",
        "--output",
        str(tmp_path),
    ]
    camera = [str(EXAMPLES_FOLDER / "openigtlink_camera.py"), str(small_quickstart), port, "3"]
    with ExitStack() as ended:
        both = []
        for arguments in (register, camera):
            command, out = [sys.executable, *arguments], {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
            both.append(ended.enter_context(subprocess.Popen(command, **out, text=True)))
            ended.callback(both[-1].kill)
        said = both[1].communicate(timeout=300)[0]
        both[0].send_signal(signal.SIGINT)
        told = both[0].communicate(timeout=300)[0]
    assert both[1].returncode == 0 and said.count("tumour at") == 3, said + told
    assert both[0].returncode == 130 and "OpenIGTLink: listening on 127.0.0.1" in told, told
    rows = json.loads((tmp_path / "registration.json").read_text())["frames"]
    assert [row["verdict"] for row in rows] == re.findall(r"frame \d: (\w+),", said)[: len(rows)]
    assert len(rows) >= 2 and all(row["cloud"].startswith("camera ") for row in rows)  # the last may be interrupted


def test_ros2_pointcloud_says_where_ros_is_not(tmp_path: Path) -> None:
    if importlib.util.find_spec("rclpy") is not None:
        pytest.skip("ROS 2 is here")
    command = [sys.executable, str(EXAMPLES_FOLDER / "ros2_pointcloud.py"), str(tmp_path), "/points"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert "ROS 2 is absent" in done.stdout and done.stderr == ""


def test_ros2_pointcloud_registers_what_a_topic_carries(small_quickstart: Path, monkeypatch, capsys) -> None:
    """ROS by a stand-in of four functions: it shows the way from a message to an answer, and nothing of ROS itself."""
    import ros2_pointcloud

    cloud = np.load(small_quickstart / "demo" / "cloud.npy")
    record = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")])
    message = np.array([tuple(point) for point in cloud], record)
    heard = []
    stand_ins = {
        "rclpy": {"init": lambda: None, "spin": lambda node: heard[0](message)},
        "rclpy.qos": {"qos_profile_sensor_data": SimpleNamespace(depth=5)},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"PointCloud2": object},
        "sensor_msgs_py": {},
        "sensor_msgs_py.point_cloud2": {"read_points": lambda message, field_names, skip_nans: message},
    }
    node = SimpleNamespace(create_subscription=lambda kind, topic, hear, quality: heard.append(hear))
    stand_ins["rclpy"]["create_node"] = lambda name: node
    for name, entries in stand_ins.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**entries))
    assert ros2_pointcloud.main(small_quickstart / "twin", "/points") == 1
    assert "frame 0: " in capsys.readouterr().out


SCRIPT = Path(own_forward_model.__file__).parent / "slurm.sh"
SMALL = """
folder = "."
[body]
source = "beam"
[samples]
train = 12
validation = 4
test = 4
block = 4
jacobians = false
"""


@pytest.mark.fenicsx
@pytest.mark.slow
def test_an_array_of_jobs_under_plain_bash(tmp_path: Path) -> None:
    """Two of three tasks at the same moment; the third is lost, which is told, and made alone as an array of one.

    SLURM says then that the array has one task, and its number.
    """
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    organ = tmp_path / "organ.toml"
    organ.write_text(SMALL)
    bare = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    environment = bare | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "SOFTTWIN_PARTS": "3"}

    def run(*command: str, **more: str) -> subprocess.Popen:
        return subprocess.Popen(command, env=environment | more, stdout=subprocess.PIPE, text=True)

    mesh = run("softtwin", "mesh", str(organ))
    assert "nodes" in mesh.communicate(timeout=120)[0] and mesh.returncode == 0

    def task(number: int, of: int) -> subprocess.Popen:
        told = {"SLURM_ARRAY_TASK_ID": str(number), "SLURM_ARRAY_TASK_COUNT": str(of)}
        return run("bash", str(SCRIPT), str(organ), **told)

    tasks = [task(number, 3) for number in (0, 2)]
    said = [each.communicate(timeout=120)[0] for each in tasks]
    assert [each.returncode for each in tasks] == [0, 0]
    assert any("2 of 5 blocks of" in each and "are still missing" in each for each in said)
    again = task(1, 1)
    again.communicate(timeout=120)
    assert again.returncode == 0 and DataSet(tmp_path / "data.zarr").missing_blocks() == []
    whole = run("softtwin", "generate", str(organ))
    assert "20 equilibria accepted, 0 rejected" in whole.communicate(timeout=120)[0]


def test_the_array_has_as_many_tasks_as_the_script_has_parts(tmp_path: Path) -> None:
    """The header and the script each say it; outside of an array there is one part."""
    (last,) = re.findall(r"^#SBATCH --array=0-(\d+)$", SCRIPT.read_text(), flags=re.M)
    fake = tmp_path / "softtwin"
    fake.write_text('#!/usr/bin/env bash\necho "$@"\n')
    fake.chmod(0o755)
    bare = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "SOFTTWIN_"))}
    environment = bare | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}

    def parts(**more: str) -> str:
        command = ["bash", str(SCRIPT), "organ.toml"]
        return subprocess.run(
            command, env=environment | more, capture_output=True, text=True, check=True
        ).stdout.split()[-1]

    assert parts(SLURM_ARRAY_TASK_ID=last) == f"{last}/{int(last) + 1}"
    assert parts(SLURM_ARRAY_TASK_ID="3", SLURM_ARRAY_TASK_COUNT="1", SOFTTWIN_PARTS="8") == "3/8"
    assert parts() == parts(SOFTTWIN_PARTS="8") == "0/1"
