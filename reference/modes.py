"""Eigenmodes of the stiffness at rest (SLEPc), the shapes that loads are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from slepc4py import SLEPc

from .equilibrium import Problem
from .fenicsx import MPI, PETSc

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Modes:
    """Eigenpairs K(0) phi = lambda phi on the free unknowns.

    Args:
        eigenvalues: ascending, (k,), N/m.
        shapes: (k, n, 3), zero at fixed nodes, largest nodal displacement 1, largest component positive.
    """

    eigenvalues: Floats
    shapes: Floats


def eigenmodes(problem: Problem, count: int) -> Modes:
    """The softest eigenmodes of a problem at rest (Odot 2023, eq. 4.3).

    The count is checked by Sylvester's inertia, so that no mode of a multiple eigenvalue is missed.

    Args:
        problem: body and material.
        count: how many modes.

    Raises:
        ValueError: count out of range.
        RuntimeError: SLEPc did not converge, or inertia disagrees with the eigenvalues found.
    """
    unknowns = 3 * len(problem.body.free)
    if not 1 <= count < unknowns // 2:
        raise ValueError(f"eigenmodes.count: expected 1..{unknowns // 2 - 1} for {unknowns} unknowns, got {count}.")
    free = (3 * problem.body.free[:, None] + np.arange(3)).ravel()
    stiffness = problem.stiffness()[free][:, free].tocsr()
    matrix = PETSc.Mat().createAIJ(
        stiffness.shape, csr=(stiffness.indptr, stiffness.indices, stiffness.data), comm=MPI.COMM_SELF
    )
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    values, vectors = _smallest(matrix, count, min(unknowns, max(4 * count, count + 60)))
    _check_inertia(matrix, values, count)
    matrix.destroy()
    shapes = np.zeros((count, 3 * len(problem.body.points)))
    shapes[:, free] = vectors[:count]
    return Modes(values[:count], _normalised(shapes.reshape(count, -1, 3)))


def _smallest(matrix: PETSc.Mat, count: int, basis: int) -> tuple[Floats, Floats]:
    solver = SLEPc.EPS().create(MPI.COMM_SELF)
    solver.setOperators(matrix)
    solver.setProblemType(SLEPc.EPS.ProblemType.HEP)
    solver.setDimensions(nev=count + 1, ncv=basis)  # one more, so that the gap above the last mode is known
    solver.setTarget(0.0)
    solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    transform = solver.getST()
    transform.setType("sinvert")
    transform.getKSP().setType("preonly")
    transform.getKSP().getPC().setType("cholesky")
    transform.getKSP().getPC().setFactorSolverType("mumps")
    start = matrix.createVecRight()
    start.array[:] = np.random.default_rng(0).standard_normal(start.getLocalSize())  # the same modes every time
    solver.setInitialSpace([start])
    solver.solve()
    if solver.getConverged() < count + 1:
        raise RuntimeError(f"eigenmodes: SLEPc found {solver.getConverged()} of {count + 1} modes.")
    vector = matrix.createVecRight()
    values, vectors = [], []
    for i in range(count + 1):
        values.append(solver.getEigenpair(i, vector).real)
        vectors.append(vector.array.copy())
    for item in (solver, start, vector):
        item.destroy()
    order = np.argsort(values)
    return np.array(values)[order], np.array(vectors)[order]


def _check_inertia(matrix: PETSc.Mat, values: Floats, count: int) -> None:
    """As many eigenvalues below the gap as the factorisation of K - sigma I has negative pivots."""
    if values[count] - values[count - 1] < 1e-6 * values[count]:
        return  # a multiple eigenvalue is cut here: there is no gap to put sigma into
    shifted = matrix.copy()
    shifted.shift(-0.5 * (values[count] + values[count - 1]))
    shifted.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    solver = PETSc.KSP().create(MPI.COMM_SELF)
    solver.setOperators(shifted)
    solver.setType("preonly")
    solver.getPC().setType("cholesky")
    solver.getPC().setFactorSolverType("mumps")
    solver.setUp()
    below = int(solver.getPC().getFactorMatrix().getMumpsInfog(12))
    solver.destroy()
    shifted.destroy()
    if below != count:
        raise RuntimeError(f"eigenmodes: inertia counts {below} modes below the gap, SLEPc found {count}.")


def _normalised(shapes: Floats) -> Floats:
    peak = np.linalg.norm(shapes, axis=2).max(axis=1)
    flat = shapes.reshape(len(shapes), -1)
    sign = np.sign(flat[np.arange(len(flat)), np.abs(flat).argmax(axis=1)])
    return shapes * (sign / peak)[:, None, None]
