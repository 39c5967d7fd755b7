"""The whole chain for one organ, from its surface to a validated twin; what is there already is not made again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from softtwin.meshes.files import read_body
from softtwin.reference.dataset import DataSet, DataSetError

from .config import Config, ConfigError, to_toml
from .launch import generate_in_parallel
from .register import NOTICE
from .stages.learn import train_stage, validate_stage
from .stages.mesh import mesh_stage
from .workspace import Workspace, open_workspace


def build_twin(config: Config, output: Path, say: Callable[[str], None]) -> Workspace:
    """Mesh, generate, train and validate.

    Args:
        config: the configuration; it is written to `output`/organ.toml.
        output: folder of everything that is made.
        say: prints a line.

    Raises:
        ConfigError: the folder was made with another configuration.
    """
    space = prepare(config, output)
    make_twin(space, output / "organ.toml", say)
    say(f"\ntwin: {space.twin}")
    say(f"next: softtwin register {space.twin} CLOUDS...   and: softtwin report {output / 'organ.toml'}")
    say(NOTICE)
    return space


def prepare(config: Config, output: Path) -> Workspace:
    """The folder with its configuration file.

    Raises:
        ConfigError: the folder holds another configuration.
    """
    output.mkdir(parents=True, exist_ok=True)
    path, text = output / "organ.toml", to_toml(config)
    if path.exists() and path.read_text() != text:
        raise ConfigError(
            f"{path}: this folder was made with another configuration; choose another --output, or go on with "
            f"`softtwin generate {path}` and so forth."
        )
    path.write_text(text)
    return open_workspace(path)


def make_twin(space: Workspace, path: Path, say: Callable[[str], None]) -> None:
    """The stages up to the validated twin, each only where its result is missing.

    Args:
        space: the workspace.
        path: its configuration file, for the ranks that mpirun starts.
        say: prints a line.
    """
    say(f"1/4 mesh: {space.config.body.source}")
    body = read_body(space.body) if space.body.exists() else mesh_stage(space)
    say(f"    {len(body.points)} nodes, {len(body.cells)} cells, {len(body.fixed)} fixed, {1e3 * body.volume:.2f} l")
    say(_indented((space.folder / "mesh_quality.txt").read_text()))
    say("2/4 generate: eigenmodes, modal loads, equilibria")
    if _complete(space):
        say(f"    there already: {describe_data(DataSet(space.data))}")
    else:
        generate_in_parallel(path, space.config.samples.ranks)  # says itself what it has made
    say("3/4 train: the surrogate")
    train_stage(space)
    say("4/4 validate: held-out errors")
    say(validate_stage(space))


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())


def describe_data(data: DataSet) -> str:
    """Counts of accepted and rejected draws, with the reasons of the rejected."""
    rejected = data.rejected()
    counts = {reason: rejected.reasons.count(reason) for reason in sorted(set(rejected.reasons))}
    total = sum(data.header["samples"].values())
    because = f" ({', '.join(f'{count} {reason}' for reason, count in counts.items())})" if counts else ""
    return f"{total - len(rejected.draws)} equilibria accepted, {len(rejected.draws)} rejected{because}"


def _complete(space: Workspace) -> bool:
    try:
        return not DataSet(space.data).missing_blocks()
    except DataSetError:
        return False
