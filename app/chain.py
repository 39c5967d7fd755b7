"""The whole chain for one organ, from its surface to a validated twin; what is there and current is not made again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from softtwin.meshes.body import Body
from softtwin.meshes.io import read_body
from softtwin.reference.data.dataset import DataSet, DataSetError, differences
from softtwin.reference.data.samplers import check_loads
from softtwin.surrogate.checkpoint import CheckpointError
from softtwin.surrogate.plan import Device

from .config import Config, ConfigError, to_toml
from .inputs import changes, load_plan, mesh_inputs, plan_entries, solved_data
from .launch import generate_in_parallel, model_error_in_parallel
from .register import NOTICE
from .stages.generate import describe_data, lacks_jacobians
from .stages.learn import train_stage, validate_stage
from .stages.mesh import mesh_stage
from .stages.model_error import is_current
from .stages.plan import training_plan
from .twin import FORMER_MODEL_ERROR, MODEL_ERROR
from .workspace import Workspace, open_workspace, write_whole

Say = Callable[[str], None]


def build_twin(
    config: Config, output: Path, say: Say, again: bool = False, device: Device = "auto", processes: int = 1
) -> Workspace:
    """Mesh, generate, train and validate.

    Args:
        config: the configuration; it is written to `output`/organ.toml.
        output: folder of everything that is made.
        say: prints a line.
        again: throw away equilibria that were solved there before.
        device: where to train.
        processes: that train together.

    Raises:
        ConfigError: equilibria were solved there with another configuration or other files.
    """
    space = prepare(config if again else _as_solved(config, output, say), output, again)
    make_twin(space, output / "organ.toml", say, again, device, processes)
    say(f"\ntwin: {space.twin}")
    say(f"next: softtwin register {space.twin} CLOUDS...   and: softtwin report {output / 'organ.toml'}")
    say(NOTICE)
    return space


def _as_solved(config: Config, output: Path, say: Say) -> Config:
    """The configuration without smooth draws where the equilibria that lie there are from before there were any."""
    data = solved_data(Workspace(config, output))
    if data is None or not config.samples.smooth or data.header["samples"].get("smooth"):
        return config
    say("equilibria: those here have no smooth draws; error patterns are learned from the validation draws alone")
    return config.model_copy(update={"samples": config.samples.model_copy(update={"smooth": 0})})


def prepare(config: Config, output: Path, again: bool = False) -> Workspace:
    """The folder with its configuration file, which is written unless that would make solved equilibria worthless.

    Args:
        config: the configuration.
        output: the folder.
        again: write it in any case.

    Raises:
        ConfigError: equilibria were solved there with another configuration or other files.
    """
    output.mkdir(parents=True, exist_ok=True)
    data = None if again else solved_data(Workspace(config, output))
    if data is not None:
        _refuse_changes(Workspace(config, output), data)
    write_whole(output / "organ.toml", to_toml(config))
    return open_workspace(output / "organ.toml")


def make_twin(
    space: Workspace, path: Path, say: Say, again: bool = False, device: Device = "auto", processes: int = 1
) -> None:
    """The stages up to the validated twin, each only where its result is missing or of other inputs.

    Args:
        space: the workspace.
        path: its configuration file, for the ranks that mpirun starts.
        say: prints a line.
        again: throw away equilibria that were solved before.
        device: where to train.
        processes: that train together.

    Raises:
        ConfigError: equilibria were solved there on another mesh.
    """
    plan = training_plan(space.config.training, device, processes)  # refused before the hour that equilibria take
    say(f"1/5 mesh: {space.config.body.source}")
    body = _mesh(space, say)
    say(f"    {len(body.points)} nodes, {len(body.cells)} cells, {len(body.fixed)} fixed, {1e3 * body.volume:.2f} l")
    check_loads(body, load_plan(space.config))
    plan.architecture.check(body)
    say(_indented((space.folder / "mesh_quality.txt").read_text()))
    say("2/5 generate: eigenmodes, modal loads, equilibria")
    _generate(space, body, path, say, again)
    say("3/5 train: the surrogate")
    try:
        train_stage(space, device=device, processes=processes)
    except CheckpointError as error:
        say(f"    from the start: {str(error).partition(';')[0].removeprefix('train.folder: ')}")
        train_stage(space, fresh=True, device=device, processes=processes)
    say("4/5 validate: held-out errors")
    say(validate_stage(space))
    say("5/5 model error: perturbed models of the organ")
    _model_error(space, path, say)


def _mesh(space: Workspace, say: Say) -> Body:
    changed = changes(space, "mesh", mesh_inputs(space))
    if space.body.exists() and changed == []:
        return read_body(space.body)
    if changed:
        say(f"    made again, what it is made of has changed: {'; '.join(changed)}")
    return mesh_stage(space)


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())


def _generate(space: Workspace, body: Body, path: Path, say: Say, again: bool) -> None:
    data = None if again else solved_data(space)
    found = [] if data is None else differences(data, body, plan_entries(space.config))
    if found:
        raise ConfigError(_refusal(space, found))
    whole = data is not None and not data.missing_blocks() and not data.damaged_blocks()
    if data is not None and whole and not lacks_jacobians(space.config, data):
        say(f"    there already: {describe_data(data)}")
        return
    generate_in_parallel(path, space.config.samples.ranks, again)  # says itself what it has made


def _model_error(space: Workspace, path: Path, say: Say) -> None:
    if not space.config.model_error.is_asked_for:
        (space.twin / MODEL_ERROR).unlink(missing_ok=True)
        (space.twin / FORMER_MODEL_ERROR).unlink(missing_ok=True)
        say("    nothing: [model_error] perturbs nothing, and the margins do not cover the model's error")
    elif is_current(space, DataSet(space.data)):
        say("    as before")
    else:
        model_error_in_parallel(path, space.config.samples.ranks)


def _refuse_changes(space: Workspace, data: DataSet) -> None:
    changed = changes(space, "mesh", mesh_inputs(space))
    if changed is None:
        changed = [f"no record in {space.folder / 'stages.json'} says what the mesh was made of"]
    try:
        changed += differences(data, data.body, plan_entries(space.config))
    except DataSetError as error:
        changed.append(str(error))
    if changed:
        raise ConfigError(_refusal(space, changed))


def _refusal(space: Workspace, found: list[str]) -> str:
    return (
        f"{space.folder}: equilibria were solved here with another configuration or other files: {'; '.join(found)}. "
        "Choose another --output, or throw them away (`softtwin build --again`, or delete the folder)."
    )
