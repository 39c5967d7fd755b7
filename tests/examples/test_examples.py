"""Every example runs, and says what it promises."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import follow_a_stream
import own_forward_model
import own_simulator
import pytest
import register_a_cloud

EXAMPLES = {
    "register_a_cloud",
    "follow_a_stream",
    "own_forward_model",
    "own_simulator",
    "train_through_equilibria",
    "run_exported_graphs",
}


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


def test_run_exported_graphs(small_quickstart: Path, tmp_path: Path, capsys) -> None:
    """After `softtwin export`, which writes into the twin's folder."""
    pytest.importorskip("onnxruntime", reason="onnxruntime is absent")
    import run_exported_graphs

    from softtwin.app.cli import main

    twin = Path(shutil.copytree(small_quickstart / "twin", tmp_path / "twin"))
    main(["export", str(twin), "--directions", "5"])
    assert run_exported_graphs.main(twin) < 0.05
    assert "graphs written to" in capsys.readouterr().out


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
def test_an_array_of_jobs_under_plain_bash(tmp_path: Path) -> None:
    """Two of three tasks at the same moment; the third is lost, which is told, and made by `generate`."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    script = Path(own_forward_model.__file__).parent / "slurm.sh"
    organ = tmp_path / "organ.toml"
    organ.write_text(SMALL)
    bare = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    environment = bare | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "SLURM_ARRAY_TASK_COUNT": "3"}

    def run(*command: str, **more: str) -> subprocess.Popen:
        return subprocess.Popen(command, env=environment | more, stdout=subprocess.PIPE, text=True)

    mesh = run("softtwin", "mesh", str(organ))
    assert "nodes" in mesh.communicate(timeout=120)[0] and mesh.returncode == 0
    tasks = [run("bash", str(script), str(organ), SLURM_ARRAY_TASK_ID=str(number)) for number in (0, 2)]
    said = [task.communicate(timeout=120)[0] for task in tasks]
    assert [task.returncode for task in tasks] == [0, 0]
    assert any("2 of 5 blocks of" in each and "are still missing" in each for each in said)
    whole = run("softtwin", "generate", str(organ))
    assert "20 equilibria accepted, 0 rejected" in whole.communicate(timeout=120)[0]
