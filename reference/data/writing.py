"""Writing data sets: an empty one, its blocks, what active rounds chose (Zarr 3; no FEniCSx here)."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from softtwin.meshes.body import Body

from . import schema
from .dataset import FORMAT, SKIN, SPLITS, DataSet, DataSetError, Floats, Ints, LinearResponse, checksum, stored_plan


def create(
    path: Path, header: dict[str, Any], body: Body, response: LinearResponse, shapes: Floats, eigenvalues: Floats
) -> DataSet:
    """Make an empty data set.

    Args:
        path: folder to make.
        header: configuration, seed, versions; must hold `block` and `samples` with the count of each split.
        body: the body.
        response: its linear response.
        shapes: mode shapes, (k, n, 3).
        eigenvalues: of the modes, (k,), N/m.
    """
    names = {
        "sets": sorted(body.node_sets),
        "surfaces": sorted(body.surfaces),
        "inner": sorted(body.inner),
        "fractions": body.fractions is not None,
        "skin": body.skin is not None,
        "fingerprint": body.fingerprint,
    }
    root = zarr.create_group(str(path), zarr_format=3, overwrite=True)
    arrays = {"body/points": body.points, "body/cells": body.cells}
    arrays |= {} if body.fractions is None else {"body/fractions": body.fractions}
    arrays |= {} if body.skin is None else {f"body/skin/{part}": getattr(body.skin, part) for part in SKIN}
    arrays |= {f"body/sets/{name}": nodes for name, nodes in body.node_sets.items()}
    arrays |= {f"body/surfaces/{name}": triangles for name, triangles in body.surfaces.items()}
    for name, surface in body.inner.items():
        arrays |= {f"body/inner/{name}/points": surface.points, f"body/inner/{name}/triangles": surface.triangles}
    arrays |= {"response/loaded": response.loaded, "response/left": response.left, "response/right": response.right}
    arrays |= {"modes/shapes": shapes, "modes/eigenvalues": eigenvalues}
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    for name, values in arrays.items():
        root.create_array(name, data=values)
    checksums = {name: zlib.crc32(values.tobytes()) for name, values in arrays.items()}
    _create_samples(root, header, schema.Sizes(len(response.loaded), len(body.points), len(shapes)))
    # The header comes last: a data set without one was never finished being made.
    root.attrs["header"] = json.dumps({**header, "format": FORMAT, "body": names, "checksums": checksums})
    return DataSet(path)


def _create_samples(root: zarr.Group, header: dict[str, Any], sizes: schema.Sizes) -> None:
    block = header["block"]
    blocks = sum(-(-header["samples"].get(split, 0) // block) for split in SPLITS)
    for name in schema.NAMES:
        shape, kind = sizes.shape(name), schema.kind(name)
        root.create_array(
            f"samples/{name}", shape=(blocks * block, *shape), chunks=(block, *shape), dtype=kind, fill_value=0
        )
    root.create_array("samples/checksum", shape=(blocks,), chunks=(1,), dtype="u4", fill_value=0)
    if header["samples"].get("active"):
        ramps = header["samples"]["active"] // stored_plan(header).get("ramp", 1)
        root.create_array("active/ramps", shape=(ramps,), dtype="i8", fill_value=-1)


def write_block(path: Path, block: int, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write one block; its checksum comes last, so that a block cut short counts as missing.

    Args:
        path: folder of the data set.
        block: number of the block.
        arrays: one entry for every array of a block, first axis the block size.
    """
    group = zarr.open_group(str(path), mode="r+")["samples"]
    size = len(arrays["reason"])
    part = slice(block * size, (block + 1) * size)
    typed = {name: np.asarray(arrays[name], dtype=schema.kind(name)) for name in schema.NAMES}
    for name, values in typed.items():
        group[name][part] = values
    group["checksum"][block] = checksum(typed)


def write_chosen(path: Path, first: int, ramps: Ints) -> None:
    """Say which candidates the next active draws are.

    Args:
        path: folder of the data set.
        first: place of the first of them among the active ramps.
        ramps: numbers of the candidates.

    Raises:
        DataSetError: some of these places are not there, or taken.
    """
    places = slice(first, first + len(ramps))
    taken = DataSet(path).chosen[places]
    if len(taken) < len(ramps) or (taken >= 0).any():
        raise DataSetError(
            f"write_chosen.first: expected {len(ramps)} free places from {first} in {path}, got {(taken < 0).sum()}."
        )
    zarr.open_group(str(path), mode="r+")["active/ramps"][places] = ramps


def record_engine(path: Path, entry: Mapping[str, Any]) -> None:
    """Write down that blocks were solved by something else than the reference, and how well that agrees with it.

    Args:
        path: folder of the data set.
        entry: what solved them, of which version, how many draws, and the agreement.
    """
    root = zarr.open_group(str(path), mode="r+")
    root.attrs["engines"] = json.dumps([*DataSet(path).engines, dict(entry)])


def drop_block(path: Path, block: int) -> None:
    """Mark a block as missing, so that it is made again.

    Raises:
        DataSetError: no data set there, or none of its blocks has this number.
    """
    count = DataSet(path).block_count
    if not 0 <= block < count:
        raise DataSetError(f"drop_block.block: expected a number in 0..{count - 1}, got {block}.")
    zarr.open_group(str(path), mode="r+")["samples/checksum"][block] = 0
