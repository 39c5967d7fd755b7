"""Data sets of equilibria: Zarr 3 on disk, one chunk a block of samples, whole or not at all (no FEniCSx here)."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.embedding import outer

from . import schema
from .materials import MATERIALS, Material
from .schema import Reason
from .springs import Support, springs_of
from .store import StoreError, is_tensors, open_store

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Split = Literal["train", "validation", "test", "calibration", "active", "smooth"]
NEEDED: tuple[Split, ...] = ("train", "validation", "test")
# The active draws are learned from with the training's; smooth ones are other loads: see `samplers.draw_smooth_load`.
SPLITS: tuple[Split, ...] = (*NEEDED, "calibration", "active", "smooth")
FORMAT = 1


class DataSetError(ValueError):
    """A data set that cannot be used: missing, truncated, of another format or another body."""


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """The displacement at rest's tangent, K(0)^-1 b, as a product of two matrices.

    Args:
        loaded: nodes that may carry force, (l,).
        left: (3n, r), m.
        right: (r, 3l), 1/N; the identity where the response is kept exactly.
    """

    loaded: Ints
    left: Floats
    right: Floats

    def apply(self, forces: Floats) -> Floats:
        """Linear displacements (s, n, 3) for forces at the loaded nodes (s, l, 3)."""
        flat = forces.reshape(len(forces), -1)
        return (flat @ self.right.T @ self.left.T).reshape(len(forces), -1, 3)

    def spread(self, forces: Floats) -> Floats:
        """Forces at all nodes, (..., n, 3), for those at the loaded nodes, (..., l, 3)."""
        whole = np.zeros((*forces.shape[:-2], len(self.left) // 3, 3))
        whole[..., self.loaded, :] = forces
        return whole


@dataclass(frozen=True, eq=False)
class Samples:
    """Accepted samples of one split.

    Args:
        draws: number of each draw in the data set, (s,).
        forces: at the loaded nodes, (s, l, 3), newtons.
        displacements: (s, n, 3), metres.
        probes: cotangents that the adjoints belong to, as coefficients of the modes, (s, k), dimensionless.
        adjoints: K(u)^-1 g at the loaded nodes for the cotangent g = boundary mask * (Phi probe), (s, l, 3), m/N.
    """

    draws: Ints
    forces: Floats
    displacements: Floats
    probes: Floats
    adjoints: Floats

    def __len__(self) -> int:
        return len(self.draws)


@dataclass(frozen=True, eq=False)
class Rejected:
    """Draws that were not accepted, with what is known of them: number (s,), forces (s, l, 3), reason in words (s,)."""

    draws: Ints
    forces: Floats
    reasons: tuple[str, ...]


class DataSet:
    """A data set opened for reading.

    Args:
        path: folder of the Zarr store, or a tensors file made from one.

    Raises:
        DataSetError: no data set there, or one of another format.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not (self.path if is_tensors(self.path) else self.path / "zarr.json").exists():
            raise DataSetError(
                f"DataSet: expected a Zarr 3 data set or a tensors file in {self.path}, found none; make one with "
                "`softtwin generate`."
            )
        try:
            self._root = open_store(self.path)
            self.header: dict[str, Any] = json.loads(str(self._root.attrs["header"]))
        except StoreError as error:
            raise DataSetError(f"DataSet: {error}") from error
        except (KeyError, ValueError, OSError) as error:
            raise DataSetError(f"DataSet: {self.path} cannot be read ({error}); is the folder truncated?") from error
        if self.header.get("format") != FORMAT:
            raise DataSetError(f"DataSet: expected format {FORMAT}, got {self.header.get('format')} in {self.path}.")

    @cached_property
    def body(self) -> Body:
        """The body that all samples belong to."""
        names = self.header["body"]
        body = Body(
            points=self._array("body/points"),
            cells=self._array("body/cells"),
            node_sets={name: self._array(f"body/sets/{name}") for name in names["sets"]},
            surfaces={name: self._array(f"body/surfaces/{name}") for name in names["surfaces"]},
            inner={
                name: Surface(self._array(f"body/inner/{name}/points"), self._array(f"body/inner/{name}/triangles"))
                for name in names["inner"]
            },
            fractions=self._array("body/fractions") if names.get("fractions") else None,
            skin=Surface(*(self._array(f"body/skin/{part}") for part in SKIN)) if names.get("skin") else None,
        )
        if body.fingerprint != names["fingerprint"]:
            raise DataSetError(
                f"DataSet: the body in {self.path} differs from the one it was made with: {_BEYOND_REPAIR}"
            )
        return body

    @cached_property
    def response(self) -> LinearResponse:
        """The linear response that surrogates add their correction to."""
        return LinearResponse(*(self._array(f"response/{name}") for name in ("loaded", "left", "right")))

    @cached_property
    def shapes(self) -> Floats:
        """Mode shapes, (k, n, 3)."""
        return self._array("modes/shapes")

    @cached_property
    def eigenvalues(self) -> Floats:
        """Eigenvalues of the modes, (k,), N/m."""
        return self._array("modes/eigenvalues")

    @property
    def root(self) -> Any:
        """The root group as it is now, for reading."""
        return self._root if is_tensors(self.path) else open_store(self.path)

    @property
    def sizes(self) -> schema.Sizes:
        """What the shape of a sample depends on."""
        return schema.Sizes(len(self.response.loaded), len(self.body.points), len(self.shapes))

    @property
    def has_gradients(self) -> bool:
        """Whether the adjoints of samples are those of a solver: those of data from elsewhere are zeros."""
        return bool(self.header.get("gradients", True))

    @property
    def material(self) -> Material:
        """Strain energy of the equilibria.

        Raises:
            DataSetError: the header does not say.
        """
        plan = self.header.get("plan", {})
        try:
            return MATERIALS[plan["material"]](plan["young_modulus"], plan["poisson_ratio"])
        except KeyError as error:
            raise DataSetError(f"DataSet: expected a known material in the header of {self.path}, got none.") from error

    @property
    def springs(self) -> dict[str, Support]:
        """That hold the body beside its fixed nodes, by the surface that they hold."""
        return springs_of(self.header.get("plan", {}))

    @property
    def identity(self) -> str:
        """SHA-256 of the header and of the checksums of all blocks: another one, other samples."""
        digest = hashlib.sha256(json.dumps(self.header, sort_keys=True).encode())
        digest.update(np.asarray(self._checksums(), dtype=np.int64).tobytes())
        return digest.hexdigest()

    @property
    def engines(self) -> list[dict[str, Any]]:
        """What solved draws beside the reference, run by run, and how well it agrees with that; none if nothing did."""
        found: list[dict[str, Any]] = json.loads(str(self._root.attrs.get("engines", "[]")))
        return found

    @property
    def block_count(self) -> int:
        """Number of blocks when complete."""
        return int(self._root["samples/checksum"].shape[0])

    def missing_blocks(self) -> list[int]:
        """Numbers of the blocks that are still to be made."""
        return np.flatnonzero(np.asarray(self._checksums()) == 0).tolist()

    def damaged_blocks(self, among: Collection[int] | None = None) -> dict[int, str]:
        """Numbers of the blocks that are there but not as they were written, and what is wrong with each; reads all.

        Args:
            among: look at these alone.
        """
        stored = self._checksums()
        looked_at = range(len(stored)) if among is None else among
        found = {block: self._damage(block, stored[block]) for block in looked_at if stored[block] != 0}
        return {block: damage for block, damage in found.items() if damage}

    def split_draws(self, split: Split) -> range:
        """Numbers of the draws of a split; splits share no block."""
        first = 0
        for name in SPLITS:
            count = self.header["samples"].get(name, 0)
            if name == split:
                return range(first, first + count)
            first += -(-count // self.header["block"]) * self.header["block"]
        raise DataSetError(f"DataSet.split: expected one of {SPLITS}, got {split!r}.")

    def ranges(self, split: Split, limit: int | None = None) -> list[range]:
        """Numbers of a split's draws as they are read: behind the training draws come those of active rounds.

        Args:
            split: name of the split.
            limit: the first so many draws only.
        """
        first = self.split_draws(split)[:limit]
        if split != "train":
            return [first]
        return [first, self.split_draws("active")[: None if limit is None else limit - len(first)]]

    def load_paths(self, split: Split, draws: Ints) -> Ints:
        """Number of the load path of each of some draws, (s,): draws of one `ramp` share one, draws of two sets none.

        Args:
            split: that they are of.
            draws: their numbers, (s,).
        """
        every = np.concatenate([np.asarray(each, dtype=np.int64) for each in self.ranges(split)])
        return _path_numbers(self.header, split)[np.searchsorted(every, draws)]

    def samples(self, split: Split, limit: int | None = None) -> Samples:
        """The accepted samples of a split, checked against their checksums.

        Args:
            split: `train` (with the draws of active rounds behind), `validation`, `test`, `calibration`, `active` or
                `smooth`.
            limit: take the first so many draws only.

        Raises:
            DataSetError: blocks are missing or damaged.
        """
        ranges = self.ranges(split, limit)
        for draws in ranges:
            self._check_blocks(draws)
        kept = self._read("reason", ranges) == 0
        return Samples(
            draws=np.concatenate([np.asarray(draws, dtype=np.int64) for draws in ranges])[kept],
            **{name: np.asarray(self._read(name, ranges)[kept], dtype=np.float64) for name in schema.FIELDS},
        )

    @property
    def chosen(self) -> Ints:
        """Numbers of the candidate ramps that the active draws are, in their order; -1 for those not chosen yet."""
        if "active" not in self._root:
            return np.empty(0, dtype=np.int64)
        try:
            return np.asarray(self._root["active/ramps"][:])
        except Exception as error:  # a damaged chunk fails in whichever codec reads it
            raise DataSetError(f"DataSet: active/ramps in {self.path} cannot be read: {_BEYOND_REPAIR}") from error

    def rows(self, draws: range) -> dict[str, NDArray[Any]]:
        """Everything that is stored of draws, rejected ones too, by name; not checked (see `check_complete`)."""
        group = self._root["samples"]
        return {name: group[name][draws.start : draws.stop] for name in schema.NAMES}

    def accepted(self, draws: Ints) -> Iterator[tuple[int, Floats]]:
        """Numbers and displacements, (n, 3), metres, of those of some draws that were accepted."""
        group = self._root["samples"]
        for draw in draws:
            if group["reason"][int(draw)] == 0:
                yield int(draw), group["displacements"][int(draw)]

    def check_complete(self, split: Split) -> None:
        """Refuse a split of which something is missing or damaged.

        Raises:
            DataSetError: it is so.
        """
        for draws in self.ranges(split):
            self._check_blocks(draws)

    def rejected(self) -> Rejected:
        """All draws of all splits that were kept apart."""
        group = self._root["samples"]
        used = np.concatenate([np.asarray(self.split_draws(split), dtype=np.int64) for split in SPLITS])
        reasons = group["reason"][:]
        draws = used[reasons[used] > 0]
        forces = group["forces"]
        stacked = np.stack([forces[int(i)] for i in draws]) if len(draws) else np.empty((0, *forces.shape[1:]))
        return Rejected(draws, stacked, tuple(Reason(reasons[i]).words for i in draws))

    def figures(self, split: Split) -> dict[str, NDArray[Any]]:
        """What the solver said of each draw of a split: energy, residual, iterations, load steps, pivots, reason."""
        ranges = self.ranges(split)
        return {name: self._read(name, ranges) for name in schema.FIGURES}

    def _read(self, name: str, ranges: list[range]) -> NDArray[Any]:
        array = self._root["samples"][name]
        return np.concatenate([array[draws.start : draws.stop] for draws in ranges])

    def _check_blocks(self, draws: range) -> None:
        size = self.header["block"]
        stored = self._checksums()
        for block in range(draws.start // size, -(-draws.stop // size)):
            if stored[block] == 0:
                raise DataSetError(
                    f"DataSet: block {block} of {len(stored)} in {self.path} was never finished; "
                    "run `softtwin generate` again with the same configuration, it goes on where it stopped."
                )
            damage = self._damage(block, stored[block])
            if damage:
                raise DataSetError(
                    f"DataSet: block {block} in {self.path} {damage}. Run `softtwin generate` again with the same "
                    "configuration: it makes damaged blocks again."
                )

    def _damage(self, block: int, stored: int) -> str:
        """What is wrong with a block, empty for nothing."""
        size = self.header["block"]
        part = slice(block * size, (block + 1) * size)
        try:
            arrays = {name: array[part] for name, array in self._blocks.items()}
        except Exception as error:  # a damaged chunk fails in whichever codec reads it
            return f"is damaged ({type(error).__name__})"
        return "" if checksum(arrays) == stored else "does not match its checksum: truncated or changed"

    @cached_property
    def _blocks(self) -> dict[str, Any]:
        """Arrays that blocks are parts of: to open each takes as long as to read a block of it."""
        group = self._root["samples"]
        return {name: group[name] for name in schema.NAMES}

    def _checksums(self) -> list[int]:
        """Of all blocks; one that cannot be read is 0, as of a block that is not there."""
        array = self._root["samples/checksum"]
        try:
            return array[:].tolist()
        except Exception:  # one damaged chunk of many: find which
            return [self._checksum(array, block) for block in range(array.shape[0])]

    @staticmethod
    def _checksum(array: Any, block: int) -> int:
        try:
            return int(array[block])
        except Exception:  # in whichever codec reads it
            return 0

    def _array(self, name: str) -> Any:
        """An array that is no block's, checked against its checksum where the data set has one."""
        try:
            values = self._root[name][:]
        except Exception as error:  # a damaged chunk fails in whichever codec reads it
            raise DataSetError(f"DataSet: {name} in {self.path} cannot be read: {_BEYOND_REPAIR}") from error
        stored = self.header.get("checksums", {}).get(name)
        if stored is not None and zlib.crc32(values.tobytes()) != stored:
            raise DataSetError(f"DataSet: {name} in {self.path} does not match its checksum: {_BEYOND_REPAIR}")
        return values


SKIN = ("points", "triangles")
_RENAMED = {"path": "ramp"}  # entries of a plan that data sets may still have under older names
_BEYOND_REPAIR = (
    "truncated or changed. Bring a copy back, or make the whole data set again (`softtwin generate --again`)."
)


def checksum(arrays: Mapping[str, NDArray[Any]]) -> int:
    """CRC-32 of the arrays of a block, never 0 (0 stands for a block that is not there)."""
    value = 0
    for name in schema.NAMES:
        value = zlib.crc32(np.ascontiguousarray(arrays[name]).tobytes(), value)
    return value or 1


def probe_cotangents(body: Body, shapes: Floats, probes: Floats) -> Floats:
    """The cotangents that probes (s, k) stand for, (s, n, 3): modes on the boundary, as residuals of a registration."""
    surface = outer(body)
    if surface.weights is not None:
        seen = np.stack([surface.spread(surface.carried(shape)) for shape in shapes])
        return np.tensordot(probes, seen, axes=1)
    cotangents = np.zeros((len(probes), *body.points.shape))
    nodes = body.boundary_nodes
    cotangents[:, nodes] = np.tensordot(probes, shapes[:, nodes], axes=1)
    return cotangents


def stored_plan(header: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of the plan in a header, under today's names."""
    entries: dict[str, Any] = header.get("plan", {})
    return {_RENAMED.get(name, name): value for name, value in entries.items()}


def stored_plans(header: Mapping[str, Any], split: Split | None = None) -> list[dict[str, Any]]:
    """The plan in a header, or those of all the sets that it was merged from, under today's names.

    Args:
        header: of a data set.
        split: leave out sets that have no draw of it.
    """
    if header.get("merged") is not None:
        return [plan for entry in header["merged"] for plan in stored_plans(entry, split)]
    return [stored_plan(header)] if split is None or header["samples"].get(split) else []


def _path_numbers(header: Mapping[str, Any], split: Split) -> Ints:
    """Number of the load path of each draw of a split, in the order in which `DataSet.ranges` has them."""
    found: list[Ints] = [np.empty(0, dtype=np.int64)]
    for count, ramp in _pieces(header, split):
        found.append(np.arange(count) // ramp + 1 + max(numbers.max(initial=-1) for numbers in found))
    return np.concatenate(found)


def _pieces(header: Mapping[str, Any], split: Split) -> list[tuple[int, int]]:
    """Draws of each set that a split was merged from, and of a ramp there: a ramp begins anew with each."""
    if header.get("merged") is not None:
        return [piece for entry in header["merged"] for piece in _pieces(entry, split)]
    kinds = (split, "active") if split == "train" else (split,)
    ramp = int(stored_plan(header).get("ramp", 1))
    return [(int(header["samples"].get(kind, 0)), ramp) for kind in kinds]


def differences(data: DataSet, body: Body, plan: Mapping[str, Any]) -> list[str]:
    """What keeps a data set from being one of a body and a plan: a few words each, none where it is.

    Args:
        data: the data set.
        body: the body.
        plan: entries of the plan, as in the header; those that are not given are not compared.
    """
    found = []
    if data.body.fingerprint != body.fingerprint:
        found.append(f"the body ({_described(data.body)} there, {_described(body)} here)")
    else:
        sets = data.body.node_sets, body.node_sets
        zones = plan.get("loads", {}).get("zones", ())
        found += [f"the zone {name!r}" for name in zones if not _same_nodes(*(nodes.get(name) for nodes in sets))]
    return found + _plan_differences(stored_plan(data.header), plan)


def existing(path: Path) -> DataSet | None:
    """The data set in a folder; None where there is none, or one that was interrupted before its header was written.

    Raises:
        DataSetError: it cannot be read, though blocks of it were solved.
    """
    try:
        return DataSet(path)
    except DataSetError:
        if any((path / "samples" / "checksum").glob("c/*")):
            raise
        return None


def _described(body: Body) -> str:
    return f"{len(body.points)} nodes, fingerprint {body.fingerprint[:12]}"


def _same_nodes(one: Ints | None, other: Ints | None) -> bool:
    return one is not None and other is not None and np.array_equal(np.unique(one), np.unique(other))


def _plan_differences(stored: Mapping[str, Any], wanted: Mapping[str, Any], prefix: str = "") -> list[str]:
    found: list[str] = []
    for name, value in wanted.items():
        present = stored.get(name)
        if isinstance(value, Mapping) and isinstance(present, Mapping):
            found += _plan_differences(present, value, f"{prefix}{name}.")
        elif name not in stored or present != value:
            found.append(f"{prefix}{name} ({present} there, {value} here)")
    return found
