"""Data sets and networks that benchmarks make once, under benchmarks/runs/, and use again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from softtwin.app.chain import prepare
from softtwin.app.config import Config
from softtwin.app.launch import generate_in_parallel
from softtwin.app.stages.mesh import mesh_stage
from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import CARD, load, save


def beam_data(folder: Path, entries: Mapping[str, Any], ranks: int) -> DataSet:
    """Equilibria of the thesis's beam by the entries of an organ.toml; goes on where it was stopped."""
    space = prepare(Config.model_validate({"folder": ".", "body": {"source": "beam"}, **entries}), folder)
    mesh_stage(space)
    generate_in_parallel(folder / "organ.toml", ranks)
    return DataSet(space.data)


def network(folder: Path, body: Body, learn: Callable[[], Surrogate]) -> Surrogate:
    """A network, trained where it is not there."""
    if not (folder / CARD).exists():
        save(learn(), folder)
    return load(folder, body)
