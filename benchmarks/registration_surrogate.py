"""Registration of the real liver with a surrogate: the same frames, truth and metrics as with the reference.

    python benchmarks/registration_surrogate.py [--ranks 2] [--seconds 300] [--draws 1360] [--frames 50]
    python benchmarks/registration_surrogate.py twin 320      # the twin alone, for liver_engines.py and others

Makes the data set under benchmarks/runs/liver where it is not there, and trains the twin.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness import RANKS, Benchmark, Given, Setting, run
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence
from record import RUNS
from registration_reference import COLUMNS, lines, registered, with_summary

from softtwin.app.chain import prepare
from softtwin.app.config import Config
from softtwin.app.launch import generate_in_parallel
from softtwin.app.stages.learn import train_stage, validate_stage
from softtwin.app.workspace import Workspace
from softtwin.meshes.io import write_body
from softtwin.registration.options import options_for
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import load


def liver_config(seconds: float, ranks: int, draws: int = 1360) -> Config:
    """Loads on the zones that the sequences allow, each at half of its size and whole; so many draws to learn from."""
    held_out = max(48, 8 * (draws // 112))
    return Config.model_validate(
        {
            "folder": ".",
            "material": {"young_modulus": YOUNG_MODULUS, "poisson_ratio": POISSON_RATIO},
            "loads": {"zones": list(SEQUENCES), "patches": 1, "radius": (0.25, 0.8), "displacement": 0.1},
            # Many directions of load teach more than many sizes of each: 680 ramps of two, not 192 of eight.
            "samples": {
                "train": draws,
                "validation": held_out,
                "test": held_out,
                "smooth": held_out,
                "block": 8,
                "ramp": 2,
                "ranks": ranks,
            },
            "solver": {"tolerance": 1e-6, "max_iterations": 30, "max_load_steps": 6},
            "training": {"seconds": seconds, "width": 512},
        }
    )


def made_twin(seconds: float, ranks: int, folder: Path, draws: int) -> Workspace:
    """The liver's twin; a data set that is there is not made again."""
    config = liver_config(seconds, ranks, draws)
    if (folder / "organ.toml").exists():  # its mesh came from no stage: `prepare` would not know it again
        space = Workspace(config, folder)
    else:
        space = prepare(config, folder)
        write_body(space.body, liver())
    generate_in_parallel(folder / "organ.toml", ranks)
    train_stage(space)
    print(validate_stage(space))
    return space


def twin_alone(draws: str, seconds: str = "270") -> None:
    """Make the twin where others look for it, and register nothing."""
    made_twin(float(seconds), RANKS.default, RUNS / "liver", int(draws))


def learned(given: Given) -> Surrogate:
    """The twin that is given, or one that is made."""
    folder = given.twin or made_twin(given.seconds, given.ranks, given.folder, given.draws).twin
    return load(folder, liver())


def work(row: str, given: Given) -> dict[str, Any]:
    model = given.once(learned, given)
    options = options_for(model, has_zone=True)
    return with_summary(registered(sequence(row), model, given.frames, options, given.smoothness))


BENCHMARK = Benchmark(
    name="registration_surrogate",
    title="Registration of the real liver's sequences with a surrogate, against the computed truth",
    about=("registration", "surrogate", "reference"),
    work=work,
    rows=SEQUENCES,
    columns=COLUMNS,
    settings={
        "draws": Setting(1360, "that the network learns from"),
        "seconds": Setting(270.0, "of training"),
        "frames": Setting(50, "of each sequence"),
        "smoothness": Setting(0.02, "correlation length of the forces, metres"),
        "folder": Setting(RUNS / "liver", "where the twin is made", picks=True),
        "twin": Setting(None, "a finished twin instead of making one", kind=Path, picks=True),
        "ranks": RANKS,
    },
    small={"frames": 2},
    under="sequences",
    lines=lines,
    finish=lambda figures, given: {
        "smoothness": given.smoothness,
        "held_out": given.once(learned, given).card.get("held_out"),
    },
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"twin": twin_alone})
