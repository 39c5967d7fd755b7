"""What a model does not know of its organ: how far equilibria move where it is otherwise than the model has it.

Bayesian approximation error (Kaipio and Somersalo 2005, section 5.8): alternatives are drawn from a prior, and how far
they lie from the model under its own loads is an error of the model with a covariance.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import Embedding, embed
from softtwin.meshes.io import read_body, write_body
from softtwin.meshes.solidify import solidify

from .data.dataset import DataSet, Samples
from .data.outcome import NotConverged
from .data.springs import on_surfaces
from .farm import share_out
from .fem.fenicsx import MPI
from .generate import Plan, plan_from_header, writing
from .ranks import on_first
from .solve.problem import Problem

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_LEAST_HELD = 3  # nodes: on fewer the body may turn
_TOO_FAR = 3.0  # times the largest displacement of the model's own state: another branch, or nothing holds the organ
_TOLERANCE = 1e-6  # of the forces: errors are right to a millionth of the movement
_BLOCK = 4  # draws that are solved and written together
_FINENESS, _FEWEST_NODES = 2.0, 60  # nodes of the finest other mesh, over the model's; of the coarsest


@dataclass(frozen=True)
class ModelErrorEnsemble:
    """How else an organ may be than its model: a prior.

    Args:
        attachment: what holds the organ lies elsewhere on its surface: standard deviation of each coordinate of the
            shift, metres; 0 for as the model has it.
        poisson_ratio: least and largest, all alike; None for the model's.
        meshes: other meshes of the same surface, of half as many to twice as many nodes; one of them is drawn for each
            alternative. 0 for the model's own.

    Raises:
        ValueError: an argument out of its range, or nothing that may be otherwise.
    """

    attachment: float = 0.0
    poisson_ratio: tuple[float, float] | None = None
    meshes: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.attachment < np.inf:
            raise ValueError(f"ModelErrorEnsemble.attachment: expected a length of 0 m or more, got {self.attachment}.")
        ratio = self.poisson_ratio
        if ratio is not None and not 0.0 <= ratio[0] <= ratio[1] < 0.5:
            raise ValueError(f"ModelErrorEnsemble.poisson_ratio: expected 0 <= least <= largest < 0.5, got {ratio}.")
        if self.meshes < 0:
            raise ValueError(f"ModelErrorEnsemble.meshes: expected 0 or more, got {self.meshes}.")
        if self.attachment == 0.0 and ratio is None and self.meshes == 0:
            raise ValueError(
                "ModelErrorEnsemble: expected something that may be otherwise than in the model, got nothing."
            )


@dataclass(frozen=True, eq=False)
class Differences:
    """How far alternatives lie from the model.

    Args:
        errors: displacement of the alternative less the model's, over the model's largest, (s, 3n).
        failed: draws without an equilibrium, held by too few nodes, or beyond sense; they are in no error.
    """

    errors: Floats
    failed: int


def differences(
    path: Path | str | None,
    ensemble: ModelErrorEnsemble | None,
    count: int = 64,
    seed: int = 0,
    comm: Any = MPI.COMM_WORLD,
) -> Differences | None:
    """Alternatives under the training loads of a data set, a draw for each of so many loads; collective.

    Goes on where it was interrupted.

    Args:
        path: folder of the data set, whose training split is finished; as the alternatives read on rank 0 alone.
        ensemble: what may be otherwise.
        count: draws.
        seed: of the draws.
        comm: the ranks that share the work.

    Returns:
        What was found on rank 0, None on the others.

    Raises:
        DataSetError: the training split is not finished, or somebody else writes the data set.
        FailedElsewhere: on the others, where rank 0 raises one of these or what else went wrong, on any rank.
        ValueError: fewer than one draw, or a body that nothing holds.
    """
    with threadpool_limits(1), ExitStack() as held:

        def prepare() -> tuple[str, Path, ModelErrorEnsemble, list[int]]:
            assert path is not None and ensemble is not None, "rank 0 gives both"
            if count < 1:
                raise ValueError(f"differences.count: expected at least 1, got {count}.")
            data = DataSet(path)
            data.check_complete("train")
            if (ensemble.attachment or ensemble.meshes) and not data.springs:
                shifted(data.body, np.zeros(3))
            if ensemble.meshes and data.body.cells.shape[1] != 4:
                raise ValueError(
                    "ModelErrorEnsemble.meshes: expected a body of linear tetrahedra, got cells of "
                    f"{data.body.cells.shape[1]} nodes."
                )
            held.enter_context(writing(Path(path)))
            folder = _folder(data, ensemble, seed)
            _mesh_anew(data.body, ensemble.meshes, folder)
            blocks = [block for block in range(-(-count // _BLOCK)) if not _file(folder, block).exists()]
            return str(path), folder, ensemble, blocks

        found = on_first(comm, prepare)
        first = comm.bcast(None if found is None else found[:3], root=0)
        task = partial(difference_block, folder=first[1], ensemble=first[2], seed=seed)
        share_out(task, first[0], found[3] if found else [], comm, "ensemble")
        return None if found is None else _read(found[1], count)


def forget(path: Path | str) -> None:
    """Throw away what interrupted draws have left beside a data set.

    Args:
        path: folder of the data set.
    """
    shutil.rmtree(Path(path).parent / "doubt", ignore_errors=True)


def difference_block(path: str, block: int, folder: Path, ensemble: ModelErrorEnsemble, seed: int) -> int:
    """Draw, solve and write a few alternatives; returns their block's number.

    Args:
        path: folder of the data set.
        block: number of the block.
        folder: where its file goes.
        ensemble: what may be otherwise.
        seed: of the draws.
    """
    data, samples, plan = _opened(path, (Path(path) / "zarr.json").stat().st_mtime_ns)
    draws = range(block * _BLOCK, (block + 1) * _BLOCK)
    others = tuple(_carried(data, _mesh_file(folder, number)) for number in range(ensemble.meshes))
    with threadpool_limits(1):
        each = [_difference(data, samples, plan, ensemble, others, draw, seed) for draw in draws]
    missing = np.full(data.body.points.size, np.nan)
    partial_file = folder / f".{block}.partial.npy"
    np.save(partial_file, np.stack([missing if error is None else error for error in each]))
    partial_file.replace(_file(folder, block))
    return block


@lru_cache(maxsize=1)
def _opened(path: str, made: int) -> tuple[DataSet, Samples, Plan]:
    """`made`, the time of the header, tells a data set that was made again in the same place."""
    data = DataSet(path)
    return data, data.samples("train"), plan_from_header(data.header)


def _difference(
    data: DataSet,
    samples: Samples,
    plan: Plan,
    ensemble: ModelErrorEnsemble,
    others: tuple[tuple[Body, Embedding], ...],
    draw: int,
    seed: int,
) -> Floats | None:
    """One alternative less the model's state, over its largest displacement, (3n,); None where there is none.

    Another mesh carries the model's nodes: they hand their forces on to it, and move with it.
    """
    rng, place = np.random.default_rng([seed, draw]), draw % len(samples)
    body, known = data.body, samples.displacements[place]
    forces = data.response.spread(samples.forces[place])
    translation = ensemble.attachment * rng.standard_normal(3) if ensemble.attachment else np.zeros(3)
    carrier = None
    if others:
        body, carrier = others[int(rng.integers(len(others)))]
        forces = np.asarray(carrier.matrix.T @ forces)
    if ensemble.attachment or carrier is not None:
        moved = _supported(data, translation, body)
        if moved is None:
            return None
        if (
            carrier is None
            and ensemble.poisson_ratio is None
            and _is_supported_alike(moved, body, on_surfaces(plan.springs).keys() - {"boundary"})
        ):
            return np.zeros(body.points.size)
        body = moved
        forces[body.fixed] = 0.0
    if ensemble.poisson_ratio is not None:
        plan = replace(plan, poisson_ratio=float(rng.uniform(*ensemble.poisson_ratio)))
    guess = None  # the model's own state is near: it halves the time
    if carrier is None:
        guess = known.copy()
        guess[body.fixed] = 0.0
    try:
        newton = replace(plan.newton, tolerance=max(plan.newton.tolerance, _TOLERANCE))
        with Problem(body, plan.build_material(), newton, springs=plan.springs) as problem:
            found = problem.solve(forces, guess, stability=False).displacement
    except NotConverged:
        return None
    off = (found if carrier is None else carrier.displace(found)) - known
    size = max(float(np.linalg.norm(known, axis=1).max()), 1e-12)
    return None if np.linalg.norm(off, axis=1).max() > _TOO_FAR * size else np.asarray(off.ravel() / size)


def _supported(data: DataSet, translation: Floats, body: Body) -> Body | None:
    """A mesh with what holds the organ elsewhere, fixed nodes and springs; None where too little of it is left."""
    model = data.body
    if len(model.fixed):
        held = shifted(model, translation, body)
        if len(held) < _LEAST_HELD:
            return None
        body = body.with_sets(fixed=held)
    surfaces = {}
    for name in on_surfaces(data.springs).keys() - {"boundary"}:
        nodes = shifted(model, translation, body, np.unique(model.surfaces[name]))
        surfaces[name] = body.boundary[np.isin(body.boundary, nodes).all(axis=1)]
        if not len(surfaces[name]):
            return None
    return body.with_surfaces(**surfaces) if surfaces else body


def _is_supported_alike(body: Body, other: Body, springs: Iterable[str]) -> bool:
    """Whether two supports of one mesh are the same."""
    surfaces = (np.array_equal(body.surfaces[name], other.surfaces[name]) for name in springs)
    return np.array_equal(body.fixed, other.fixed) and all(surfaces)


def shifted(body: Body, translation: Floats, other: Body | None = None, nodes: Ints | None = None) -> Ints:
    """The nodes that hold a body, moved along its surface: numbers of the nodes that are held then.

    A node of the boundary is held where the one nearest to the place that it would come from is.

    Args:
        body: with fixed nodes.
        translation: (3,), metres.
        other: another mesh of the same organ, whose nodes are wanted; the body itself if not given.
        nodes: that are moved, in place of the fixed ones.

    Raises:
        ValueError: none is fixed on the boundary.
    """
    boundary = body.boundary_nodes
    is_held = np.isin(boundary, body.fixed if nodes is None else nodes)
    if not is_held.any():
        raise ValueError("shifted.body: expected fixed nodes on the boundary, got none.")
    wanted = body if other is None else other
    nearest = body.boundary_tree.query(wanted.points[wanted.boundary_nodes] - translation)[1]
    return np.asarray(wanted.boundary_nodes[is_held[nearest]])


def _mesh_anew(body: Body, count: int, folder: Path) -> None:
    """Write other meshes of a body's surface, of half as many to twice as many nodes; what is there stays."""
    shares = _FINENESS ** np.linspace(-1.0, 1.0, count) if count > 1 else np.array([1.0])
    for number, share in enumerate(shares[:count]):
        if not _mesh_file(folder, number).exists():
            solid = solidify(body.boundary_surface, node_count=max(int(share * len(body.points)), _FEWEST_NODES))
            write_body(_mesh_file(folder, number), Body(solid.points, solid.cells, {}))


def _mesh_file(folder: Path, number: int) -> Path:
    return folder / f"mesh_{number}.vtu"


@lru_cache(maxsize=8)
def _carried_as(file: Path, made: int, body: Body) -> tuple[Body, Embedding]:
    other = read_body(file)
    return other, embed(other, body.points)


def _carried(data: DataSet, file: Path) -> tuple[Body, Embedding]:
    """Another mesh, and how it carries the model's nodes."""
    return _carried_as(file, file.stat().st_mtime_ns, data.body)


def _folder(data: DataSet, ensemble: ModelErrorEnsemble, seed: int) -> Path:
    """Where the blocks of these draws lie; those of others are thrown away."""
    words = json.dumps([data.identity, asdict(ensemble), seed])
    parent = data.path.parent / "doubt"
    folder = parent / hashlib.sha256(words.encode()).hexdigest()[:16]
    if not folder.is_dir():
        forget(data.path)
        folder.mkdir(parents=True)
    return folder


def _file(folder: Path, block: int) -> Path:
    return folder / f"{block}.npy"


def _read(folder: Path, count: int) -> Differences:
    every = np.concatenate([np.load(_file(folder, block)) for block in range(-(-count // _BLOCK))])[:count]
    whole = np.isfinite(every).all(axis=1)
    return Differences(every[whole], int((~whole).sum()))
