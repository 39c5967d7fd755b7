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
from .dataset import NEEDED, SPLITS, DataSet, DataSetError, checksum
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
        DataSetError: a tensors file already; blocks of the data set, or of its Jacobians where they are wanted, are
            missing or damaged.
    """
    target = Path(path)
    if not is_tensors(target):
        raise ValueError(f"export_tensors.path: expected a name that ends in .safetensors, got {target.name}.")
    if precision not in get_args(Precision):
        raise ValueError(f"export_tensors.precision: expected one of {get_args(Precision)}, got {precision!r}.")
    if is_tensors(data.path):
        raise DataSetError(
            f"export_tensors.data: expected the folder of a Zarr store, got the tensors file {data.path}."
        )
    for split in SPLITS:
        if split in NEEDED or data.header["samples"].get(split):
            data.check_complete(split)
    real = np.dtype(np.float32 if precision == "single" else np.float64)
    root = data.root
    arrays = {name: root[name][:] for name in _names(root)}  # the body as it is: its fingerprint is of these bytes
    arrays |= {name: _rounded(arrays[name], real) for name in arrays if name.startswith("response/")}
    checksums = {name: zlib.crc32(values.tobytes()) for name, values in arrays.items()}
    arrays |= _samples(root["samples"], data.header["block"], real)
    if "active" in root:
        arrays["active/ramps"] = root["active/ramps"][:]
    header = {**data.header, "checksums": checksums, "tensors": {"precision": precision, "made_from": data.identity}}
    attributes: dict[str, dict[str, Any]] = {"": {"header": json.dumps(header)}}
    if jacobians and "jacobians" in root:
        missing = missing_jacobians(data)
        if missing:
            raise DataSetError(
                f"export_tensors.data: expected the Jacobians of all training samples in {data.path}, got none in "
                f"{len(missing)} blocks; run `softtwin generate` again, or leave them out (`--no-jacobians`)."
            )
        group = root["jacobians"]
        arrays |= {f"jacobians/{name}": group[name][:] for name in ("modes", "values", "squares", "checksum")}
        attributes["jacobians"] = {"checksum": int(group.attrs["checksum"])}
    write_tensors(target, arrays, attributes)
    return target


def _names(group: Any, prefix: str = "") -> Iterator[str]:
    """Whole names of the arrays that no block holds: body, response and modes."""
    for name, one in group.members():
        if prefix or name in ("body", "response", "modes"):
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
