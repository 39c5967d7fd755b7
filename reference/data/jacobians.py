"""Derivatives of the training equilibria in reduced coordinates, stored with the data set that they belong to."""

from __future__ import annotations

import hashlib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .dataset import DataSet, DataSetError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_GROUP = "jacobians"


@dataclass(frozen=True, eq=False)
class Jacobians:
    """d(V^T u) / d(V^T b) of training samples: V^T K(u)^-1 V with the modes V taken at the loaded nodes on one side.

    Source: the reduced Jacobians of O'Leary-Roseberry et al. 2022, arXiv 2206.10745, whose two bases are one here.

    Args:
        modes: V, orthonormal, (3n, r).
        values: (P V)^T K(u)^-1 V with P the restriction to the loaded nodes, (s, r, r), m/N.
        squares: squared Frobenius norms of P K(u)^-1 V, (s,), (m/N)^2.
    """

    modes: Floats
    values: NDArray[np.float32]
    squares: Floats


def stored_modes(data: DataSet) -> Floats | None:
    """The modes that a data set has Jacobians for, finished or not, (3n, r); None where it has none.

    Raises:
        DataSetError: they are damaged.
    """
    group = _group(data)
    if group is None:
        return None
    modes = _read(data.path, group, "modes", slice(None))
    if zlib.crc32(modes.tobytes()) != group.attrs["checksum"]:
        raise DataSetError(f"Jacobians: the modes in {data.path} do not match their checksum; {_AGAIN}")
    return modes


def read_jacobians(data: DataSet, draws: Ints) -> Jacobians | None:
    """The Jacobians of training samples; None where the data set has none.

    Args:
        data: the data set.
        draws: numbers of the samples' draws, (s,).

    Raises:
        DataSetError: some of them were never finished, are damaged, or hold numbers that are not finite.
    """
    modes, group = stored_modes(data), _group(data)
    if modes is None or group is None:
        return None
    size = data.header["block"]
    wanted = np.unique(np.asarray(draws) // size).tolist()
    for block in wanted:
        state = _state(data.path, group, block, size)
        if state:
            raise DataSetError(f"Jacobians: block {block} in {data.path} {state}; {_AGAIN}")
    part = slice(0, int(np.max(draws)) + 1)
    values, squares = (_read(data.path, group, name, part)[draws] for name in ("values", "squares"))
    wrong = int((~(np.isfinite(values).all(axis=(1, 2)) & np.isfinite(squares))).sum())
    if wrong or not np.isfinite(modes).all():
        raise DataSetError(
            f"Jacobians: expected finite numbers in {data.path}, got {wrong} of {len(values)} samples with others, or "
            "such modes; solve the data set again (`softtwin generate --again`), or learn without them (sobolev = 0)."
        )
    return Jacobians(modes, values, squares)


def missing_jacobians(data: DataSet) -> list[int]:
    """Numbers of the blocks whose Jacobians are still to be made, or again; all where there are none."""
    group = _group(data)
    blocks = _blocks(data)
    return [block for block in blocks if group is None or _state(data.path, group, block, data.header["block"])]


def mark(data: DataSet) -> str:
    """SHA-256 of the checksums of all Jacobians, empty where there are none: another one, others to learn from."""
    group = _group(data)
    if group is None:
        return ""
    return hashlib.sha256(f"{group.attrs['checksum']} {group['checksum'][:].tolist()}".encode()).hexdigest()


def prepare_jacobians(data: DataSet, modes: Floats) -> list[int]:
    """Make room for the Jacobians by some modes, in place of others; returns the blocks that are still to be made.

    Args:
        data: the data set.
        modes: V, (3n, r).
    """
    size, blocks = data.header["block"], _blocks(data)
    group = _group(data)
    if group is None or not _are(data, modes):
        root = _writable(data.path)
        group, rank = root.create_group(_GROUP, overwrite=True), modes.shape[1]
        group.create_array("modes", data=np.ascontiguousarray(modes))
        places = blocks[-1] + 1  # those of blocks that are not learned from stay empty
        shape, chunks = (places * size, rank, rank), (size, rank, rank)
        group.create_array("values", shape=shape, chunks=chunks, dtype="f4", fill_value=0)
        group.create_array("squares", shape=shape[:1], chunks=chunks[:1], dtype="f8", fill_value=0)
        group.create_array("checksum", shape=(places,), chunks=(1,), dtype="u4", fill_value=0)
        group.attrs["checksum"] = zlib.crc32(np.ascontiguousarray(modes).tobytes())  # comes last: without it none
    return [block for block in blocks if _state(data.path, group, block, size)]


def write_jacobians(path: Path, block: int, values: Floats, squares: Floats) -> None:
    """Write one block; its checksum comes last, so that a block cut short counts as missing.

    Args:
        path: folder of the data set.
        block: number of the block.
        values: (block size, r, r), m/N; zero for draws that were not accepted.
        squares: (block size,), (m/N)^2.
    """
    group = _writable(path)[_GROUP]
    part = slice(block * len(squares), (block + 1) * len(squares))
    typed = np.asarray(values, dtype=np.float32), np.asarray(squares, dtype=np.float64)
    group["values"][part], group["squares"][part] = typed
    group["checksum"][block] = _checksum(*typed)


_AGAIN = "run `softtwin generate` again with samples.jacobians = true, it makes what is missing."


def _blocks(data: DataSet) -> list[int]:
    """Numbers of the blocks that are learned from."""
    size = data.header["block"]
    return [block for draws in data.ranges("train") for block in range(draws.start // size, -(-draws.stop // size))]


def _writable(path: Path) -> Any:
    import zarr  # here: who only reads Jacobians from a tensors file needs none of it

    return zarr.open_group(str(path), mode="r+")


def _group(data: DataSet) -> Any:
    root = data.root  # opened anew where it is a folder: another may have written meanwhile
    return root[_GROUP] if _GROUP in root and "checksum" in root[_GROUP].attrs else None


def _are(data: DataSet, modes: Floats) -> bool:
    try:
        stored = stored_modes(data)
    except DataSetError:
        return False
    return stored is not None and np.array_equal(stored, modes)


def _state(path: Path, group: Any, block: int, size: int) -> str:
    """What is wrong with a block, empty for nothing."""
    try:
        stored = int(group["checksum"][block])
        part = slice(block * size, (block + 1) * size)
        found = _checksum(group["values"][part], group["squares"][part]) if stored else 0
    except Exception as error:  # a damaged chunk fails in whichever codec reads it
        return f"is damaged ({type(error).__name__})"
    return "was never finished" if not stored else "" if found == stored else "does not match its checksum"


def _checksum(values: NDArray[np.float32], squares: Floats) -> int:
    first = zlib.crc32(np.ascontiguousarray(values).tobytes())
    return zlib.crc32(np.ascontiguousarray(squares).tobytes(), first) or 1


def _read(path: Path, group: Any, name: str, part: slice) -> Any:
    try:
        return group[name][part]
    except Exception as error:  # in whichever codec reads it
        raise DataSetError(f"Jacobians: {name} in {path} cannot be read ({type(error).__name__}); {_AGAIN}") from error
