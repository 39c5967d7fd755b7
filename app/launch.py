"""Stages under mpirun."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from softtwin.reference.ranks import FailedElsewhere

from .doctor import available_cores
from .installation import launcher
from .stages.generate import generate_stage
from .stages.model_error import model_error_stage

REFUSED = 2  # exit code of a command whose message was printed
_JOB_VARIABLES = ("PMIX_", "ORTE_", "OMPI_MCA_orte", "OMPI_MCA_ess", "OMPI_COMM_", "OMPI_UNIVERSE", "OMPI_APP_CTX")


def generate_in_parallel(config_path: Path, ranks: int, again: bool = False) -> None:
    """Run the generate stage under mpirun, or here where there is one core or no mpirun.

    Args:
        config_path: the configuration file.
        ranks: MPI ranks; 0 for one a core.
        again: throw away what was solved before.

    Raises:
        FailedElsewhere: the stage was refused; its own message stands above.
        RuntimeError: it ended in another way.
    """
    if not _in_parallel(["generate", str(config_path), *(["--again"] if again else [])], ranks):
        generate_stage(config_path, again=again)


def model_error_in_parallel(config_path: Path, ranks: int) -> None:
    """Run the model-error stage under mpirun, or here where there is one core or no mpirun; as `generate_in_parallel`.

    Args:
        config_path: the configuration file.
        ranks: MPI ranks; 0 for one a core.
    """
    if not _in_parallel(["model-error", str(config_path)], ranks):
        click.echo(f"    {model_error_stage(config_path)}")


def _in_parallel(words: Sequence[str], ranks: int) -> bool:
    """Run a command of softtwin under mpirun; False, and nothing was done, where that is of no use."""
    ranks = ranks or available_cores()
    mpirun = launcher() if ranks > 1 else None
    if mpirun is None:
        return False
    # A caller that runs MPI itself hands down the names of its own job, which mpirun would take for its.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_JOB_VARIABLES)}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    if sys.stderr.isatty():
        environment["SOFTTWIN_PROGRESS"] = "1"
    if os.geteuid() == 0:
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    program = [sys.executable, "-m", "softtwin.app.cli", *words]
    done = subprocess.run(mpirun.command(ranks, program), env=environment, check=False)
    if done.returncode == REFUSED:
        raise FailedElsewhere(f"{words[0]}: refused by the ranks for {words[1]}; their message stands above.")
    if done.returncode != 0:
        raise RuntimeError(
            f"{words[0]}: mpirun ended with code {done.returncode}; its message stands above. What was solved is kept: "
            f"run `softtwin {words[0]} {words[1]}` again to go on."
        )
    return True
