"""Newton's method on the energy: PETSc SNES, with a search that shortens or turns the step before SNES takes it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..data.outcome import Iteration
from ..data.secants import Secants
from ..fem.fenicsx import PETSc
from ..fem.forms import DiscreteLoad, Forms
from .elimination import CellElimination
from .linear import METHODS, Method
from .tangent import Tangent

Floats = NDArray[np.float64]
Search = Literal["energy", "full", "bt", "l2", "cp"]
_SEARCHES = ("energy", "full", "bt", "l2", "cp")

_ARMIJO = 1e-4
_SMALLEST_STEP = 1e-8
_ROUND_OFF = 1e-12  # of the energy: differences below it say nothing about descent
_EPSILONS = 8.0  # of machine precision in sums of stresses and energies that cancel
_CUT_STEP = 0.5  # a shorter one calls for elimination
_MOST_ELIMINATIONS = 3  # of one attempt: what needs more may end on another branch than the one that leaves rest
_LOCAL_STEPS, _LOCAL_TOLERANCE = 15, 0.1
_CHORD_STEPS = 12  # with a kept factorisation, whose secants are learned, cost as much as a new one and its iteration
_prefixes = itertools.count()


@dataclass(frozen=True)
class NewtonOptions:
    """How far, how long and in which way to iterate.

    Args:
        tolerance: norm of the residual over free unknowns, relative to that of the forces (of following pressures at
            rest; of the reactions too where supports are moved).
        max_iterations: Newton iterations of one load step.
        max_load_steps: load steps tried, failed ones included, before giving up.
        search: `energy`, Armijo's rule on the energy, which converges where the others do not; `full` steps, halved
            only where a cell would be inside out; PETSc's `bt`, `l2`, `cp` on the residual. A mixed problem has no
            energy to decrease and takes `full` steps for `energy`.
        first_step: part of the load that is tried first; 1 tries the whole load at once, and steps only if that fails.
        elimination: where the energy's search cuts a step by more than half on the way from rest, balance the cells
            most out of balance alone before the next (three times at most, then load steps; on one rank; never from
            a guess, whose neighbour is wanted).
        chord: keep a factorisation while it converges fast, its steps improved by what they show (BFGS); False factors
            in each iteration.
        linear: `band` (LAPACK, for slender bodies; MUMPS for others), `mumps`, `multigrid` (conjugate gradients with
            smoothed aggregation), or `auto` by size and shape.
    """

    tolerance: float = 1e-8
    max_iterations: int = 60
    max_load_steps: int = 100
    search: Search = "energy"
    first_step: float = 1.0
    elimination: bool = True
    chord: bool = True
    linear: Method = "auto"

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"NewtonOptions.tolerance: expected a number in (0, 1), got {self.tolerance}.")
        if not 0.0 < self.first_step <= 1.0:
            raise ValueError(f"NewtonOptions.first_step: expected a number in (0, 1], got {self.first_step}.")
        for name in ("max_iterations", "max_load_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"NewtonOptions.{name}: expected at least 1, got {getattr(self, name)}.")
        for name, allowed in (("search", _SEARCHES), ("linear", METHODS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"NewtonOptions.{name}: expected one of {allowed}, got {getattr(self, name)!r}.")


@dataclass(frozen=True)
class Attempt:
    """One run of SNES: the unknowns it stopped at and how it ended."""

    unknowns: Floats
    converged: bool
    reason: int
    iterations: int
    residual: float

    @property
    def reason_name(self) -> str:
        """Why SNES stopped, in its words."""
        names = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
        return names.get(self.reason, str(self.reason)).lower()


class Newton:
    """SNES for one body, and what happened in the present solve.

    Args:
        forms: energy and residual.
        tangent: stays owned by the caller.
        options: tolerance, limits, search.
    """

    def __init__(self, forms: Forms, tangent: Tangent, options: NewtonOptions) -> None:
        self.forms, self.space, self.tangent, self.options = forms, forms.space, tangent, options
        self.search: Search = options.search
        if forms.space.mixed and options.search == "energy":
            self.search = "full"
        self._residual, self._x = tangent.matrix.createVecLeft(), tangent.matrix.createVecRight()
        self._local: CellElimination | None = None
        self._secants = Secants(forms.space.dot)
        self._snes = self._make_snes()
        self._find_scales()
        self.start_count()

    def _make_snes(self) -> Any:
        snes = PETSc.SNES().create(self.space.comm)
        snes.setOptionsPrefix(f"softtwin_{next(_prefixes)}_")
        snes.setType("newtonls")
        snes.setFunction(self._function, self._residual)
        snes.setJacobian(self._jacobian, self.tangent.matrix)
        snes.setLineSearchPreCheck(self._precheck)
        snes.setConvergenceTest(self._test)
        snes.setKSP(self.tangent.linear.ksp)
        _set_line_search(snes, self.search if self.search in ("bt", "l2", "cp") else "basic")
        return snes

    def forget(self) -> None:
        """The material has changed: tangent and scales are none of it any more."""
        self.tangent.assemble_at_rest()
        self._find_scales()

    def _find_scales(self) -> None:
        """What rounding can be told by; the matrix is the tangent at rest."""
        self._stiffness = float(self.tangent.matrix.norm(PETSc.NormType.NORM_INFINITY))
        nothing = np.zeros(self.space.owned)
        stresses = self.forms.internal(nothing)  # what ligaments pull at rest is none of it
        stresses[self.space.fixed] = 0.0
        at_rest = self.space.norm(stresses)
        self._round_off = _EPSILONS * at_rest  # what rounding leaves of the stresses of a body at rest
        self._force_noise = force_rounding(self.forms)
        self._energy_noise = _strain_rounding(self.forms) * self.space.body.volume

    def start_count(self) -> None:
        """Forget the counts and the trace of the last solve."""
        self.tangent.factorisations = self.local_iterations = 0
        self.trace: list[Iteration] = []

    def run(
        self, load: DiscreteLoad, start: Floats, factor: float = 1.0, eliminate: bool = False, near: bool = False
    ) -> Attempt:
        """Iterate from a start whose held unknowns are where they should be.

        Args:
            load: the load.
            start: unknowns to start from.
            factor: part of the full load that this is, for the trace.
            eliminate: balance few cells alone where a step is cut, a few times; then give up.
            near: the tangent that is known is that of a state nearby: it is kept from the first iteration on.
        """
        self.tangent.suit(load)
        self._snes.setKSP(self.tangent.linear.ksp)
        self._load, self._factor = load, factor
        self._norms: list[float] = []
        self._search_failed, self._is_met = False, False
        self._eliminations = 0 if eliminate and self._can_eliminate else None
        self._length = 1.0
        self._reached: float | None = None  # potential where the last step led
        self._is_near = near
        self._secants.clear()
        self._start_tolerance(load)
        self._x.array[:] = start
        self.tangent.linear.loosen()
        with _interrupts():
            self._snes.solve(None, self._x)
        reason, iterations = int(self._snes.getConvergedReason()), self._snes.getIterationNumber()
        residual = float(self._norms[-1]) if self._norms else np.nan  # SNES gives up at once on a start inside out
        if reason > 0 and not self._is_met:  # newer versions of PETSc take a step of no length for the end
            reason = int(PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH)
        return Attempt(np.array(self._x.array_r), reason > 0, reason, iterations, residual)

    def _start_tolerance(self, load: DiscreteLoad) -> None:
        self._scale = self.space.norm(load.dead)
        for ligament in self.forms.ligaments:
            self._scale = max(self._scale, self.space.norm(ligament.forces(np.zeros(self.space.owned))))
        if load.pressure:
            pressed = self.forms.residual(np.zeros(self.space.owned), load)
            pressed[self.space.fixed] = 0.0
            self._scale = max(self._scale, self.space.norm(pressed))
        self._moves_supports = self.space.dot(load.lift, load.lift) > 0.0
        self._absolute_tolerance = max(self.options.tolerance * self._scale, self._round_off)

    def _count_reactions(self) -> None:
        """Where supports are moved, the forces that they need are forces too."""
        scale = max(self._scale, self.space.norm(self.forms.reactions))
        self._absolute_tolerance = max(self.options.tolerance * scale, self._round_off)

    # ------------------------------------------------------------------ the four things SNES asks for

    def _function(self, snes: Any, x: Any, f: Any) -> None:
        values = self.forms.residual(np.array(x.array_r), self._load)
        if self._moves_supports:
            self._count_reactions()
        if self.search != "energy" and not np.isfinite(self.forms.energy(np.array(x.array_r))):
            values[:] = np.nan  # PETSc's searches shorten a step that leads there
        f.array[:] = values

    def _jacobian(self, snes: Any, x: Any, tangent: Any, preconditioner: Any) -> None:
        if not self._keeps_factorisation():
            self.tangent.assemble(np.array(x.array_r), self._load)

    def _keeps_factorisation(self) -> bool:
        """Whether the last factorisation, at the rate of the last iteration, is soon enough at the tolerance."""
        if not self.options.chord or not self.tangent.is_known:
            return False
        if len(self._norms) < 2:
            return self._is_near
        rate = self._norms[-1] / self._norms[-2]
        return rate < 1.0 and self._absolute_tolerance >= rate**_CHORD_STEPS * self._norms[-1]

    def _test(self, snes: Any, iteration: int, norms: tuple[float, float, float]) -> int:
        reasons = PETSc.SNES.ConvergedReason
        norm = norms[2]
        self._norms.append(norm)
        self.trace.append(
            Iteration(self._factor, iteration, norm, self._reached, self._length, self.tangent.factorisations)
        )
        if not np.isfinite(norm):
            return reasons.DIVERGED_FNORM_NAN
        self._is_met = norm <= self._absolute_tolerance or self._is_round_off(snes)
        if self._is_met:
            return reasons.CONVERGED_FNORM_ABS if norm <= self._absolute_tolerance else reasons.CONVERGED_SNORM_RELATIVE
        if self._search_failed:
            return reasons.DIVERGED_LINE_SEARCH
        return reasons.DIVERGED_MAX_IT if iteration >= self.options.max_iterations else reasons.ITERATING

    def _is_round_off(self, snes: Any) -> bool:
        """The residual falls no more, and what is left of it is the rounding of strains and of K u."""
        stuck = self._search_failed or (len(self._norms) > 1 and self._norms[-1] > 0.5 * self._norms[-2])
        if not stuck:
            return False
        rounded = _EPSILONS * np.finfo(float).eps * self._stiffness * snes.getSolution().norm()
        return bool(self._norms[-1] <= self._force_noise + rounded)

    def _precheck(self, x: Any, y: Any) -> bool:
        """Shorten (or turn) the Newton direction; SNES then takes x - y whole, or its own search goes on from there."""
        unknowns, step = np.array(x.array_r), self.tangent.linear.finished(np.array(y.array_r))
        if self.search in ("bt", "l2", "cp"):
            y.array[:] = step
            return True
        if self.search == "full":
            self._length = self._admissible(unknowns, step)
        else:
            residual = np.array(self._residual.array_r)  # SNES left it in there
            if self.options.chord and self.tangent.linear.method != "multigrid":
                step = self._secants.improved(unknowns, residual, step, self.tangent.factorisations)
            self._length = self._downhill(unknowns, step, residual)
        self._search_failed = self._length == 0.0
        y.array[:] = self._length * step
        if self._eliminations is not None and 0.0 < abs(self._length) < _CUT_STEP:
            self._eliminations += 1
            self._search_failed = self._eliminations > _MOST_ELIMINATIONS
            if not self._search_failed:
                y.array[:] = unknowns - self._eliminated(unknowns - self._length * step)
        return True

    @property
    def _can_eliminate(self) -> bool:
        return self.options.elimination and self.search == "energy" and self.space.comm.size == 1

    def _eliminated(self, unknowns: Floats) -> Floats:
        """Unknowns at which the cells most out of balance are in balance with the others where they are."""
        if self._local is None:
            self._local = CellElimination(self.space, self.forms.cells)
        residual = self._free_residual(unknowns)
        patch = self._local.around(residual)
        enough = _LOCAL_TOLERANCE * np.linalg.norm(residual[patch.unknowns])
        for _ in range(_LOCAL_STEPS):
            step = patch.step(unknowns, residual)
            length = self._downhill(unknowns, step, residual)
            if length == 0.0:
                break
            unknowns = unknowns - length * step
            self.local_iterations += 1
            residual = self._free_residual(unknowns)
            if np.linalg.norm(residual[patch.unknowns]) <= enough:
                break
        return unknowns

    def _admissible(self, unknowns: Floats, step: Floats) -> float:
        length = 1.0
        while length > _SMALLEST_STEP:
            if np.isfinite(self.forms.energy(unknowns - length * step)):
                return length
            length /= 2.0
        return 0.0

    def _downhill(self, unknowns: Floats, step: Floats, residual: Floats) -> float:
        """How much of a step lowers the energy enough: less than nothing where an indefinite tangent points uphill."""
        if not self.space.dot(step, step) < np.inf:
            return 0.0
        slope = -self.space.dot(residual, step)
        if slope > 0.0:
            return -self._armijo(unknowns, -step, -slope)
        return self._armijo(unknowns, step, slope)

    def _free_residual(self, unknowns: Floats) -> Floats:
        residual = self.forms.residual(unknowns, self._load)
        residual[self.space.fixed] = 0.0
        return residual

    def _armijo(self, unknowns: Floats, step: Floats, slope: float) -> float:
        """Armijo's rule on the energy with quadratic interpolation; a step that turns a cell inside out is refused."""
        forms, load = self.forms, self._load
        start: float = forms.potential(unknowns, load) if self._reached is None else self._reached
        noise = self._energy_noise + _ROUND_OFF * (abs(start) + abs(self.space.dot(load.dead, unknowns)))
        length = 1.0
        while length > _SMALLEST_STEP:
            reached = forms.potential(unknowns - length * step, load)
            change = reached - start - forms.pressure_work(unknowns, -length * step, load)
            if change <= float(_ARMIJO * length * slope) + noise:
                self._reached = reached
                return length
            best = -slope * length / (2.0 * (change / length - slope)) if np.isfinite(change) else 0.5 * length
            length = float(np.clip(best, 0.1 * length, 0.5 * length))
        return 0.0

    def close(self) -> None:
        """Free the PETSc objects."""
        for item in (self._snes, self._residual, self._x):
            item.destroy()


def _set_line_search(snes: Any, name: str) -> None:
    options = PETSc.Options()
    key = snes.getOptionsPrefix() + "snes_linesearch_type"
    options[key] = name
    snes.setFromOptions()
    options.delValue(key)


@contextmanager
def _interrupts() -> Iterator[None]:
    """Let an exception raised inside a PETSc callback (Ctrl-C above all) leave as itself."""
    try:
        yield
    except PETSc.Error as error:
        cause = error.__cause__ or error.__context__
        if isinstance(cause, KeyboardInterrupt):
            raise cause from None
        raise


def force_rounding(forms: Forms) -> float:
    """What rounding leaves of nodal forces that balance, newtons.

    F is 1 + grad u: its rounding is a strain, and a random force at each node on the area that belongs to it.
    """
    body = forms.space.body
    nodes, dimension = body.points.shape
    return _strain_rounding(forms) * float((body.volume / nodes) ** (1 - 1 / dimension) * nodes**0.5)


def _strain_rounding(forms: Forms) -> float:
    """Stress of a strain as large as rounding, pascals."""
    return float(_EPSILONS * np.finfo(float).eps) * forms.stiffness_scale()
