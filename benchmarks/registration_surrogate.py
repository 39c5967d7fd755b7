"""Registration of the real liver with a surrogate: the same frames, truth and metrics as with the reference.

    python benchmarks/registration_surrogate.py [--ranks 2] [--seconds 300] [--draws 1360] [--frames 50]

Makes the data set under benchmarks/runs/liver where it is not there, and trains the twin.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence
from record import write
from registration_reference import run, summary
from threadpoolctl import threadpool_limits

from softtwin.app.chain import prepare
from softtwin.app.config import Config
from softtwin.app.launch import generate_in_parallel
from softtwin.app.stages.learn import train_stage, validate_stage
from softtwin.app.workspace import Workspace
from softtwin.meshes.files import write_body
from softtwin.registration.options import options_for

RUNS = Path(__file__).parent / "runs"


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
                "block": 8,
                "ramp": 2,
                "ranks": ranks,
            },
            "solver": {"tolerance": 1e-6, "max_iterations": 30, "max_load_steps": 6},
            "training": {"seconds": seconds, "width": 512},
        }
    )


def make_twin(seconds: float, ranks: int, folder: Path, draws: int) -> Workspace:
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


def main() -> None:
    from softtwin.surrogate.twin import load

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=270.0)
    parser.add_argument("--draws", type=int, default=1360, help="that the network learns from")
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--smoothness", type=float, default=0.02)
    parser.add_argument("--folder", type=Path, default=RUNS / "liver")
    parser.add_argument("--twin", type=Path, help="register with this finished twin instead of making one")
    arguments = parser.parse_args()
    twin = arguments.twin or make_twin(arguments.seconds, arguments.ranks, arguments.folder, arguments.draws).twin
    body = liver()
    model = load(twin, body)
    figures = {"smoothness": arguments.smoothness, "sequences": {}}
    figures["held_out"] = model.card.get("held_out")
    with threadpool_limits(1):
        for name in SEQUENCES:
            rows = run(sequence(name), model, arguments.frames, options_for(model, has_zone=True), arguments.smoothness)
            figures["sequences"][name] = {"summary": summary(rows), "frames": rows}
            print(name, {key: round(value, 4) for key, value in summary(rows).items()}, flush=True)
    write("registration_surrogate", figures)


if __name__ == "__main__":
    main()
