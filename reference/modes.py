"""Eigenmodes of the stiffness at rest (SLEPc), the shapes that loads are made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from slepc4py import SLEPc

from softtwin.meshes.body import Body
from softtwin.meshes.io import FileError, read_fields, write_body

from .fem.fenicsx import MPI, PETSc
from .solve.problem import Problem

Floats = NDArray[np.float64]
Weighting = Literal["stiffness", "mass"]


@dataclass(frozen=True, eq=False)
class Modes:
    """Eigenpairs K(0) phi = lambda phi, or K(0) phi = lambda M phi, on the free unknowns.

    Args:
        eigenvalues: ascending, (k,), N/m; weighted by mass 1/s^2, squares of angular frequencies.
        shapes: (k, n, 3), zero at fixed nodes, largest nodal displacement 1, largest component positive.
    """

    eigenvalues: Floats
    shapes: Floats


def eigenmodes(problem: Problem, count: int, weighting: Weighting = "stiffness", density: float = 1000.0) -> Modes:
    """The softest eigenmodes of a problem at rest (Odot 2023, eq. 4.3), none of them spurious.

    Held unknowns are taken out of the matrices. The count is checked by Sylvester's inertia, so that no mode of a
    multiple eigenvalue is missed.

    Args:
        problem: body and material, on one rank and without pressures as unknowns.
        count: how many modes.
        weighting: `stiffness` for K alone, as the thesis; `mass` for the vibrations of the body.
        density: kg/m^3, for `mass`.

    Raises:
        ValueError: count or density out of range, another weighting.
        RuntimeError: SLEPc did not converge, or inertia disagrees with the eigenvalues found.
    """
    free = np.flatnonzero(~problem.held_axes.ravel())
    if not 1 <= count < len(free) // 2:
        raise ValueError(f"eigenmodes.count: expected 1..{len(free) // 2 - 1} for {len(free)} unknowns, got {count}.")
    if weighting not in ("stiffness", "mass"):
        raise ValueError(f"eigenmodes.weighting: expected 'stiffness' or 'mass', got {weighting!r}.")
    if not density > 0.0:
        raise ValueError(f"eigenmodes.density: expected a positive number of kg/m^3, got {density}.")
    stiffness = _matrix(problem.stiffness()[free][:, free].tocsr())
    mass = _matrix(problem.mass(density)[free][:, free].tocsr()) if weighting == "mass" else None
    values, vectors = _smallest(stiffness, mass, count, min(len(free), max(4 * count, count + 60)))
    _check_inertia(stiffness, mass, values, count)
    for matrix in (stiffness, mass):
        if matrix is not None:
            matrix.destroy()
    shapes = np.zeros((count, problem.body.points.size))
    shapes[:, free] = vectors[:count]
    return Modes(values[:count], _normalised(shapes.reshape(count, *problem.body.points.shape)))


def save_modes(path: str | Path, body: Body, modes: Modes) -> None:
    """Write a body with its modes to one VTU file; each mode is a field that ParaView can warp by.

    Args:
        path: file to write, `.vtu`.
        body: the body.
        modes: its modes.
    """
    shapes = {f"mode {i:03d}": shape for i, shape in enumerate(modes.shapes)}
    write_body(path, body, {"eigenvalues": modes.eigenvalues, **shapes})


def load_modes(path: str | Path) -> Modes:
    """The modes that `save_modes` wrote, bit for bit.

    Args:
        path: VTU file.

    Raises:
        FileError: missing or damaged file, or one without modes.
    """
    fields = read_fields(path)
    if "eigenvalues" not in fields:
        raise FileError(f"{path}: expected a body with eigenmodes, got one without.")
    names = sorted(name for name in fields if name.startswith("mode "))
    return Modes(fields["eigenvalues"], np.array([fields[name] for name in names]))


def _matrix(values: csr_matrix) -> Any:
    matrix = PETSc.Mat().createAIJ(values.shape, csr=(values.indptr, values.indices, values.data), comm=MPI.COMM_SELF)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return matrix


def _smallest(stiffness: Any, mass: Any, count: int, basis: int) -> tuple[Floats, Floats]:
    solver = SLEPc.EPS().create(MPI.COMM_SELF)
    solver.setOperators(stiffness, mass)
    kinds = SLEPc.EPS.ProblemType
    solver.setProblemType(kinds.HEP if mass is None else kinds.GHEP)
    solver.setDimensions(nev=count + 1, ncv=basis)  # one more, so that the gap above the last mode is known
    solver.setTarget(0.0)
    solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    transform = solver.getST()
    transform.setType("sinvert")
    _use_cholesky(transform.getKSP())
    start = stiffness.createVecRight()
    start.array[:] = np.random.default_rng(0).standard_normal(start.getLocalSize())  # the same modes every time
    solver.setInitialSpace([start])
    solver.solve()
    if solver.getConverged() < count + 1:
        raise RuntimeError(f"eigenmodes: SLEPc found {solver.getConverged()} of {count + 1} modes.")
    vector = stiffness.createVecRight()
    values, vectors = [], []
    for i in range(count + 1):
        values.append(solver.getEigenpair(i, vector).real)
        vectors.append(vector.array.copy())
    for item in (solver, start, vector):
        item.destroy()
    order = np.argsort(values)
    return np.array(values)[order], np.array(vectors)[order]


def _check_inertia(stiffness: Any, mass: Any, values: Floats, count: int) -> None:
    """As many eigenvalues below the gap as the factorisation of K - sigma M has negative pivots."""
    if values[count] - values[count - 1] < 1e-6 * values[count]:
        return  # a multiple eigenvalue is cut here: there is no gap to put sigma into
    shifted, sigma = stiffness.copy(), 0.5 * (values[count] + values[count - 1])
    if mass is None:
        shifted.shift(-sigma)
    else:
        shifted.axpy(-sigma, mass, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    shifted.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    solver = PETSc.KSP().create(MPI.COMM_SELF)
    solver.setOperators(shifted)
    _use_cholesky(solver)
    solver.setUp()
    below = int(solver.getPC().getFactorMatrix().getMumpsInfog(12))
    solver.destroy()
    shifted.destroy()
    if below != count:
        raise RuntimeError(f"eigenmodes: inertia counts {below} modes below the gap, SLEPc found {count}.")


def _use_cholesky(solver: Any) -> None:
    solver.setType("preonly")
    solver.getPC().setType("cholesky")
    solver.getPC().setFactorSolverType("mumps")


def _normalised(shapes: Floats) -> Floats:
    peak = np.linalg.norm(shapes, axis=2).max(axis=1)
    flat = shapes.reshape(len(shapes), -1)
    sign = np.sign(flat[np.arange(len(flat)), np.abs(flat).argmax(axis=1)])
    return shapes * (sign / peak)[:, None, None]
