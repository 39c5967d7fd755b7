"""Linear algebra by size and shape: band Cholesky for slender bodies, MUMPS for others, multigrid for large ones."""

from __future__ import annotations

import itertools
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..fem.discretisation import Discretisation, rigid_motions
from ..fem.fenicsx import PETSc, ghosted_vector
from .band import BandFactor, band_order

Floats = NDArray[np.float64]
Method = Literal["auto", "band", "mumps", "multigrid"]
METHODS = ("auto", "band", "mumps", "multigrid")

# Unknowns in space above which multigrid is faster than MUMPS (benchmarks/growth.py).
_DIRECT_LIMIT = 40_000
_RELATIVE_TOLERANCE = 1e-10
_NEWTON_TOLERANCE = 1e-3  # of the linear solves within Newton's method


def chosen_method(method: Method, space: Discretisation, symmetric: bool = True) -> Method:
    """What was asked for, or what suits a body's size; `band` still looks at its shape.

    Raises:
        ValueError: multigrid for a problem with pressures as unknowns, band for a mesh that is shared.
    """
    if space.mixed and method == "multigrid":
        raise ValueError(
            "NewtonOptions.linear: expected 'mumps' for an incompressible material, got 'multigrid': "
            "its tangent is indefinite."
        )
    if space.comm.size > 1 and method == "band":
        raise ValueError("NewtonOptions.linear: expected 'mumps' or 'multigrid' for a shared mesh, got 'band'.")
    if space.mixed or (method == "band" and not symmetric):
        return "mumps"
    if method != "auto":
        return method
    if space.body.dimension == 3 and space.size > _DIRECT_LIMIT:
        return "multigrid"
    return "band" if symmetric and space.comm.size == 1 else "mumps"


class LinearSolver:
    """Solutions of K x = b for one matrix whose values change; a symbolic factorisation is kept.

    Args:
        matrix: the PETSc matrix.
        space: the body's discretisation.
        method: `band`, `mumps` or `multigrid`; `band` means MUMPS for a body that is not slender.
        symmetric: MUMPS factors L D L^T, which is cheaper than L U and counts negative pivots.
        turns: rotations cost next to no energy (elasticity), and not translations alone (Poisson's problem).
    """

    def __init__(
        self,
        matrix: Any,
        space: Discretisation,
        method: Method,
        symmetric: bool = True,
        turns: bool = True,
    ) -> None:
        self.matrix, self.method, self.symmetric = matrix, method, symmetric
        self._space, self._turns = space, turns
        self.ksp = PETSc.KSP().create(space.comm)
        self._near_null: Any = None
        self._keys: list[str] = []
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        matrix.setOption(PETSc.Mat.Option.SYMMETRY_ETERNAL, symmetric)
        self._band: _Band | None = None
        self.ksp.setOperators(matrix)
        if method == "multigrid":
            self._use_multigrid()
        else:
            order = self._order() if method == "band" else None
            if order is None:
                _use_mumps(self.ksp, symmetric)
            else:
                self._use_band(order)

    def _order(self) -> NDArray[np.int64] | None:
        """The order of elimination for a band, found once for a body; None where it is not slender."""
        space = self._space
        if space.band_order is None:
            found = band_order(self.matrix, space.body.points, space.nodes)
            space.band_order = np.empty(0, dtype=np.int64) if found is None else found
        return space.band_order if len(space.band_order) else None

    def _use_band(self, order: NDArray[np.int64]) -> None:
        """Band factors stay outside of PETSc, whose Python preconditioners crash when an interpreter ends."""
        self._band = _Band(BandFactor(self.matrix, order), self.matrix)
        self.ksp.setType("preonly")
        self.ksp.getPC().setType("none")

    def _use_multigrid(self) -> None:
        """Smoothed aggregation that knows the rigid motions (Vanek, Mandel and Brezina 1996)."""
        self._set_near_nullspace()
        self.ksp.setType("cg" if self.symmetric else "gmres")
        self.ksp.setTolerances(rtol=_RELATIVE_TOLERANCE, max_it=500)
        pc = self.ksp.getPC()
        pc.setType("gamg")
        self._keys = _set_options(
            pc,
            {
                "pc_gamg_type": "agg",
                "pc_gamg_agg_nsmooths": 1,
                "pc_gamg_threshold": 0.01,
                "pc_gamg_reuse_interpolation": True,
                "mg_levels_ksp_type": "chebyshev",
                "mg_levels_pc_type": "jacobi",
                "mg_levels_ksp_max_it": 2,
            },
        )

    def _set_near_nullspace(self) -> None:
        space = self._space
        vectors: list[Floats] = []
        motions = rigid_motions(space.body.points)
        for motion in motions if self._turns else motions[: space.body.dimension]:
            values = space.unknowns("motion", motion)
            values[space.fixed] = 0.0
            for done in vectors:
                values -= space.dot(done, values) * done
            norm = space.norm(values)
            if norm > 1e-12:
                vectors.append(values / norm)
        basis = []
        for values in vectors:
            vector = ghosted_vector(space.space)
            vector.array[:] = values
            basis.append(vector)
        self._near_null = PETSc.NullSpace().create(vectors=basis, comm=space.comm)
        self.matrix.setNearNullSpace(self._near_null)
        for vector in basis:
            vector.destroy()

    def loosen(self) -> None:
        """Solve iteratively only as far as an iteration of Newton's method needs."""
        if self.method == "multigrid":
            self.ksp.setTolerances(rtol=_NEWTON_TOLERANCE)

    def tighten(self) -> None:
        """Solve iteratively to full accuracy."""
        if self.method == "multigrid":
            self.ksp.setTolerances(rtol=_RELATIVE_TOLERANCE)

    def prepare(self) -> None:
        """Factor the matrix (or build its multigrid) as it is now."""
        if self._band is not None:
            self._band.prepare()
            return
        self.ksp.setOperators(self.matrix)
        self.ksp.setUp()

    @property
    def cannot_solve(self) -> bool:
        """Whether what was factored last is singular."""
        if self._band is not None:
            return self._band.has_failed
        return self.method != "multigrid" and _has_failed(self.ksp)

    def finished(self, direction: Floats) -> Floats:
        """What SNES's own solver gave as a direction, with the work that was left outside of PETSc.

        Not finite where the matrix is singular.
        """
        if self._band is None:
            return direction
        self._band.prepare()
        return self._band.solve(direction[None])[0]

    def solve(self, rows: Floats, transpose: bool = False) -> Floats:
        """K^-1 applied to each row, (k, owned unknowns).

        Raises:
            RuntimeError: the iterative solver did not converge, or the matrix is singular.
        """
        self.tighten()
        self.prepare()
        if self.cannot_solve:
            raise RuntimeError("LinearSolver.solve: expected a matrix that can be inverted, got a singular one.")
        if self._band is not None:
            return self._band.solve(rows)
        if self.method != "multigrid" and len(rows) > 1 and self._space.comm.size == 1 and not transpose:
            return _solve_dense(self.ksp, rows)
        b, x = self.matrix.createVecLeft(), self.matrix.createVecRight()
        out = np.empty_like(rows)
        for i, row in enumerate(rows):
            b.array[:] = row
            (self.ksp.solveTranspose if transpose and not self.symmetric else self.ksp.solve)(b, x)
            if self.ksp.getConvergedReason() < 0:
                raise RuntimeError(
                    f"LinearSolver.solve: {self.method} did not converge in {self.ksp.getIterationNumber()} "
                    "iterations; NewtonOptions(linear='mumps') may."
                )
            out[i] = x.array_r
        b.destroy()
        x.destroy()
        return out

    def negative_pivots(self) -> int | None:
        """Negative eigenvalues of the matrix, as many as D has (Sylvester); None where nothing was factored."""
        if self.method == "multigrid" or not self.symmetric:
            return None
        self.prepare()
        return _pivots(self.ksp) if self._band is None else self._band.negative_pivots()

    def close(self) -> None:
        """Free the PETSc objects, the matrix excepted."""
        if self._band is not None:
            self._band.close()
        if self._near_null is not None:
            self._near_null.destroy()
        for key in self._keys:
            PETSc.Options().delValue(key)
        self.ksp.destroy()


class _Band:
    """A band factor of a matrix that changes; where it is not positive definite MUMPS factors it."""

    def __init__(self, factor: BandFactor, matrix: Any) -> None:
        self._factor, self._matrix = factor, matrix
        self._factored: int | None = None
        self._definite = True
        self._mumps: Any = None

    def prepare(self) -> None:
        """Factor the matrix unless it has been as it is."""
        state = self._matrix.stateGet()
        if state == self._factored:
            return
        self._factored = None
        self._definite = self._factor.factor(self._matrix)
        if not self._definite:
            if self._mumps is None:
                self._mumps = PETSc.KSP().create(self._matrix.comm)
                _use_mumps(self._mumps, symmetric=True)
            self._mumps.setOperators(self._matrix)
            self._mumps.setUp()
        self._factored = state

    def solve(self, rows: Floats) -> Floats:
        """The inverse applied to each row; NaN where MUMPS could not factor the matrix either."""
        if self._definite:
            return self._factor.solve(rows)
        return np.full_like(rows, np.nan) if self.has_failed else _solve_dense(self._mumps, rows)

    @property
    def has_failed(self) -> bool:
        """True where MUMPS could not factor the matrix either."""
        return not self._definite and _has_failed(self._mumps)

    def negative_pivots(self) -> int:
        return 0 if self._definite else _pivots(self._mumps)

    def close(self) -> None:
        if self._mumps is not None:
            self._mumps.destroy()


def _use_mumps(ksp: Any, symmetric: bool) -> None:
    ksp.setType("preonly")
    ksp.getPC().setType("cholesky" if symmetric else "lu")
    ksp.getPC().setFactorSolverType("mumps")


def _has_failed(ksp: Any) -> bool:
    return int(ksp.getPC().getFactorMatrix().getMumpsInfog(1)) < 0


def _pivots(ksp: Any) -> int:
    return int(ksp.getPC().getFactorMatrix().getMumpsInfog(12))


def _solve_dense(ksp: Any, rows: Floats) -> Floats:
    """MUMPS's inverse applied to each row, on one rank."""
    count, unknowns = rows.shape
    b = PETSc.Mat().createDense((unknowns, count), array=np.array(rows).ravel(), comm=ksp.comm)
    x = PETSc.Mat().createDense((unknowns, count), comm=ksp.comm)
    x.setUp()
    ksp.getPC().getFactorMatrix().matSolve(b, x)
    result = x.getDenseArray().T.copy()
    b.destroy()
    x.destroy()
    return np.asarray(result)


_count = itertools.count()


def _set_options(pc: Any, values: dict[str, Any]) -> list[str]:
    """Set options of one preconditioner, which reads some of them when it is built: their keys, to be deleted then."""
    prefix = f"softtwin_pc_{next(_count)}_"
    pc.setOptionsPrefix(prefix)
    options = PETSc.Options()
    for name, value in values.items():
        options[prefix + name] = value
    pc.setFromOptions()
    return [prefix + name for name in values]
