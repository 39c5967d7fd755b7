"""Where the arrays of a data set lie: a Zarr 3 folder, or one safetensors file with what training needs.

The file is read with NumPy and safetensors alone: a machine with a GPU needs no Zarr. Both give groups of arrays
by name (`group["samples"]["reason"][2:5]`, `name in group`, `group.attrs`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

TENSORS = ".safetensors"
_FORMAT, _VERSION = "softtwin tensors", 1


class StoreError(ValueError):
    """Arrays that cannot be read; the message says what is wrong with them."""


class TensorGroup:
    """Arrays in memory under names with slashes, read as a Zarr group is.

    Args:
        arrays: by their whole names (`samples/forces`).
        attributes: of each group that has some, by its name; the root's is the empty one.
        prefix: of the group, with a slash behind; empty for the root.
    """

    def __init__(
        self, arrays: Mapping[str, NDArray[Any]], attributes: Mapping[str, Mapping[str, Any]], prefix: str = ""
    ) -> None:
        self._arrays, self._attributes, self._prefix = arrays, attributes, prefix

    @property
    def attrs(self) -> Mapping[str, Any]:
        """What is said of the group."""
        return self._attributes.get(self._prefix.rstrip("/"), {})

    def __contains__(self, name: str) -> bool:
        return self._prefix + name in self._arrays or any(
            key.startswith(f"{self._prefix}{name}/") for key in self._arrays
        )

    def __getitem__(self, name: str) -> Any:
        """An array, or the group of that name.

        Raises:
            KeyError: there is none.
        """
        if self._prefix + name in self._arrays:
            return self._arrays[self._prefix + name]
        if name not in self:
            raise KeyError(name)
        return TensorGroup(self._arrays, self._attributes, f"{self._prefix}{name}/")


def is_tensors(path: Path) -> bool:
    """Whether a path names a tensors file, and not the folder of a Zarr store."""
    return path.suffix == TENSORS


def open_store(path: Path) -> Any:
    """The root group of a data set, for reading.

    Args:
        path: a tensors file, or the folder of a Zarr store.

    Raises:
        StoreError: a tensors file that is truncated, of another version or no such file.
        ValueError, OSError, KeyError: a Zarr store that cannot be read.
        ModuleNotFoundError: `zarr` is absent: `pip install 'softtwin[data]'`.
    """
    if is_tensors(path):
        return _read_tensors(path)
    try:
        import zarr  # here: a machine that only registers has none of it
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path}: expected the package zarr to read a data set, found none; pip install 'softtwin[data]', or make "
            "it a tensors file with `softtwin tensors` elsewhere."
        ) from error
    return zarr.open_group(str(path), mode="r")


def write_tensors(path: Path, arrays: Mapping[str, NDArray[Any]], attributes: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a tensors file, whole or not at all.

    Args:
        path: of the file, ending in `.safetensors`.
        arrays: by their whole names.
        attributes: of each group that has some, as JSON writes it.
    """
    partial = path.with_name(path.name + ".partial")
    metadata = {"format": _FORMAT, "version": str(_VERSION), "attributes": json.dumps(attributes)}
    save_file({name: np.ascontiguousarray(values) for name, values in arrays.items()}, partial, metadata)
    partial.replace(path)


def _read_tensors(path: Path) -> TensorGroup:
    try:
        with safe_open(path, framework="numpy") as opened:
            metadata: dict[str, str] = opened.metadata() or {}
            arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118  (a handle, no mapping)
    except (SafetensorError, OSError) as error:
        raise StoreError(f"{path} cannot be read ({error}); is it truncated, or no safetensors file?") from error
    if metadata.get("format") != _FORMAT or metadata.get("version") != str(_VERSION):
        raise StoreError(
            f"{path}: expected a file of the format {_FORMAT!r} {_VERSION}, got {metadata.get('format', 'none')!r} "
            f"{metadata.get('version', '')}; make it again with `softtwin tensors`."
        )
    return TensorGroup(arrays, json.loads(metadata["attributes"]))
