"""A data set from one's own simulator: forces and displacements in arrays, no FEniCSx."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import NEEDED, SPLITS, DataSet, DataSetError, LinearResponse, Split
from softtwin.reference.data.materials import MATERIALS, Material
from softtwin.reference.data.schema import Reason, Sizes
from softtwin.reference.data.writing import create, write_block

from .residual import ElasticBody

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
LengthUnit = Literal["m", "cm", "mm"]
ForceUnit = Literal["N", "mN", "kN"]

_METRES: dict[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_NEWTONS: dict[str, float] = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
_BLOCK = 16
_ROUND_OFF = 1e-6  # relative: displacements of fixed nodes and forces on them may be so large
_LARGEST = 2.0  # body sizes: a larger displacement is one in another unit
_ROUGHEST, _SHUFFLES = 0.85, 5  # neighbours that differ as shuffled nodes do are no neighbours
_MOST_ROUGH = 200  # samples whose smoothness is looked at
_SMALLEST_PART = 1e-3  # of the leading singular value, in the linear map that is fitted


def data_set_from_arrays(
    path: Path | str,
    body: Body,
    forces: ArrayLike,
    displacements: ArrayLike,
    *,
    length_unit: LengthUnit | None = None,
    force_unit: ForceUnit | None = None,
    material: Material | None = None,
    splits: Mapping[str, ArrayLike] | None = None,
    seed: int = 0,
    source: str = "own simulator",
) -> DataSet:
    """A data set that any surrogate learns from.

    It holds no gradients, so that nothing is learned from or judged by them. Its linear response is that of the
    material at rest, if one is given; else the linear map that fits the training samples best, each relative to its
    own size.

    Args:
        path: folder to make.
        body: what was simulated; its node order is that of the arrays.
        forces: nodal forces of each sample, (s, n, 3).
        displacements: equilibria, (s, n, 3).
        length_unit: of the displacements; the body is in metres in any case. It must be said, since no array shows it.
        force_unit: of the forces; likewise.
        material: strain energy, if it is one of this package with constant parameters; losses that know physics
            need it.
        splits: numbers of the samples of `train`, `validation` and `test`: samples of one motion belong into one of
            them. A tenth, drawn at random, for validation and test each if not given.
        seed: of that draw.
        source: what made the samples, for the record.

    Raises:
        ValueError: shapes, units or node order that cannot be right; NaN; forces on fixed nodes; fixed nodes that move;
            too few samples; splits that overlap or are not all there.
        DataSetError: there is something at the path.
    """
    if Path(path).exists():
        raise DataSetError(f"data_set_from_arrays.path: expected a folder that is not there yet, got {path}.")
    given = (_fields("forces", forces, body), _fields("displacements", displacements, body))
    if len(given[0]) != len(given[1]):
        raise ValueError(
            f"data_set_from_arrays: expected as many forces as displacements, got {len(given[0])} and {len(given[1])}."
        )
    b, u = _scale("force_unit", _NEWTONS, force_unit) * given[0], _scale("length_unit", _METRES, length_unit) * given[1]
    _check_physics(body, b, u)
    plan = {"source": source, "seed": seed, **_entries(material)}
    chosen = _splits(splits, len(b), seed)
    loaded = np.flatnonzero(np.abs(b).max(axis=(0, 2)) > 0.0)
    train = chosen["train"]
    response = _response(body, loaded, material) if material else _fitted(body, loaded, b[train], u[train])
    header: dict[str, Any] = {
        "block": _BLOCK,
        "samples": {split: len(numbers) for split, numbers in chosen.items()},
        "plan": plan,
        "versions": {"numpy": np.__version__},
        "gradients": False,
    }
    shapes = np.zeros((1, *body.points.shape))  # no modes: one that does nothing
    data = create(Path(path), header, body, response, shapes, np.zeros(1))
    for split in chosen:
        first = data.split_draws(split).start
        for i in range(0, len(chosen[split]), _BLOCK):
            some = chosen[split][i : i + _BLOCK]
            write_block(Path(path), (first + i) // _BLOCK, _block(data.sizes, loaded, b[some], u[some]))
    return data


def _fields(name: str, values: ArrayLike, body: Body) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 3 or array.shape[1:] != body.points.shape or len(array) == 0:
        nodes = len(body.points)
        raise ValueError(f"data_set_from_arrays.{name}: expected shape (s, {nodes}, 3) with s >= 1, got {array.shape}.")
    wrong = int((~np.isfinite(array).all(axis=(1, 2))).sum())
    if wrong:
        raise ValueError(f"data_set_from_arrays.{name}: expected finite numbers, got {wrong} samples with others.")
    return array


def _scale(name: str, known: Mapping[str, float], unit: str | None) -> float:
    if unit is None:
        raise ValueError(
            f"data_set_from_arrays.{name}: expected one of {', '.join(known)}, got none; arrays show none."
        )
    if unit not in known:
        raise ValueError(f"data_set_from_arrays.{name}: expected one of {', '.join(known)}, got {unit!r}.")
    return known[unit]


def _check_physics(body: Body, forces: Floats, displacements: Floats) -> None:
    """Refuse what no simulation of this body in these units gives."""
    largest = float(np.linalg.norm(displacements, axis=2).max())
    if largest > _LARGEST * body.size:
        raise ValueError(
            f"data_set_from_arrays.length_unit: expected displacements of the order of the body's size, "
            f"{body.size:.3g} m, got up to {largest:.3g} m; are they in another unit?"
        )
    if not largest > 0.0 or not np.abs(forces).max() > 0.0:
        raise ValueError("data_set_from_arrays: expected forces and displacements, got zeros alone.")
    moved = np.linalg.norm(displacements[:, body.fixed], axis=2)
    if moved.size and moved.max() > _ROUND_OFF * largest:
        raise ValueError(
            f"data_set_from_arrays.displacements: expected fixed nodes at rest, got up to {moved.max():.3g} m at "
            f"{int((moved.max(axis=0) > _ROUND_OFF * largest).sum())} of {len(body.fixed)}; is the node order that of "
            "the body, and its attachment that of the simulation?"
        )
    held = np.linalg.norm(forces[:, body.fixed], axis=2)
    if held.size and held.max() > _ROUND_OFF * np.linalg.norm(forces, axis=2).max():
        raise ValueError(
            f"data_set_from_arrays.forces: expected none on fixed nodes, got up to {held.max():.3g} N; reactions are "
            "not part of the load, set them to zero."
        )
    rough = _roughness(body, displacements)
    if rough > _ROUGHEST:
        raise ValueError(
            f"data_set_from_arrays.displacements: expected neighbours that move alike, got nodes of one cell that "
            f"differ {rough:.2f} times as much as if they were shuffled; the node order is not that of the body."
        )


def _roughness(body: Body, displacements: Floats) -> float:
    """Difference of nodes of one cell relative to that after free nodes were shuffled, root mean squares."""
    ends = np.stack([body.corner_cells, np.roll(body.corner_cells, 1, axis=1)]).reshape(2, -1)
    some = displacements[:: max(1, len(displacements) // _MOST_ROUGH)]

    def differing(order: Ints) -> float:
        return float(np.mean([((u[order[ends[0]]] - u[order[ends[1]]]) ** 2).sum(axis=1).mean() for u in some]))

    shuffled = []
    for seed in range(_SHUFFLES):
        order = np.arange(len(body.points))
        order[body.free] = np.random.default_rng(seed).permutation(body.free)
        shuffled.append(differing(order))
    return float(np.sqrt(differing(np.arange(len(body.points))) / np.mean(shuffled)))


def _splits(splits: Mapping[str, ArrayLike] | None, count: int, seed: int) -> dict[Split, Ints]:
    """Sample numbers of each split.

    Raises:
        ValueError: another set of names, numbers out of range or twice, an empty split.
    """
    if splits is None:
        order, held = np.random.default_rng(seed).permutation(count), max(1, count // 10)
        splits = {"train": order[2 * held :], "validation": order[:held], "test": order[held : 2 * held]}
    if set(splits) - {"calibration"} != set(NEEDED):
        raise ValueError(
            f"data_set_from_arrays.splits: expected {', '.join(NEEDED)} (and calibration for bounds on errors), got "
            f"{', '.join(splits)}."
        )
    chosen: dict[Split, Ints] = {
        name: np.asarray(splits[name], dtype=np.int64).ravel() for name in SPLITS if name in splits
    }
    every = np.concatenate(list(chosen.values()))
    if min(map(len, chosen.values())) == 0:
        raise ValueError(f"data_set_from_arrays.splits: expected samples in each split, got too few: {count} in all.")
    if len(np.unique(every)) < len(every) or every.min() < 0 or every.max() >= count:
        raise ValueError(f"data_set_from_arrays.splits: expected numbers in 0..{count - 1}, each at most once.")
    return chosen


def _entries(material: Material | None) -> dict[str, Any]:
    """What a data set's header says of the material.

    Raises:
        ValueError: one that it has no words for.
    """
    if material is None:
        return {}
    names = [name for name, kind in MATERIALS.items() if type(material) is kind]
    if not names or any(np.ndim(value) for value in material.parameters.values()):
        raise ValueError(
            f"data_set_from_arrays.material: expected one of {', '.join(MATERIALS)} with constant parameters, "
            f"got {material!r}."
        )
    return {"material": names[0], **{name: float(value) for name, value in material.parameters.items()}}


def _response(body: Body, loaded: Ints, material: Material) -> LinearResponse:
    """K(0)^-1 for forces at the loaded nodes."""
    stiffness = ElasticBody(body, material).stiffness(torch.zeros(body.points.shape, dtype=torch.float64))
    free = (3 * body.free[:, None] + np.arange(3)).ravel()
    entries = (3 * loaded[:, None] + np.arange(3)).ravel()
    right = np.zeros((body.points.size, len(entries)))
    right[entries, np.arange(len(entries))] = 1.0
    columns = np.zeros_like(right)
    columns[free] = splu(stiffness[free][:, free].tocsc()).solve(right[free])
    return LinearResponse(loaded, columns, np.eye(len(entries)))


def _fitted(body: Body, loaded: Ints, forces: Floats, displacements: Floats) -> LinearResponse:
    """The linear map of least squares from forces to displacements, each sample relative to its own size."""
    moved = displacements.reshape(len(displacements), -1)
    sizes = np.linalg.norm(moved, axis=1)
    weights = 1.0 / np.maximum(sizes, _SMALLEST_PART * sizes.max())
    given = weights[:, None] * forces[:, loaded].reshape(len(forces), -1)
    left, values, right = np.linalg.svd(given, full_matrices=False)
    kept = values > _SMALLEST_PART * values[0]
    to_coordinates = right[kept] / values[kept, None]
    return LinearResponse(loaded, (weights[:, None] * moved).T @ left[:, kept], to_coordinates)


def _block(sizes: Sizes, loaded: Ints, forces: Floats, displacements: Floats) -> dict[str, NDArray[Any]]:
    """A block of the samples, filled up with draws that count as not there."""
    rows = []
    for b, u in zip(forces, displacements, strict=True):
        row = sizes.failed()
        rows.append({**row, "forces": b[loaded], "displacements": u, "reason": np.uint8(Reason.ACCEPTED)})
    rows += [sizes.failed() for _ in range(_BLOCK - len(rows))]
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
