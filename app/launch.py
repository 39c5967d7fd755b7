"""Stages under mpirun."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from softtwin.reference.ranks import FailedElsewhere

from .doctor import available_cores
from .stages.generate import generate_stage

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
    ranks = ranks or available_cores()
    if ranks == 1 or shutil.which("mpirun") is None:
        generate_stage(config_path, again=again)
        return
    # A caller that runs MPI itself hands down the names of its own job, which mpirun would take for its.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_JOB_VARIABLES)}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    if sys.stderr.isatty():
        environment["SOFTTWIN_PROGRESS"] = "1"
    if os.geteuid() == 0:
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    program = [sys.executable, "-m", "softtwin.app.cli", "generate", str(config_path)]
    program += ["--again"] if again else []
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), *program]
    done = subprocess.run(command, env=environment, check=False)
    if done.returncode == REFUSED:
        raise FailedElsewhere(f"generate: refused by the ranks for {config_path}; their message stands above.")
    if done.returncode != 0:
        raise RuntimeError(
            f"generate: mpirun ended with code {done.returncode}; its message stands above. What was solved is kept: "
            f"run `softtwin generate {config_path}` again to go on."
        )
