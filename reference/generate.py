"""Many equilibria over MPI: a task farm in which block b depends on the configuration, the seed and b alone."""

from __future__ import annotations

import json
import platform
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import mpi4py
import numpy as np
import scipy
import zarr
from numpy.typing import NDArray
from scipy.linalg import svd
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from softtwin.meshes.body import Body

from .data.dataset import (
    NEEDED,
    SPLITS,
    DataSet,
    DataSetError,
    LinearResponse,
    differences,
    existing,
    probe_cotangents,
    stored_plan,
)
from .data.lock import locked
from .data.materials import MATERIALS, Material
from .data.outcome import Equilibrium, NotConverged
from .data.samplers import (
    LoadPlan,
    QuasiRandom,
    check_loads,
    draw_load,
    draw_smooth_load,
    loaded_nodes,
    sobol_point,
)
from .data.schema import Reason
from .data.shard import Shard, at_work_on, refuse_shards_at_work
from .data.springs import Support, springs_of
from .data.writing import create, drop_block, write_block
from .farm import Task, quiet, share_out
from .fem.fenicsx import MPI, PETSc, dolfinx
from .modes import eigenmodes
from .ranks import on_first
from .solve.predictor import Predictor, check_predictor, proposal_for
from .solve.problem import NewtonOptions, Problem

Floats = NDArray[np.float64]

_EXACT_COLUMNS = 1500  # up to so many loaded unknowns the linear response is kept whole
_RANK = 512  # else its displacements in so many modes
_ANY = 256  # of them for forces unlike those that are drawn
_LEAST_MODE = 1e-6
_PILOTS = 9
_PATIENCE_S = 20.0  # ranks live on for a moment when their mpirun is killed
_PREPARING_S = 3600.0  # parts wait for the first of them
_BEYOND = 2.0  # draws that move more than twice the wanted top are kept apart


@dataclass(frozen=True)
class Plan:
    """What to generate: enough, with a body, to make a data set again.

    Args:
        material: name of the strain energy, one of `MATERIALS`.
        young_modulus: pascals.
        poisson_ratio: in [0, 0.5).
        loads: how loads are drawn.
        samples: draws of each split; `calibration` may be left out, and so may `active`: whole blocks of draws that are
            learned from, too, once `write_chosen` has said which of the `candidate_loads` they are; `smooth` ones are
            loads that are rougher than modal ones, which say what a model gets wrong there.
        block: draws of one block, the unit of work and of storage.
        ramp: draws that share one load at growing sizes, each solved from the one before; divides `block`. Several
            times cheaper a draw than independent loads where these need many Newton iterations from rest.
        seed: seed of everything random.
        newton: options of the solver.
        springs: that hold named surfaces of the body, beside its fixed nodes.
    """

    material: str = "neo-hookean"
    young_modulus: float = 5000.0
    poisson_ratio: float = 0.45
    loads: LoadPlan = field(default_factory=LoadPlan)
    samples: Mapping[str, int] = field(default_factory=lambda: {"train": 256, "validation": 32, "test": 64})
    block: int = 16
    ramp: int = 1
    seed: int = 0
    newton: NewtonOptions = field(default_factory=NewtonOptions)
    springs: Mapping[str, Support] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.material not in MATERIALS:
            raise ValueError(f"Plan.material: expected one of {sorted(MATERIALS)}, got {self.material!r}.")
        may = set(SPLITS) - set(NEEDED)
        if set(self.samples) - may != set(NEEDED) or min(self.samples.values()) < 1:
            raise ValueError(
                f"Plan.samples: expected at least one draw for each of {NEEDED} (and of {sorted(may)}, or no word of "
                f"them), got {dict(self.samples)}."
            )
        if self.block < 1:
            raise ValueError(f"Plan.block: expected at least 1, got {self.block}.")
        if self.samples.get("active", 0) % self.block:
            raise ValueError(
                f"Plan.samples: expected whole blocks of {self.block} active draws, got {self.samples['active']}."
            )
        if self.ramp < 1 or self.block % self.ramp:
            raise ValueError(f"Plan.ramp: expected a divisor of the block ({self.block}), got {self.ramp}.")
        self.build_material()

    def build_material(self) -> Material:
        """The strain energy."""
        return MATERIALS[self.material](self.young_modulus, self.poisson_ratio)


def plan_from_header(header: Mapping[str, Any]) -> Plan:
    """The plan that a data set was made with."""
    stored = stored_plan(header)
    loads = {**stored["loads"], "zones": tuple(stored["loads"]["zones"]), "radius": tuple(stored["loads"]["radius"])}
    newton = NewtonOptions(**stored["newton"])
    return Plan(**{**stored, "loads": LoadPlan(**loads), "newton": newton, "springs": springs_of(stored)})


class DamagedBlock(UserWarning):
    """A block that was not as it was written, and is made again."""


def generate(
    path: Path | str | None,
    body: Body | None,
    plan: Plan | None,
    comm: Any = MPI.COMM_WORLD,
    redo: Sequence[int] = (),
    again: bool = False,
    shard: Shard | None = None,
    task: Task | None = None,
) -> DataSet | None:
    """Make a data set, or go on with one that was interrupted; collective over the communicator.

    With one rank the blocks are solved one after the other. With more, rank 0 hands blocks out by `mpi4py.futures`
    and solves blocks itself meanwhile. The data do not depend on the number of ranks. Blocks that are damaged are
    made again, with a warning that names them. Blocks of active draws that nobody has chosen yet are left.

    Args:
        path: folder of the data set; as body and plan read on rank 0 alone, the others may give None.
        body: the body.
        plan: what to generate.
        comm: the ranks that share the work.
        redo: numbers of blocks to make again.
        again: throw away what is there.
        shard: solve the blocks of one shard alone, beside other jobs that solve the others; the first to come prepares
            the data set.
        task: what solves a block, in place of `solve_block`; read on rank 0 alone.

    Returns:
        The data set on rank 0, None on the others.

    Raises:
        DataSetError: there is a data set of another plan or body at the path, somebody else writes it, or blocks to
            make again are not there.
        FailedElsewhere: on the others, where rank 0 raises one of these or what else went wrong, on any rank.
        ValueError: loads that the body cannot carry.
    """
    if shard is not None and (redo or again):
        raise DataSetError("generate.shard: expected no blocks to redo and nothing to throw away beside a shard.")
    with threadpool_limits(1), ExitStack() as held:  # sums by several BLAS threads differ in their last bits

        def prepare() -> tuple[Path, list[int]]:
            assert path is not None and body is not None and plan is not None, "rank 0 gives all three"
            if shard is not None:
                return Path(path), _prepare_shard(Path(path), body, plan, shard, held)
            held.enter_context(writing(Path(path)))
            refuse_shards_at_work(Path(path))
            return Path(path), _prepare(Path(path), body, plan, redo, again)

        folder, blocks = on_first(comm, prepare) or (None, [])
        share_out(task or solve_block, str(comm.bcast(folder, root=0)), blocks, comm, "solving")
    return DataSet(folder) if folder is not None else None


@contextmanager
def writing(path: Path, patience: float = _PATIENCE_S) -> Iterator[None]:
    """Keep others from writing the same data set; the system lets go of the lock when the process ends in any way."""
    path.parent.mkdir(parents=True, exist_ok=True)
    refusal = f"generate.path: another `generate` is at work in {path}; wait for it, end it, or choose another folder."
    with locked(path.with_name(f".{path.name}.lock"), DataSetError(refusal), patience):
        yield


def _prepare_shard(path: Path, body: Body, plan: Plan, shard: Shard, held: ExitStack) -> list[int]:
    """The blocks of a shard that are to be solved; who comes while another prepares the data set waits for that."""
    path.parent.mkdir(parents=True, exist_ok=True)
    held.enter_context(at_work_on(path, shard))
    with writing(path, _PREPARING_S):
        return [block for block in _prepare(path, body, plan, (), False, shard) if shard.has(block)]


def _prepare(
    path: Path, body: Body, plan: Plan, redo: Sequence[int], again: bool, shard: Shard | None = None
) -> list[int]:
    """Make the data set where there is none; returns the numbers of the blocks to solve."""
    check_loads(body, plan.loads)
    present = None if again else existing(path)
    if present is not None and not _is_another(present, body, plan):
        return _unfinished(present, redo, shard)
    if redo:
        raise DataSetError(f"generate.redo: expected a data set with blocks {list(redo)} in {path}, found none.")
    with Problem(body, plan.build_material(), plan.newton, springs=plan.springs) as problem:
        modes = eigenmodes(problem, plan.loads.modes)
        loaded = loaded_nodes(body, plan.loads)
        loads = None if _is_whole(loaded) else _pilots(body, modes.shapes, plan)[:, loaded]
        response = linear_response(problem, loaded, loads, plan.seed)
        amplitude = plan.loads.amplitude or _calibrate(problem, response, modes.shapes, plan)
    header = {
        "plan": _plain(plan),
        "block": plan.block,
        "samples": dict(plan.samples),
        "amplitude": amplitude,
        "versions": versions(),
    }
    return _solvable(create(path, header, body, response, modes.shapes, modes.eigenvalues))


def _unfinished(present: DataSet, redo: Sequence[int], shard: Shard | None) -> list[int]:
    count = present.block_count
    wrong = [block for block in redo if not 0 <= block < count]
    if wrong:
        raise DataSetError(f"generate.redo: expected numbers of blocks in 0..{count - 1}, got {wrong}.")
    _ = present.response, present.shapes  # damage to what no block holds is found here
    if redo and present.header.get("merged"):
        raise DataSetError(
            f"generate.redo: {present.path} was merged from others; make the block again in its own set."
        )
    damaged = present.damaged_blocks([block for block in range(count) if shard is None or shard.has(block)])
    if present.header.get("merged") and (damaged or present.missing_blocks()):
        raise DataSetError(
            f"generate.path: {present.path} was merged from others and lacks blocks, or has damaged ones; merge again."
        )
    for block, damage in damaged.items():
        warnings.warn(f"block {block} in {present.path} {damage}; it is made again.", DamagedBlock, stacklevel=2)
    for block in {*redo, *damaged}:
        drop_block(present.path, block)
    return _solvable(present)


def _solvable(data: DataSet) -> list[int]:
    """Blocks that are missing and whose draws are known."""
    size, ramp = data.header["block"], stored_plan(data.header).get("ramp", 1)
    first, unknown = data.split_draws("active").start, np.flatnonzero(data.chosen < 0)
    waiting = {(first + ramp * int(place)) // size for place in unknown}
    return [block for block in data.missing_blocks() if block not in waiting]


def _plain(plan: Plan) -> dict[str, Any]:
    description = asdict(plan)
    description["loads"]["zones"] = list(plan.loads.zones)
    description["loads"]["radius"] = list(plan.loads.radius)
    description["samples"] = dict(plan.samples)
    if plan.loads.sequence == "random":
        del description["loads"]["sequence"]  # data sets that are older than the choice do not name it
    if not plan.samples.get("smooth"):
        del description["loads"]["smoothness"]  # the same, and it would tell apart what is alike
    if not plan.springs:
        del description["springs"]
    return description


def _is_another(present: DataSet, body: Body, plan: Plan) -> bool:
    """Whether nothing of the data set serves: it is of another plan or body, and no block of it was solved.

    Raises:
        DataSetError: it is another one, and blocks of it were solved.
    """
    wanted, stored = json.loads(json.dumps(_plain(plan))), present.header["plan"].get("newton", {})
    # An option that is newer than the data set had its default when the data set was made.
    usual = {name: value for name, value in asdict(NewtonOptions()).items() if name not in stored}
    wanted["newton"] = {name: value for name, value in wanted["newton"].items() if usual.get(name, ...) != value}
    found = differences(present, body, wanted)
    if found and len(present.missing_blocks()) < present.block_count:
        raise DataSetError(
            f"generate.path: {present.path} was made with another plan or body (differs in {'; '.join(found)}); choose "
            "another folder, go on with what it was made with, or throw it away (`softtwin generate --again`)."
        )
    return bool(found)


def versions() -> dict[str, str]:
    """Versions of what the figures of a data set depend on."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "dolfinx": dolfinx.__version__,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "mpi4py": mpi4py.__version__,
        "zarr": zarr.__version__,
    }


def linear_response(
    problem: Problem, loaded: NDArray[np.int64], loads: Floats | None = None, seed: int = 0
) -> LinearResponse:
    """K(0)^-1 for forces at the loaded nodes: whole if small, else the projection of its displacements on 512 modes.

    Most of these are the leading modes (POD) of the displacements under drawn loads, the others those that a
    randomised range finder sees best for any forces (Halko, Martinsson, Tropp, SIAM Review 53 (2011), algorithm 4.4),
    which is all that there is where no loads are given.

    Args:
        problem: body and material.
        loaded: numbers of the nodes that may carry force, (l,).
        loads: forces at the loaded nodes, as they will be drawn, (s, l, 3), newtons.
        seed: seed of the random probes.
    """
    unknowns = (3 * loaded[:, None] + np.arange(3)).ravel()
    total = 3 * len(problem.body.points)
    if _is_whole(loaded):
        columns = np.zeros((total, len(unknowns)))
        columns[unknowns, np.arange(len(unknowns))] = 1.0
        return LinearResponse(loaded, problem.apply_inverse(columns), np.eye(len(unknowns)))
    rank = min(_RANK, len(unknowns))
    own = np.zeros((total, 0)) if loads is None else _leading_modes(problem, unknowns, loads, rank - _ANY)
    probes = np.zeros((total, rank - own.shape[1]))
    probes[unknowns] = np.random.default_rng(seed).standard_normal((len(unknowns), probes.shape[1]))
    for _ in range(2):  # one power iteration sharpens the range
        basis, _ = np.linalg.qr(np.hstack([own, problem.apply_inverse(probes)]))
        back = problem.apply_inverse(basis)[unknowns]
        probes = np.zeros_like(probes)
        probes[unknowns], _ = np.linalg.qr(back[:, own.shape[1] :])
    return LinearResponse(loaded, basis, back.T)


def _is_whole(loaded: NDArray[np.int64]) -> bool:
    return 3 * len(loaded) <= _EXACT_COLUMNS


def _pilots(body: Body, shapes: Floats, plan: Plan) -> Floats:
    """Loads as they will be drawn, (s, n, 3), of no size."""
    chances = (np.random.default_rng([plan.seed, 4, i]) for i in range(_RANK))
    return np.stack([draw_load(body, shapes, plan.loads, rng) for rng in chances])


def _leading_modes(problem: Problem, unknowns: NDArray[np.int64], loads: Floats, most: int) -> Floats:
    """Modes of the linear displacements under loads, each counting alike, (3n, r), down to a millionth."""
    columns = np.zeros((3 * len(problem.body.points), len(loads)))
    columns[unknowns] = loads.reshape(len(loads), -1).T
    moved = problem.apply_inverse(columns)
    scaled = moved / np.maximum(np.linalg.norm(moved, axis=0), 1e-300)
    modes, sizes, _ = svd(scaled, full_matrices=False, overwrite_a=True)
    return np.ascontiguousarray(modes[:, : min(most, int((sizes > _LEAST_MODE * sizes[0]).sum()))])


def _calibrate(problem: Problem, response: LinearResponse, shapes: Floats, plan: Plan) -> float:
    """The linear displacement at which half of the pilot loads have moved the body by the wanted one, metres."""
    found = []
    for i in tqdm(range(_PILOTS), desc="calibrating the loads", unit="load", disable=quiet()):
        load = draw_load(problem.body, shapes, plan.loads, np.random.default_rng([plan.seed, 1, i]))
        found.append(_reach(problem, load / _peak(response.apply(load[None, response.loaded])[0]), plan))
    amplitude = float(np.median(found))
    if not amplitude > 0.0:
        raise RuntimeError(
            f"generate.plan: most pilot loads found no equilibrium at a sixth of the wanted displacement, "
            f"{plan.loads.displacement:.3g} m; lower LoadPlan.displacement, or raise NewtonOptions.max_iterations."
        )
    return amplitude


def _reach(problem: Problem, unit: Floats, plan: Plan) -> float:
    """Multiple of a load of unit linear displacement that moves the body as far as wanted, or as far as it goes."""
    wanted = plan.loads.displacement
    before, scale, guess = 0.0, 0.0, np.zeros_like(unit)
    while scale < 4.0 * wanted:
        scale += wanted / 6.0
        try:
            state = problem.solve(scale * unit, guess, stability=False, fallback=False).displacement
        except NotConverged:
            return scale - wanted / 6.0
        if _peak(state) >= wanted:
            return scale - wanted / 6.0 * (_peak(state) - wanted) / (_peak(state) - before)
        before, guess = _peak(state), _ahead(problem, state, wanted / 6.0 * unit)
    return scale


def _ahead(problem: Problem, displacement: Floats, change: Floats) -> Floats:
    """The displacement after a change of the load, along the tangent; as it is where that turns a cell inside out."""
    guess = displacement + problem.apply_inverse(change.ravel(), displacement).reshape(-1, 3)
    return guess if np.isfinite(problem.energy(guess)) else displacement


def _peak(displacement: Floats) -> float:
    return float(np.linalg.norm(displacement, axis=1).max())


# ------------------------------------------------------------------ the farm


def opened(path: str) -> tuple[DataSet, Plan, Problem]:
    """What a block needs; kept for the next one.

    Args:
        path: folder of the data set.
    """
    return _opened(path, (Path(path) / "zarr.json").stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _opened(path: str, made: int) -> tuple[DataSet, Plan, Problem]:
    """`made`, the time of the header, tells a data set that was made again in the same place."""
    data = DataSet(path)
    plan = plan_from_header(data.header)
    return data, plan, Problem(data.body, plan.build_material(), plan.newton, springs=plan.springs)


def solve_block(path: str, block: int, predictor: Predictor | None = None) -> int:
    """Draw, solve and write one block of a prepared data set; returns its number.

    Args:
        path: folder of the data set.
        block: number of the block.
        predictor: says where to start each solve, the network of an earlier round for instance; the equilibria are
            those that are found without, to the solver's tolerance.

    Raises:
        ValueError: a predictor of another body or material.
    """
    data, plan, problem = opened(path)
    if predictor is not None:
        check_predictor(predictor, problem)
    with threadpool_limits(1):
        ramps = range(block * plan.block // plan.ramp, (block + 1) * plan.block // plan.ramp)
        rows = [row for number in ramps for row in _solve_ramp(data, plan, problem, number, predictor)]
    write_block(Path(path), block, {name: np.stack([row[name] for row in rows]) for name in rows[0]})
    return block


def ramp_loads(data: DataSet, plan: Plan, ramp: int) -> tuple[Floats, Floats]:
    """One load and its growing sizes: nodal forces (n, 3) in newtons and factors (plan.ramp,).

    Args:
        data: gives body, modes, linear response and calibrated amplitude.
        plan: what is generated.
        ramp: number of the ramp; everything is a function of it and the seed, and of an active one's candidate.

    Raises:
        DataSetError: an active ramp that nobody has chosen yet.
    """
    if plan.loads.sequence == "sobol" and ramp * plan.ramp in data.split_draws("train"):
        point = sobol_point(plan.loads, plan.ramp, ramp, plan.seed)
        load = draw_load(data.body, data.shapes, plan.loads, QuasiRandom(point))
        return _sized(data, plan, load, point[-plan.ramp :])
    if ramp * plan.ramp in data.split_draws("active"):
        place = ramp - data.split_draws("active").start // plan.ramp
        candidate = int(data.chosen[place])
        if candidate < 0:
            raise DataSetError(f"ramp_loads.ramp: nobody has chosen yet what ramp {ramp} of {data.path} is.")
        return candidate_loads(data, plan, candidate)
    rng = np.random.default_rng([plan.seed, 2, ramp])
    if ramp * plan.ramp in data.split_draws("smooth"):
        return _sized(data, plan, draw_smooth_load(data.body, plan.loads, rng), rng.uniform(0.0, 1.0, plan.ramp))
    return _drawn(data, plan, rng)


def candidate_loads(data: DataSet, plan: Plan, candidate: int) -> tuple[Floats, Floats]:
    """A load that active draws may be chosen from, as `ramp_loads` says; none is among the other draws.

    Args:
        data: as `ramp_loads`.
        plan: as `ramp_loads`.
        candidate: its number, from 0.
    """
    return _drawn(data, plan, np.random.default_rng([plan.seed, 5, candidate]))


def _drawn(data: DataSet, plan: Plan, rng: np.random.Generator) -> tuple[Floats, Floats]:
    load = draw_load(data.body, data.shapes, plan.loads, rng)
    return _sized(data, plan, load, rng.uniform(0.0, 1.0, plan.ramp))


def _sized(data: DataSet, plan: Plan, load: Floats, sizes: Floats) -> tuple[Floats, Floats]:
    """A load of unit size as large as wanted, and the factors of its ramp."""
    if plan.loads.amplitude is not None:
        return plan.loads.amplitude * load, np.linspace(0.0, 1.0, plan.ramp + 1)[1:]
    top = data.header["amplitude"] / _peak(data.response.apply(load[None, data.response.loaded])[0])
    return top * load, np.sort(sizes)


def _solve_ramp(
    data: DataSet, plan: Plan, problem: Problem, ramp: int, predictor: Predictor | None
) -> Iterator[dict[str, Any]]:
    load, factors = ramp_loads(data, plan, ramp)
    loaded = data.response.loaded
    state: Equilibrium | None = None
    for i, factor in enumerate(factors):
        probe = np.random.default_rng([plan.seed, 3, ramp * plan.ramp + i]).standard_normal(len(data.shapes))
        row = data.sizes.failed() | {"forces": factor * load[loaded], "probes": probe}
        guess = None if state is None else _ahead(problem, state.displacement, (factor - factors[i - 1]) * load)
        start = None if predictor is None or guess is not None else proposal_for(factor * load, predictor)
        try:
            state = problem.solve(factor * load, guess, proposal=start)
        except NotConverged:
            state = None
            yield row
            continue
        cotangent = probe_cotangents(data.body, data.shapes, probe[None])[0]
        adjoint = problem.apply_inverse(cotangent.ravel(), state.displacement).reshape(-1, 3)[loaded]
        yield row | _solved_row(state, adjoint, plan)


def _solved_row(state: Equilibrium, adjoint: Floats, plan: Plan) -> dict[str, Any]:
    pivots = state.negative_pivots or 0
    return {
        "displacements": state.displacement,
        "adjoints": adjoint,
        **{name: getattr(state, name) for name in ("energy", "residual", "iterations", "load_steps")},
        "negative_pivots": pivots,
        "reason": judged(state.displacement, pivots, plan),
    }


def judged(displacement: Floats, negative_pivots: int, plan: Plan) -> Reason:
    """Whether a state is learned from, and if not, why.

    Args:
        displacement: (n, 3), metres.
        negative_pivots: of its tangent.
        plan: what is generated.
    """
    if negative_pivots > 0:
        return Reason.UNSTABLE
    scaled = plan.loads.amplitude is None
    too_far = scaled and _peak(displacement) > _BEYOND * plan.loads.displacement
    return Reason.BEYOND if too_far else Reason.ACCEPTED
