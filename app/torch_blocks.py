"""Blocks of a data set solved by torch, many draws at a time, and how well a part of them agrees with the reference."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softtwin.reference.data.dataset import SPLITS, DataSet, probe_cotangents
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.schema import Reason
from softtwin.reference.data.writing import record_engine, write_block
from softtwin.reference.generate import Plan, judged, plan_from_header, ramp_loads
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.equilibria import Equilibria, NewtonSettings

from .config import ConfigError

Floats = NDArray[np.float64]
CHECKED = 0.01  # of the accepted draws, that the reference solves again
_TOGETHER = {"cpu": 32, "cuda": 1024}  # draws that are solved together, about


class TorchBlocks:
    """A task of the farm: the block that it is asked for, and those after it that are missing, solved in one batch.

    Draws are those that the reference would solve, each from rest; so are the reasons to keep one apart.

    Args:
        device: `cpu` or `cuda`.

    Raises:
        ConfigError: a GPU is asked for, and torch sees none.
    """

    def __init__(self, device: str = "cpu") -> None:
        if device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                f"generate --device cuda: expected a GPU that torch can use, found none (torch {torch.__version__}); "
                "leave --device out, or install a torch that fits the driver."
            )
        self.device = device
        self.draws: list[int] = []
        self._solver: tuple[DataSet, Plan, Equilibria] | None = None
        self._done: set[int] = set()
        self._seconds = 0.0

    def __call__(self, path: str, block: int) -> int:
        """Draw, solve and write a block of a prepared data set, with others; returns its number.

        Args:
            path: folder of the data set.
            block: number of the block.

        Raises:
            ConfigError: a body or a material that torch's solver does not know.
        """
        if block in self._done:
            return block
        begin = time.perf_counter()
        data, plan, solver = self._opened(path)
        missing = [each for each in data.missing_blocks() if each >= block and _is_known(data, plan, each)]
        blocks = [block, *(each for each in missing if each != block)][: max(1, _TOGETHER[self.device] // plan.block)]
        ramps = [ramp for each in blocks for ramp in _ramps(plan, each)]
        loads = [
            factor * load for load, factors in (ramp_loads(data, plan, ramp) for ramp in ramps) for factor in factors
        ]
        rows = self._rows(
            data, plan, solver, np.stack(loads), [ramp * plan.ramp + i for ramp in ramps for i in range(plan.ramp)]
        )
        for place, each in enumerate(blocks):
            part = rows[place * plan.block : (place + 1) * plan.block]
            write_block(Path(path), each, {name: np.stack([row[name] for row in part]) for name in part[0]})
        self._done.update(blocks)
        self._seconds += time.perf_counter() - begin
        return block

    def _opened(self, path: str) -> tuple[DataSet, Plan, Equilibria]:
        data = DataSet(path)
        if self._solver is None:
            plan = plan_from_header(data.header)
            settings = NewtonSettings(plan.newton.tolerance, plan.newton.max_iterations, plan.newton.max_load_steps)
            try:
                solver = Equilibria(
                    data.body, plan.build_material(), self.device, settings=settings, springs=plan.springs
                )
            except ValueError as error:
                raise ConfigError(f"generate --engine torch: {error} Solve it with --engine reference.") from None
            self._solver = data, plan, solver
        return data, *self._solver[1:]

    def _rows(
        self, data: DataSet, plan: Plan, solver: Equilibria, loads: Floats, draws: list[int]
    ) -> list[dict[str, Any]]:
        """Rows of the data set, one for each load, (s, n, 3), newtons."""
        found = solver.solve(loads)
        moved = found.displacement.cpu().numpy()
        solved = np.flatnonzero(found.is_converged.cpu().numpy())
        chances = (np.random.default_rng([plan.seed, 3, draw]) for draw in draws)
        probes = np.stack([chance.standard_normal(len(data.shapes)) for chance in chances])
        loaded = data.response.loaded
        rows = [
            data.sizes.failed() | {"forces": load[loaded], "probes": probe}
            for load, probe in zip(loads, probes, strict=True)
        ]
        if not len(solved):
            return rows
        tangent = solver.tangent(moved[solved])
        cotangents = probe_cotangents(data.body, data.shapes, probes[solved])
        adjoints = tangent.inverse(cotangents[..., None])[..., 0].cpu().numpy()[:, loaded]
        stored = solver.elastic.energy_and_forces(torch.from_numpy(moved[solved]).to(solver.device))[0].cpu().numpy()
        sizes = np.linalg.norm(loads[solved], axis=(1, 2))
        unstable = ~tangent.is_stable.cpu().numpy()
        for place, row in enumerate(solved):
            rows[row] |= {
                "displacements": moved[row],
                "adjoints": adjoints[place],
                "energy": stored[place] - float(np.vdot(loads[row], moved[row])),
                "residual": float(found.residual[row]) * sizes[place],
                "iterations": int(found.iterations[row]),
                "load_steps": int(found.load_steps[row]),
                "negative_pivots": int(unstable[place]),
                "reason": judged(moved[row], int(unstable[place]), plan),
            }
        real = {draw for split in SPLITS for draw in data.split_draws(split)}  # a split's last block is filled up
        self.draws += [draws[row] for row in solved if rows[row]["reason"] == Reason.ACCEPTED and draws[row] in real]
        return rows

    def record(self, data: DataSet) -> dict[str, Any]:
        """Solve a part of what was solved again by the reference, and write down how well both agree; returns that.

        Args:
            data: the data set.
        """
        entry = {
            "engine": "torch",
            "torch": torch.__version__,
            "device": torch.cuda.get_device_name() if self.device == "cuda" else "cpu",
            "accepted": len(self.draws),
            "seconds": self._seconds,
            "agreement": agreement(data, self.draws),
        }
        record_engine(data.path, entry)
        return entry


def _ramps(plan: Plan, block: int) -> range:
    return range(block * plan.block // plan.ramp, (block + 1) * plan.block // plan.ramp)


def _is_known(data: DataSet, plan: Plan, block: int) -> bool:
    """Whether its draws are known: those of active rounds are chosen first."""
    active = data.split_draws("active")
    if block * plan.block not in active:
        return True
    first = active.start // plan.ramp
    return bool((data.chosen[[ramp - first for ramp in _ramps(plan, block)]] >= 0).all())


def agreement(data: DataSet, draws: list[int], share: float = CHECKED) -> dict[str, Any]:
    """How far equilibria lie from those that the reference finds for the same loads, from rest.

    Args:
        data: that holds them.
        draws: numbers of accepted draws.
        share: of them, drawn by the data set's seed, one at least.

    Returns:
        Numbers of the draws; the largest difference of a component over the largest displacement of each; those that
        the reference did not find. Where a difference is large, both are equilibria, and the load has several.
    """
    plan = plan_from_header(data.header)
    if not draws:
        return {"draws": [], "differences": [], "not_found": []}
    rng = np.random.default_rng([plan.seed, 6])
    chosen = sorted(rng.choice(draws, max(1, int(np.ceil(share * len(draws)))), replace=False).tolist())
    differences, lost = [], []
    with Problem(data.body, plan.build_material(), plan.newton, springs=plan.springs) as problem:
        for draw in chosen:
            rows = data.rows(range(draw, draw + 1))
            forces = data.response.spread(rows["forces"][0])
            try:
                truth = problem.solve(forces).displacement
            except NotConverged:
                lost.append(draw)
                continue
            peak = float(np.linalg.norm(truth, axis=1).max())
            differences.append(float(np.abs(rows["displacements"][0] - truth).max()) / max(peak, 1e-300))
    return {"draws": chosen, "differences": differences, "not_found": lost}
