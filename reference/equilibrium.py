"""Hyperelastic equilibria of a body: Newton's method with a search on the energy (PETSc SNES, MUMPS)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix

from softtwin.meshes.body import Body

from .fenicsx import (
    MPI,
    PETSc,
    assemble_matrix,
    assemble_vector,
    constant,
    create_matrix,
    create_mesh,
    dirichlet,
    fem,
    form,
    node_dofs,
    scalar,
    ufl,
    vector_space,
)
from .materials import Material
from .outcome import Equilibrium, NotConverged

Floats = NDArray[np.float64]

# One point is exact for the constant gradient of linear tetrahedra; 2 x 2 x 2 points integrate linear hexahedra fully.
_QUADRATURE_DEGREE = {4: 1, 8: 3}
_ARMIJO = 1e-4
_SMALLEST_STEP = 1e-8
_ROUND_OFF = 1e-12  # of the energy: differences below it say nothing about descent
_CHORD_RATE = 0.1  # a factorisation is kept while it divides the residual by ten an iteration
_prefixes = itertools.count()


@dataclass(frozen=True)
class NewtonOptions:
    """How far and how long to iterate.

    Args:
        tolerance: norm of the residual over free unknowns, relative to the norm of the forces.
        max_iterations: Newton iterations of one load step.
        max_load_steps: load steps tried, failed ones included, before giving up.
    """

    tolerance: float = 1e-8
    max_iterations: int = 60
    max_load_steps: int = 100

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"NewtonOptions.tolerance: expected a number in (0, 1), got {self.tolerance}.")
        for name in ("max_iterations", "max_load_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"NewtonOptions.{name}: expected at least 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class _Attempt:
    """One run of SNES: the unknowns it stopped at and how it ended."""

    unknowns: Floats
    converged: bool
    reason: int
    iterations: int
    residual: float


class Problem:
    """Equilibria of one body of one material under nodal forces, with its factorisations kept from solve to solve.

    The symbolic factorisation is made once for the body. Everything that enters or leaves is in the body's node order.
    Use it as a context manager or call `close`: PETSc objects do not free themselves.

    Args:
        body: the body; its `fixed` nodes do not move.
        material: strain energy.
        options: tolerance and limits of Newton's method.
    """

    def __init__(self, body: Body, material: Material, options: NewtonOptions | None = None) -> None:
        self.body = body
        self.material = material
        self.options = options or NewtonOptions()
        domain = create_mesh(body.points, body.cells)
        space = vector_space(domain)
        blocks = node_dofs(domain, space)
        self._index = (3 * blocks[:, None] + np.arange(3)).ravel()  # original unknown -> PETSc unknown
        self._fixed = np.sort((3 * blocks[body.fixed, None] + np.arange(3)).ravel()).astype(np.int32)
        self._bc = dirichlet(space, blocks[body.fixed])
        self._state = fem.Function(space)
        # What stresses rounded to machine precision leave of a residual that should vanish, newtons.
        self._round_off = float(64.0 * np.finfo(float).eps * material.young_modulus * body.size**2)
        self._compile(domain, space)
        self._prepare_solver()

    def _compile(self, domain: Any, space: Any) -> None:
        u = self._state
        dx = ufl.dx(domain, metadata={"quadrature_degree": _QUADRATURE_DEGREE[self.body.cells.shape[1]]})
        F = ufl.Identity(3) + ufl.grad(u)
        psi = self.material.energy(F, lambda value: constant(domain, value))
        # The vanishing term turns the energy into NaN where the body is turned inside out, for every material.
        guarded = psi + constant(domain, 0.0) * ufl.ln(ufl.det(F))
        residual = ufl.derivative(psi * dx, u, ufl.TestFunction(space))
        self._energy_form = form(guarded * dx)
        self._residual_form = form(residual)
        self._tangent_form = form(ufl.derivative(residual, u, ufl.TrialFunction(space)))
        laplacian = ufl.inner(ufl.grad(ufl.TrialFunction(space)), ufl.grad(ufl.TestFunction(space))) * dx
        self._laplacian_form = form(laplacian)
        self._warped_form = form(ufl.inner(_warped_gradient(ufl.grad(u)), ufl.grad(ufl.TestFunction(space))) * dx)

    def _prepare_solver(self) -> None:
        self._tangent = create_matrix(self._tangent_form)
        self._tangent.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._tangent.setOption(PETSc.Mat.Option.SYMMETRY_ETERNAL, True)
        self._residual = self._tangent.createVecLeft()
        self._x = self._tangent.createVecRight()
        self._forces = np.zeros(self._x.getLocalSize())
        self._factored_at: Floats | None = None
        self._rest_solvers: tuple[Any, Any] | None = None
        self._reset_run()
        snes = PETSc.SNES().create(MPI.COMM_SELF)
        snes.setOptionsPrefix(f"softtwin_{next(_prefixes)}_")
        snes.setType("newtonls")
        snes.setFunction(self._snes_function, self._residual)
        snes.setJacobian(self._snes_jacobian, self._tangent)
        snes.setLineSearchPreCheck(self._snes_precheck)
        snes.setConvergenceTest(self._snes_test)
        _use_cholesky(snes.getKSP())
        _set_line_search(snes)
        self._snes = snes

    def close(self) -> None:
        """Free the PETSc objects; the problem cannot be used after."""
        for item in (self._snes, self._tangent, self._residual, self._x):
            item.destroy()
        for solver in self._rest_solvers or ():
            solver.getOperators()[0].destroy()
            solver.destroy()

    def __enter__(self) -> Problem:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------------ the four things SNES asks for

    def _reset_run(self) -> None:
        self._norms: list[float] = []
        self._search_failed = False
        self._reached: float | None = None  # potential where the last step led
        self._factorisations = 0

    def _snes_function(self, snes: Any, x: Any, f: Any) -> None:
        self._assemble_residual(x.array_r, f)

    def _assemble_residual(self, unknowns: Floats, out: Any) -> None:
        self._state.x.array[:] = unknowns
        assemble_vector(out, self._residual_form)
        out.array[:] -= self._forces
        out.array[self._fixed] = unknowns[self._fixed]

    def _snes_jacobian(self, snes: Any, x: Any, tangent: Any, preconditioner: Any) -> None:
        if not self._keeps_factorisation():
            self._assemble_tangent(x.array_r)

    def _keeps_factorisation(self) -> bool:
        """Near the solution the last factorisation still converges: a chord step costs a tenth of a Newton step."""
        if self._factored_at is None or len(self._norms) < 3:
            return False
        return self._norms[-1] < _CHORD_RATE * self._norms[-2]

    def _assemble_tangent(self, unknowns: Floats) -> None:
        self._state.x.array[:] = unknowns
        self._factored_at = None
        assemble_matrix(self._tangent, self._tangent_form, [self._bc])
        self._factored_at = unknowns.copy()
        self._factorisations += 1

    def _snes_test(self, snes: Any, iteration: int, norms: tuple[float, float, float]) -> int:
        reasons = PETSc.SNES.ConvergedReason
        norm = norms[2]
        self._norms.append(norm)
        if not np.isfinite(norm):
            return reasons.DIVERGED_FNORM_NAN
        if norm <= self._absolute_tolerance:
            return reasons.CONVERGED_FNORM_ABS
        if self._search_failed:
            return reasons.DIVERGED_LINE_SEARCH
        return reasons.DIVERGED_MAX_IT if iteration >= self._iteration_limit else reasons.ITERATING

    def _snes_precheck(self, x: Any, y: Any) -> bool:
        """Shorten (or turn) the Newton direction until the energy decreases enough; SNES then takes x - y whole."""
        unknowns, step = x.array_r, y.array.copy()
        slope = -float(self._residual.array_r @ step)  # SNES has left the residual at x in the vector it was given
        if slope > 0.0:  # an indefinite tangent may point uphill
            step, slope = -step, -slope
        length = self._search(unknowns, step, slope)
        self._search_failed = length == 0.0
        y.array[:] = length * step
        return True

    def _search(self, unknowns: Floats, step: Floats, slope: float) -> float:
        """Armijo's rule on the energy with quadratic interpolation; a step that turns a cell inside out is refused."""
        start = self._potential(unknowns) if self._reached is None else self._reached
        noise = _ROUND_OFF * (abs(start) + abs(float(self._forces @ unknowns)))
        length = 1.0
        while length > _SMALLEST_STEP:
            change = self._potential(unknowns - length * step) - start
            if change <= _ARMIJO * length * slope + noise:
                self._reached = start + change
                return length
            best = -slope * length / (2.0 * (change / length - slope)) if np.isfinite(change) else 0.5 * length
            length = float(np.clip(best, 0.1 * length, 0.5 * length))
        return 0.0

    def _potential(self, unknowns: Floats) -> float:
        self._state.x.array[:] = unknowns
        return scalar(self._energy_form) - float(self._forces @ unknowns)

    # ------------------------------------------------------------------ equilibria

    def solve(
        self, forces: ArrayLike, guess: ArrayLike | None = None, *, stability: bool = True, fallback: bool = True
    ) -> Equilibrium:
        """The displacement that balances nodal forces.

        Tries the full load from the guess, then from the warped linear response, then from rest, then in load steps
        that are halved where they fail.

        Args:
            forces: nodal forces, (n, 3), newtons; those at fixed nodes do no work and are ignored.
            guess: displacement to start from, (n, 3), metres; the warped linear response if not given.
            stability: also factor the tangent at the state and count its negative pivots.
            fallback: try the other ways where the first start fails; without, a failure is raised at once.

        Raises:
            ValueError: wrong shape, NaN or infinity.
            NotConverged: neither way led to an equilibrium.
        """
        load = self._to_unknowns("forces", forces)
        load[self._fixed] = 0.0
        given = None if guess is None else self._to_unknowns("guess", guess)
        self._reset_run()
        spent = 0
        for start in self._starts(load, given):
            attempt = self._run(load, start)
            spent += attempt.iterations
            if attempt.converged:
                return self._result(replace(attempt, iterations=spent), load_steps=1, stability=stability)
            if not fallback:
                raise NotConverged(f"Problem.solve: no equilibrium near the guess ({_reason_name(attempt.reason)}).")
        return self._solve_in_steps(load, spent, stability)

    def _starts(self, load: Floats, guess: Floats | None) -> Iterator[Floats]:
        if guess is not None:
            guess[self._fixed] = 0.0
            yield guess
        yield self._warped_response(load)
        yield np.zeros_like(load)

    def _warped_response(self, load: Floats) -> Floats:
        """The linear response with its rotations made finite: the field whose gradient is closest to exp(W)(I + e) - I.

        On a beam bent by a quarter of its length its energy is within 2 % of the equilibrium's, where the linear
        response is 25 times off. Same idea as modal warping (Choi and Ko 2005), by a Poisson problem instead of modes.
        """
        rest, poisson = self._prepared_rest()
        self._state.x.array[:] = _solve_with(rest, load)
        assemble_vector(self._residual, self._warped_form)
        self._residual.array[self._fixed] = 0.0
        return _solve_with(poisson, self._residual.array)

    def _prepared_rest(self) -> tuple[Any, Any]:
        if self._rest_solvers is None:
            self._state.x.array[:] = 0.0
            forms = (self._tangent_form, self._laplacian_form)
            self._rest_solvers = tuple(self._factored(compiled) for compiled in forms)
        return self._rest_solvers

    def _factored(self, compiled: Any) -> Any:
        matrix = create_matrix(compiled)
        assemble_matrix(matrix, compiled, [self._bc])
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        solver = PETSc.KSP().create(MPI.COMM_SELF)
        solver.setOperators(matrix)
        _use_cholesky(solver)
        solver.setUp()
        return solver

    def _run(self, load: Floats, start: Floats) -> _Attempt:
        self._forces = load
        self._norms = []
        self._search_failed = False
        self._reached = None
        self._absolute_tolerance = max(self.options.tolerance * float(np.linalg.norm(load)), self._round_off)
        self._iteration_limit = self.options.max_iterations
        start = self._no_worse_than_rest(start)
        self._x.array[:] = start
        with _interrupts():
            self._snes.solve(None, self._x)
        reason = int(self._snes.getConvergedReason())
        return _Attempt(
            self._x.array.copy(), reason > 0, reason, self._snes.getIterationNumber(), float(self._norms[-1])
        )

    def _no_worse_than_rest(self, start: Floats) -> Floats:
        for scale in (1.0, 0.5, 0.25):
            if self._potential(scale * start) <= 0.0:
                return scale * start
        return np.zeros_like(start)

    def _solve_in_steps(self, load: Floats, spent: int, stability: bool) -> Equilibrium:
        reached, step, good = 0.0, 0.25, 0
        state = np.zeros_like(load)
        for _ in range(self.options.max_load_steps):
            target = min(1.0, reached + step)
            attempt = self._run(target * load, state)
            spent += attempt.iterations
            if not attempt.converged:
                step /= 2.0
                continue
            reached, state, good = target, attempt.unknowns, good + 1
            step *= 1.5
            if reached == 1.0:
                return self._result(replace(attempt, iterations=spent), load_steps=good, stability=stability)
        raise NotConverged(
            f"Problem.solve: no equilibrium after {spent} Newton iterations in {self.options.max_load_steps} load "
            f"steps; {100 * reached:.1f} % of the load was reached (last reason: {_reason_name(attempt.reason)}). "
            "Try a smaller load, a finer mesh where it acts, or more max_load_steps."
        )

    def _result(self, attempt: _Attempt, load_steps: int, stability: bool) -> Equilibrium:
        energy = self._potential(attempt.unknowns)
        pivots = self._negative_pivots_at(attempt.unknowns) if stability else None
        return Equilibrium(
            displacement=attempt.unknowns[self._index].reshape(-1, 3),
            energy=energy,
            residual=attempt.residual,
            iterations=attempt.iterations,
            factorisations=self._factorisations,
            load_steps=load_steps,
            reason=_reason_name(attempt.reason),
            negative_pivots=pivots,
        )

    # ------------------------------------------------------------------ the tangent at a state

    def energy(self, displacement: ArrayLike) -> float:
        """Strain energy of a displacement (n, 3), joules; NaN where a cell is inside out."""
        self._state.x.array[:] = self._to_unknowns("displacement", displacement)
        return scalar(self._energy_form)

    def internal_forces(self, displacement: ArrayLike) -> Floats:
        """Derivative of the strain energy: the nodal forces that hold a displacement, (n, 3), newtons."""
        self._state.x.array[:] = self._to_unknowns("displacement", displacement)
        assemble_vector(self._residual, self._residual_form)
        return self._residual.array[self._index].reshape(-1, 3)

    def stiffness(self, displacement: ArrayLike | None = None) -> csr_matrix:
        """Tangent stiffness in the body's order, (3n, 3n), N/m; rows and columns of fixed nodes are the identity's."""
        self._factorise(displacement)
        indptr, indices, data = self._tangent.getValuesCSR()
        matrix = csr_matrix((data, indices, indptr), shape=self._tangent.getSize())
        return matrix[self._index][:, self._index]

    def apply_inverse(self, columns: ArrayLike, displacement: ArrayLike | None = None) -> Floats:
        """K(u)^-1 applied to many right-hand sides with one factorisation.

        Args:
            columns: nodal forces or cotangents, (3n, k) or (3n,), in the body's order.
            displacement: state u, (n, 3), metres; rest if not given. The last factorisation is used again where it was
                made at the same state.
        """
        right = np.asarray(columns, dtype=np.float64)
        unknowns = 3 * len(self.body.points)
        if right.shape[0] != unknowns or right.ndim > 2:
            raise ValueError(f"apply_inverse.columns: expected shape ({unknowns}, k), got {right.shape}.")
        self._factorise(displacement)
        stacked = right.reshape(unknowns, -1)
        dense = np.zeros((stacked.shape[1], unknowns))  # its transpose is column-major, as PETSc wants it
        dense[:, self._index] = stacked.T
        dense[:, self._fixed] = 0.0
        solution = self._solve_dense(dense)
        return solution[:, self._index].T.reshape(right.shape)

    def _solve_dense(self, rows: Floats) -> Floats:
        count, unknowns = rows.shape
        factors = self._snes.getKSP().getPC().getFactorMatrix()
        if count == 1:
            b, x = PETSc.Vec().createWithArray(rows[0], comm=MPI.COMM_SELF), self._tangent.createVecRight()
            factors.solve(b, x)
            result = x.array.copy()[None]
        else:
            b = PETSc.Mat().createDense((unknowns, count), array=rows.ravel(), comm=MPI.COMM_SELF)
            x = PETSc.Mat().createDense((unknowns, count), comm=MPI.COMM_SELF)
            x.setUp()
            factors.matSolve(b, x)
            result = x.getDenseArray().T.copy()
        b.destroy()
        x.destroy()
        return result

    def negative_pivots(self, displacement: ArrayLike | None = None) -> int:
        """Negative pivots of the tangent at a state: 0 where it is stable."""
        state = np.zeros(len(self._forces)) if displacement is None else self._to_unknowns("displacement", displacement)
        return self._negative_pivots_at(state)

    def _negative_pivots_at(self, unknowns: Floats) -> int:
        self._factorise_at(unknowns)
        return int(self._snes.getKSP().getPC().getFactorMatrix().getMumpsInfog(12))

    def _factorise(self, displacement: ArrayLike | None) -> None:
        state = np.zeros(len(self._forces)) if displacement is None else self._to_unknowns("displacement", displacement)
        self._factorise_at(state)

    def _factorise_at(self, unknowns: Floats) -> None:
        if self._factored_at is None or not np.array_equal(self._factored_at, unknowns):
            self._assemble_tangent(unknowns)
        pc = self._snes.getKSP().getPC()
        pc.setOperators(self._tangent, self._tangent)
        pc.setUp()

    def _to_unknowns(self, name: str, field: ArrayLike) -> Floats:
        values = np.asarray(field, dtype=np.float64)
        expected = (len(self.body.points), 3)
        if values.shape != expected:
            raise ValueError(f"Problem.{name}: expected shape {expected}, got {values.shape}.")
        if not np.isfinite(values).all():
            raise ValueError(f"Problem.{name}: expected finite numbers, got NaN or infinity.")
        unknowns = np.empty(values.size)
        unknowns[self._index] = values.ravel()
        return unknowns


def _warped_gradient(G: Any) -> Any:
    """exp(W)(I + e) - I for a displacement gradient G = e + W (Rodrigues' formula)."""
    identity = ufl.Identity(3)
    W = ufl.skew(G)
    angle = ufl.sqrt(ufl.inner(W, W) / 2 + 1e-12)
    rotation = identity + ufl.sin(angle) / angle * W + (1 - ufl.cos(angle)) / angle**2 * W * W
    return rotation * (identity + ufl.sym(G)) - identity


def _use_cholesky(solver: Any) -> None:
    solver.setType("preonly")
    solver.getPC().setType("cholesky")
    solver.getPC().setFactorSolverType("mumps")


def _solve_with(solver: Any, right: Floats) -> Floats:
    b, x = (PETSc.Vec().createWithArray(values, comm=MPI.COMM_SELF) for values in (right.copy(), np.empty_like(right)))
    solver.solve(b, x)
    result = x.array.copy()
    b.destroy()
    x.destroy()
    return result


def _set_line_search(snes: Any) -> None:
    """Give SNES its `basic` search: the step comes shortened from the pre-check."""
    options = PETSc.Options()
    key = snes.getOptionsPrefix() + "snes_linesearch_type"
    options[key] = "basic"
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


def _reason_name(reason: int) -> str:
    names = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
    return names.get(reason, str(reason)).lower()
