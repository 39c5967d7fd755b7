"""A data set as one safetensors file: what training, evaluation and prediction need, to be carried to a GPU."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from . import schema
from .dataset import NEEDED, SPLITS, DataSet, checksum
from .jacobians import missing_jacobians
from .store import is_tensors, write_tensors

Arrays = dict[str, NDArray[Any]]
Precision = Literal["single", "double"]


def export_tensors(data: DataSet, path: Path | str, precision: Precision = "single", jacobians: bool = True) -> Path:
    """Write a data set into one file that `DataSet` reads without Zarr; returns its path.

    Splits, rejected draws, figures and Jacobians come along, each block with a checksum of what is stored.

    Args:
        data: the data set, complete.
        path: of the file, ending in `.safetensors`; one that is there is replaced.
        precision: of samples and response: `single` halves the file and rounds displacements to 6e-8 of themselves.
        jacobians: also those of the training samples, where the data set has them.

    Raises:
        ValueError: another ending, or another precision.
        DataSetError: blocks of the data set are missing or damaged.
    """
    target = Path(path)
    if not is_tensors(target):
        raise ValueError(f"export_tensors.path: expected a name that ends in .safetensors, got {target.name}.")
    if precision not in get_args(Precision):
        raise ValueError(f"export_tensors.precision: expected one of {get_args(Precision)}, got {precision!r}.")
    for split in SPLITS:
        if split in NEEDED or data.header["samples"].get(split):
            data.check_complete(split)
    real = np.dtype(np.float32 if precision == "single" else np.float64)
    root = data.root
    arrays = _fixed(root, list(data.header["checksums"]), real) if data.header.get("checksums") else _stored(root, real)
    arrays |= _samples(root["samples"], data.header["block"], real)
    if "active" in root:
        arrays["active/ramps"] = root["active/ramps"][:]
    checksums = {name: zlib.crc32(values.tobytes()) for name, values in arrays.items() if _is_fixed(name)}
    header = {**data.header, "checksums": checksums, "tensors": {"precision": precision, "made_from": data.identity}}
    attributes: dict[str, dict[str, Any]] = {"": {"header": json.dumps(header)}}
    if jacobians and "jacobians" in root and not missing_jacobians(data):
        group = root["jacobians"]
        arrays |= {f"jacobians/{name}": group[name][:] for name in ("modes", "values", "squares", "checksum")}
        attributes["jacobians"] = {"checksum": int(group.attrs["checksum"])}
    write_tensors(target, arrays, attributes)
    return target


def _is_fixed(name: str) -> bool:
    return name.split("/")[0] in ("body", "response", "modes")


def _fixed(root: Any, names: list[str], real: np.dtype[Any]) -> Arrays:
    """What no block holds. The body stays in double precision: its fingerprint is of these bytes."""
    return {name: _rounded(root[name][:], real) if name.startswith("response/") else root[name][:] for name in names}


def _stored(root: Any, real: np.dtype[Any]) -> Arrays:
    """Likewise of a data set without checksums of them."""
    return _fixed(root, list(_names(root)), real)


def _names(group: Any, prefix: str = "") -> Iterator[str]:
    for name, one in group.members():
        if not prefix and not _is_fixed(name):
            continue
        yield from _names(one, f"{prefix}{name}/") if hasattr(one, "members") else [f"{prefix}{name}"]


def _rounded(values: NDArray[Any], real: np.dtype[Any]) -> NDArray[Any]:
    return values.astype(real) if values.dtype == np.float64 else values


def _samples(group: Any, size: int, real: np.dtype[Any]) -> Arrays:
    """The blocks, rounded, each with its checksum; those that were never made stay so."""
    arrays = {name: group[name][:] for name in schema.NAMES}
    arrays |= {name: _rounded(arrays[name], real) for name in schema.FIELDS}
    made = group["checksum"][:] != 0
    sums = [
        checksum({name: values[block * size : (block + 1) * size] for name, values in arrays.items()}) if there else 0
        for block, there in enumerate(made)
    ]
    return {f"samples/{name}": values for name, values in arrays.items()} | {
        "samples/checksum": np.array(sums, dtype=np.uint32)
    }
