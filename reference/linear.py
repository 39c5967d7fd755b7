"""Linear algebra by size: MUMPS for small bodies, conjugate gradients with algebraic multigrid for large ones."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .discretisation import Discretisation, rigid_motions
from .fenicsx import PETSc, ghosted_vector

Floats = NDArray[np.float64]
Method = Literal["auto", "direct", "multigrid"]
METHODS = ("auto", "direct", "multigrid")

# Unknowns in space above which multigrid is faster than MUMPS (benchmarks/growth.py).
_DIRECT_LIMIT = 40_000
_RELATIVE_TOLERANCE = 1e-10
_NEWTON_TOLERANCE = 1e-3  # of the linear solves within Newton's method


def chosen_method(method: Method, space: Discretisation, symmetric: bool = True) -> Method:
    """`direct` or `multigrid` for a body: what was asked for, or what suits its size.

    Raises:
        ValueError: multigrid for a problem with pressures as unknowns.
    """
    if space.mixed:
        if method == "multigrid":
            raise ValueError(
                "NewtonOptions.linear: expected 'direct' for an incompressible material, got 'multigrid': "
                "its tangent is indefinite."
            )
        return "direct"
    if method != "auto":
        return method
    return "multigrid" if space.body.dimension == 3 and space.size > _DIRECT_LIMIT else "direct"


class LinearSolver:
    """Solutions of K x = b for one matrix whose values change; a symbolic factorisation is kept.

    Args:
        matrix: the PETSc matrix.
        space: the body's discretisation.
        method: `direct` or `multigrid`.
        ksp: the solver to set up, SNES's own for instance; a new one if not given.
        symmetric: MUMPS factors L D L^T, which is cheaper than L U and counts negative pivots.
    """

    def __init__(
        self, matrix: Any, space: Discretisation, method: Method, ksp: Any = None, symmetric: bool = True
    ) -> None:
        self.matrix, self.method, self.symmetric = matrix, method, symmetric
        self._space = space
        self.ksp = PETSc.KSP().create(space.comm) if ksp is None else ksp
        self._owns = ksp is None
        self._near_null: Any = None
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        matrix.setOption(PETSc.Mat.Option.SYMMETRY_ETERNAL, symmetric)
        self.ksp.setOperators(matrix)
        if method == "direct":
            self._use_mumps()
        else:
            self._use_multigrid()

    def _use_mumps(self) -> None:
        self.ksp.setType("preonly")
        pc = self.ksp.getPC()
        pc.setType("cholesky" if self.symmetric else "lu")
        pc.setFactorSolverType("mumps")

    def _use_multigrid(self) -> None:
        """Smoothed aggregation that knows the rigid motions (Vanek, Mandel and Brezina 1996)."""
        self._set_near_nullspace()
        self.ksp.setType("cg" if self.symmetric else "gmres")
        self.ksp.setTolerances(rtol=_RELATIVE_TOLERANCE, max_it=500)
        pc = self.ksp.getPC()
        pc.setType("gamg")
        _set_options(
            pc,
            {
                "pc_gamg_type": "agg",
                "pc_gamg_agg_nsmooths": 1,
                "pc_gamg_threshold": 0.01,
                "pc_gamg_reuse_interpolation": True,
                "mg_levels_ksp_type": "chebyshev",
                "mg_levels_pc_type": "jacobi",
                "mg_levels_ksp_max_it": 3,
                "mg_levels_esteig_ksp_type": "cg",
                "mg_levels_esteig_ksp_max_it": 10,
            },
        )

    def _set_near_nullspace(self) -> None:
        space = self._space
        vectors: list[Floats] = []
        for motion in rigid_motions(space.body.points):
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
        self.ksp.setOperators(self.matrix)
        self.ksp.setUp()

    def solve(self, rows: Floats, transpose: bool = False) -> Floats:
        """K^-1 applied to each row, (k, owned unknowns).

        Raises:
            RuntimeError: the iterative solver did not converge.
        """
        self.tighten()
        self.prepare()
        if self.method == "direct" and len(rows) > 1 and self._space.comm.size == 1 and not transpose:
            return self._solve_dense(rows)
        b, x = self.matrix.createVecLeft(), self.matrix.createVecRight()
        out = np.empty_like(rows)
        for i, row in enumerate(rows):
            b.array[:] = row
            (self.ksp.solveTranspose if transpose and not self.symmetric else self.ksp.solve)(b, x)
            if self.ksp.getConvergedReason() < 0:
                raise RuntimeError(
                    f"LinearSolver.solve: {self.method} did not converge in {self.ksp.getIterationNumber()} "
                    "iterations; NewtonOptions(linear='direct') may."
                )
            out[i] = x.array_r
        b.destroy()
        x.destroy()
        return out

    def _solve_dense(self, rows: Floats) -> Floats:
        count, unknowns = rows.shape
        factors = self.ksp.getPC().getFactorMatrix()
        b = PETSc.Mat().createDense((unknowns, count), array=rows.ravel(), comm=self._space.comm)
        x = PETSc.Mat().createDense((unknowns, count), comm=self._space.comm)
        x.setUp()
        factors.matSolve(b, x)
        result = x.getDenseArray().T.copy()
        b.destroy()
        x.destroy()
        return np.asarray(result)

    def negative_pivots(self) -> int | None:
        """Negative eigenvalues of the matrix, as many as D has (Sylvester); None where nothing was factored."""
        if self.method != "direct" or not self.symmetric:
            return None
        self.prepare()
        return int(self.ksp.getPC().getFactorMatrix().getMumpsInfog(12))

    def close(self) -> None:
        """Free the PETSc objects, the matrix excepted."""
        if self._near_null is not None:
            self._near_null.destroy()
        if self._owns:
            self.ksp.destroy()


_count = 0


def _set_options(pc: Any, values: dict[str, Any]) -> None:
    """Set options of one preconditioner and leave the database as it was."""
    global _count
    _count += 1
    prefix = f"softtwin_pc_{_count}_"
    pc.setOptionsPrefix(prefix)
    options = PETSc.Options()
    for name, value in values.items():
        options[prefix + name] = value
    pc.setFromOptions()
