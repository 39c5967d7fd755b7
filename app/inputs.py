"""What the stages read, and whether what lies in a folder was made from what the configuration says now."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from softtwin.meshes.attachment import parse_file
from softtwin.meshes.body import Body
from softtwin.meshes.io import is_segmentation, read_body, structure_files
from softtwin.reference.data.dataset import DataSet, DataSetError, differences, existing
from softtwin.reference.data.jacobians import mark
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.springs import Support

from .config import Config, ConfigError
from .workspace import Workspace, read_records

# Entries that older records lack: at their default they change nothing.
_LATER = {"training.patience": 0, "training.precision": "single", "body.grid": 0.0, "body.organ": ""}
_MATERIAL = {"law": "material", "young_modulus": "young_modulus", "poisson_ratio": "poisson_ratio"}


def load_plan(config: Config) -> LoadPlan:
    """How loads are drawn, from the configuration."""
    loads = config.loads
    return LoadPlan(
        kind=loads.kind,
        modes=loads.modes,
        zones=loads.zones,
        patches=loads.patches,
        radius=loads.radius,
        displacement=loads.displacement,
        amplitude=loads.amplitude or None,
        sequence=loads.sequence,
        smoothness=loads.smoothness,
    )


def plan_entries(config: Config) -> dict[str, Any]:
    """What the data set is to be made of, in the words of a data set's header."""
    samples = config.samples
    loads = {**vars(load_plan(config)), "zones": list(config.loads.zones), "radius": list(config.loads.radius)}
    if loads["sequence"] == "random":
        del loads["sequence"]  # as in a data set's header
    if not samples.smooth:
        del loads["smoothness"]
    springs = {name: _plain(each) for name, each in config.supports.items()}
    return {
        **{word: getattr(config.material, name) for name, word in _MATERIAL.items()},
        "loads": loads,
        "samples": {
            **{"train": samples.train, "validation": samples.validation, "test": samples.test},
            **({"calibration": samples.calibration} if samples.calibration else {}),
            **({"active": samples.rounds * samples.chosen} if samples.rounds else {}),
            **({"smooth": samples.smooth} if samples.smooth else {}),
        },
        "block": samples.block,
        "ramp": samples.load_path,
        "seed": samples.seed,
        "newton": config.solver.model_dump(),
        **({"springs": springs} if springs else {}),
    }


def _plain(each: Support) -> dict[str, Any]:
    """Springs in the words of a data set's header, which is JSON."""
    return dict(json.loads(json.dumps(asdict(each))))


def mesh_inputs(space: Workspace) -> dict[str, Any]:
    """Entries of [body]; one that names a file stands as the hash of its content."""
    every = _flat("body", space.config.body.model_dump())
    read = {name: _content(value, space.root) for name, value in every if _LATER.get(name, ...) != value}
    source = parse_file(space.config.body.source)
    read |= {f"springs.{name}": _content(value, space.root) for name, value in space.config.springs.where.items()}
    folder = space.root / source.path
    if folder.is_dir() and is_segmentation(folder):
        read["body.source"] = {path.name: f"sha256:{_sha256(path)}" for path in structure_files(folder)}
        read["body.source axes"] = source.axes
    return read


def generate_inputs(space: Workspace, body: Body) -> dict[str, Any]:
    """Material, loads, samples and solver, and the fingerprint of the body."""
    return {"body": body.fingerprint, **dict(_flat("plan", plan_entries(space.config)))}


def train_inputs(space: Workspace, data: DataSet) -> dict[str, Any]:
    """Entries of [training], the body's file and the identity of the data set."""
    every = _flat("training", space.config.training.model_dump())
    training = {name: value for name, value in every if _LATER.get(name, ...) != value}
    training |= {"jacobians": mark(data)} if mark(data) else {}
    return {"body.vtu": _sha256(space.body), "data set": data.identity, **training}


def model_error_inputs(space: Workspace, data: DataSet) -> dict[str, Any]:
    """Entries of [model_error] and the identity of the data set."""
    return {"data set": data.identity, **dict(_flat("model_error", space.config.model_error.model_dump()))}


def validate_inputs(space: Workspace, data: DataSet) -> dict[str, Any]:
    """The twin's weights and the identity of the data set."""
    return {"weights": _sha256(space.twin / "surrogate.safetensors"), "data set": data.identity}


def changes(space: Workspace, stage: str, now: Mapping[str, Any]) -> list[str] | None:
    """What a finished stage would read otherwise today, a few words each; None where it left no record.

    Args:
        space: the workspace.
        stage: its name.
        now: what it would read.
    """
    record = read_records(space.folder).get(stage)
    if record is None or not record.get("read"):
        return None
    then = record["read"]
    names = [*now, *(name for name in then if name not in now)]
    return [
        f"{name} ({_shown(then.get(name))} then, {_shown(now.get(name))} now)"
        for name in names
        if then.get(name) != json.loads(json.dumps(now.get(name)))
    ]


def is_meshed(space: Workspace) -> bool:
    """Whether the body is there, made from what the configuration says today."""
    return space.body.exists() and changes(space, "mesh", mesh_inputs(space)) == []


def set_aside(space: Workspace) -> None:
    """Copy the body under a name by its content, so that no later copy takes its place."""
    shutil.copy2(space.body, space.body.with_suffix(f".{_sha256(space.body)[:8]}.vtu"))


def current_body(space: Workspace) -> Body:
    """The meshed body, if it is the one that the configuration describes.

    Raises:
        ConfigError: there is none, or [body] or a file that it names has changed since.
    """
    if not space.body.exists():
        raise ConfigError(f"expected the body in {space.body}, found none; run `softtwin mesh` first.")
    changed = changes(space, "mesh", mesh_inputs(space))
    if changed:
        raise ConfigError(
            f"{space.body} was made from something else: {'; '.join(changed)}. Run `softtwin mesh` again."
        )
    return read_body(space.body)


def current_data(space: Workspace) -> tuple[DataSet, Body]:
    """The data set and the body, if they belong together and to the configuration.

    Raises:
        DataSetError: no data set, or one of another body, material, load or seed.
        ConfigError: see `current_body`.
    """
    data = DataSet(space.data)
    body = current_body(space)
    found = differences(data, body, plan_entries(space.config))
    if found:
        raise DataSetError(
            f"{space.data} is not of this mesh and configuration: {'; '.join(found)}. Put back what it was made "
            "with, or make it anew (`softtwin generate --again`)."
        )
    return data, body


def solved_data(space: Workspace) -> DataSet | None:
    """The data set if any of its equilibria were solved, whether or not they are still wanted.

    Raises:
        DataSetError: it cannot be read, though blocks of it were solved.
    """
    data = existing(space.data)
    return data if data is not None and len(data.missing_blocks()) < data.block_count else None


def check_trained(space: Workspace, data: DataSet, card: Mapping[str, Any]) -> None:
    """Refuse a twin that was trained otherwise than the configuration says, or on other data.

    Args:
        space: the workspace.
        data: its data set.
        card: the twin's, which answers for its data where the stage left no record.

    Raises:
        ConfigError: what has changed since.
    """
    changed = changes(space, "train", train_inputs(space, data))
    if changed is None:
        learned = card.get("data", {}).get("identity", data.identity)
        changed = (
            [] if learned == data.identity else [f"data set ({learned[:12]}... then, {data.identity[:12]}... now)"]
        )
    if changed:
        raise ConfigError(
            f"{space.twin} was trained on something else: {'; '.join(changed)}. Run `softtwin train` again."
        )


def check_material(twin: Path, config: Config) -> None:
    """Refuse a twin whose configuration names another material than its surrogate has learned.

    Args:
        twin: its folder; one without a surrogate has nothing that could differ.
        config: the configuration in it.

    Raises:
        ConfigError: the entries that differ.
    """
    try:
        learned = json.loads((twin / "surrogate.json").read_text())["data"]["plan"]
        springs = {name: _plain(each) for name, each in config.supports.items()}
        wrong = [] if learned.get("springs", {}) == springs else ["springs"]
        wrong += [
            f"material.{name} ({learned[word]} learned, {getattr(config.material, name)} in organ.toml)"
            for name, word in _MATERIAL.items()
            if word in learned and learned[word] != getattr(config.material, name)
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return  # opening the surrogate says what is wrong with its card
    if wrong:
        raise ConfigError(
            f"{twin}: organ.toml was changed after the twin was made: {'; '.join(wrong)}. Put it back, or build "
            "another twin."
        )


def _flat(prefix: str, entries: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in entries.items():
        if isinstance(value, Mapping):
            yield from _flat(f"{prefix}.{name}", value)
        else:
            yield f"{prefix}.{name}", value


def _content(value: Any, root: Path) -> Any:
    if isinstance(value, str) and value:
        named = parse_file(value)  # its unit and axes may stand behind it, or words may stand there instead
        if (root / named.path).is_file():
            behind = "".join(f":{word}" for word in (named.unit, named.axes) if word)
            return f"sha256:{_sha256(root / named.path)}{behind}"
    return [_content(item, root) for item in value] if isinstance(value, list | tuple) else value


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _shown(value: Any) -> str:
    if value is None:
        return "nothing"
    text = str(value)
    if text.startswith("sha256:"):
        return ":".join(["sha256", f"{text[7:19]}...", *text.split(":")[2:]])
    return text if len(text) <= 60 else f"{text[:12]}..."
