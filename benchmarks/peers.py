"""The same hyperelastic equilibria with independent codes: felupe, scikit-fem and torch-fem.

All three run plain Newton iterations from rest in equal load steps on one core. What made one faster and is reached
by its documented interface was taken: symmetric PARDISO, closed forms of stress and tangent, tables made once.

    pip install -c ci/constraints.txt -e .[benchmark]
    pip install -c ci/constraints.txt --no-deps torch-fem  # asks for scipy >= 1.14; what it calls is in Debian's 1.10
    python benchmarks/peers.py
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import felupe
import numpy as np
import scipy.sparse as sp
import skfem
import torch
from columns import Column
from harness import Benchmark, Given, run
from liver import POISSON_RATIO, YOUNG_MODULUS, liver, sequence
from numpy.typing import ArrayLike, NDArray
from pypardiso import PyPardisoSolver
from pypardiso.pardiso_wrapper import PyPardisoError
from skfem.helpers import dot, grad
from threadpoolctl import threadpool_limits
from torchfem import Solid
from torchfem.materials import MechanicsMaterial
from torchfem.sparse import ConvergenceError

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import MATERIALS, lame
from softtwin.reference.solve.problem import Problem

Floats = NDArray[np.float64]
LOAD_STEPS = (1, 2, 4, 8, 16, 32, 64, 128)
MAX_ITERATIONS = 16  # of one load step: felupe's own limit
_SOLVER = PyPardisoSolver(mtype=-2)  # real symmetric indefinite; one for all, since it looks through .venv for MKL
SKFEM_CORNERS = [0, 4, 3, 1, 7, 5, 2, 6]  # VTK's corners of a hexahedron in the order of skfem.MeshHex


@dataclass(frozen=True, eq=False)
class PeerResult:
    """What a code found.

    Args:
        displacement: nodal displacement in the body's order, (n, 3), metres; NaN if nothing was found.
        converged: whether the tolerance was met with det F > 0 at every quadrature point.
        iterations: Newton iterations (linear solves) of all load steps.
        load_steps: equal load steps of the run that converged, or of the last one that did not.
        seconds: wall time of that run from rest, without set-up.
        setup_seconds: wall time for mesh, basis, tables, one assembly and one factorisation that warm every cache.
        residual_norm: norm of the residual over the free unknowns, newtons.
        note: versions and how the code was used.
    """

    displacement: Floats
    converged: bool
    iterations: int
    load_steps: int
    seconds: float
    setup_seconds: float
    residual_norm: float
    note: str = ""


@dataclass(frozen=True, eq=False)
class _Task:
    """One equilibrium: a body, its law with Lamé parameters, nodal forces and the residual to reach, newtons."""

    body: Body
    law: str
    mu: float
    lmbda: float
    forces: Floats
    target: float

    def evaluate(self, F: Any, xp: Any) -> tuple[Any, Callable[[], Any]]:
        """Stress of the law for deformation gradients (..., 3, 3), and what makes its tangent (numpy or torch)."""
        return _LAWS[self.law](F, self.mu, self.lmbda, xp)


class _StoppedError(ArithmeticError):
    """A load step without an equilibrium."""


_FAILURES = (
    _StoppedError,
    ConvergenceError,
    PyPardisoError,
    felupe.NewtonConvergenceError,
    np.linalg.LinAlgError,
    torch.linalg.LinAlgError,
)


def felupe_solve(
    body: Body, law: str, young_modulus: float, poisson_ratio: float, forces: ArrayLike, tolerance: float = 1e-8
) -> PeerResult:
    """The equilibrium by felupe: `newtonraphson` on a solid body and point loads.

    Args:
        body: the body; hexahedra get 2 x 2 x 2 points, tetrahedra one.
        law: `neo-hookean` or `saint-venant-kirchhoff`.
        young_modulus: Young's modulus, pascals.
        poisson_ratio: Poisson's ratio, in (0, 0.5).
        forces: nodal forces, (n, 3), newtons; those at fixed nodes do no work and are ignored.
        tolerance: norm of the residual over free unknowns, relative to the norm of the forces.

    Raises:
        ValueError: another law, or forces of another shape.
    """
    note = f"{_versions('felupe', 'pypardiso', 'mkl')}; newtonraphson, closed-form material, symmetric PARDISO"
    return _in_load_steps(_felupe_attempt, _task(body, law, young_modulus, poisson_ratio, forces, tolerance), note)


def scikit_fem_solve(
    body: Body, law: str, young_modulus: float, poisson_ratio: float, forces: ArrayLike, tolerance: float = 1e-8
) -> PeerResult:
    """The equilibrium by scikit-fem: the weak form and Newton's loop by hand, as in its hyperelasticity example.

    Arguments and errors: as for `felupe_solve`.
    """
    note = (
        f"{_versions('scikit-fem', 'pypardiso', 'mkl')}; hand-written form, cells' matrices at once, symmetric PARDISO"
    )
    return _in_load_steps(_scikit_fem_attempt, _task(body, law, young_modulus, poisson_ratio, forces, tolerance), note)


def torch_fem_solve(
    body: Body, law: str, young_modulus: float, poisson_ratio: float, forces: ArrayLike, tolerance: float = 1e-8
) -> PeerResult:
    """The equilibrium by torch-fem: `Solid.solve`, which starts a load step from the last one's increment.

    Arguments and errors: as for `felupe_solve`.
    """
    note = f"{_versions('torch-fem', 'torch', 'pypardiso', 'mkl')}; Solid.solve, closed-form material, its own PARDISO"
    return _in_load_steps(_torch_fem_attempt, _task(body, law, young_modulus, poisson_ratio, forces, tolerance), note)


PEERS: dict[str, Callable[..., PeerResult]] = {
    "felupe": felupe_solve,
    "scikit-fem": scikit_fem_solve,
    "torch-fem": torch_fem_solve,
}


def _task(
    body: Body, law: str, young_modulus: float, poisson_ratio: float, forces: ArrayLike, tolerance: float
) -> _Task:
    if law not in _LAWS:
        raise ValueError(f"law: expected one of {', '.join(_LAWS)}, got {law!r}.")
    load = np.array(forces, dtype=np.float64)
    if load.shape != body.points.shape:
        raise ValueError(f"forces: expected shape {body.points.shape}, got {load.shape}.")
    load[body.fixed] = 0.0
    mu, lmbda = lame(young_modulus, poisson_ratio)
    return _Task(body, law, mu, lmbda, load, tolerance * float(np.linalg.norm(load)))


def _in_load_steps(attempt: Callable[[_Task, int], PeerResult], task: _Task, note: str) -> PeerResult:
    """The first attempt that succeeds, each with twice the load steps of the one before."""
    for steps in LOAD_STEPS:
        with suppress(*_FAILURES), threadpool_limits(1), np.errstate(all="ignore"):
            return replace(attempt(task, steps), note=note)
    nothing = np.full_like(task.forces, np.nan)
    return PeerResult(nothing, False, 0, LOAD_STEPS[-1], np.nan, np.nan, np.nan, note)


def _versions(*names: str) -> str:
    return ", ".join(f"{name} {version(name)}" for name in names)


# --- What the codes share. Closed forms of a law serve numpy and torch alike: both have the functions used here.


def _neo_hookean(F: Any, mu: float, lmbda: float, xp: Any) -> tuple[Any, Callable[[], Any]]:
    """First Piola-Kirchhoff stress mu (F - F^-T) + lambda ln J F^-T, and what makes its derivative dP_iJ / dF_kL.

    Args:
        F: deformation gradients, (..., 3, 3).
        mu: shear modulus, pascals.
        lmbda: first Lamé parameter, pascals.
        xp: numpy or torch.
    """
    G = xp.swapaxes(xp.linalg.inv(F), -1, -2)
    ln_J = xp.log(xp.linalg.det(F))[..., None, None]

    def tangent() -> Any:
        return (
            mu * xp.einsum("ik,jl->ijkl", xp.eye(3), xp.eye(3))
            + xp.einsum("...ij,...kl->...ijkl", lmbda * G, G)
            + xp.einsum("...il,...kj->...ijkl", (mu - lmbda * ln_J) * G, G)
        )

    return mu * F + (lmbda * ln_J - mu) * G, tangent


def _saint_venant_kirchhoff(F: Any, mu: float, lmbda: float, xp: Any) -> tuple[Any, Callable[[], Any]]:
    """First Piola-Kirchhoff stress F S, S = lambda tr(E) I + 2 mu E, and what makes its derivative dP_iJ / dF_kL.

    Arguments: as for `_neo_hookean`.
    """
    E = (xp.swapaxes(F, -1, -2) @ F - xp.eye(3)) / 2
    S = lmbda * xp.einsum("...ii->...", E)[..., None, None] * xp.eye(3) + 2 * mu * E

    def tangent() -> Any:
        return (
            xp.einsum("...ij,...kl->...ijkl", lmbda * F, F)
            + xp.einsum("...il,...kj->...ijkl", mu * F, F)
            + xp.einsum("...ik,jl->...ijkl", mu * F @ xp.swapaxes(F, -1, -2), xp.eye(3))
            + xp.einsum("ik,...jl->...ijkl", xp.eye(3), S)
        )

    return F @ S, tangent


_LAWS = {"neo-hookean": _neo_hookean, "saint-venant-kirchhoff": _saint_venant_kirchhoff}


def _pardiso(matrix: sp.csr_matrix, right: Floats) -> Floats:
    """Solution x of matrix x = right for a symmetric matrix: its upper half is a third less work for PARDISO.

    Raises:
        _StoppedError: NaN or infinity, on which PARDISO's search for pivots writes beyond its arrays.
    """
    if not np.isfinite(matrix.data).all():
        raise _StoppedError("The tangent is not finite.")
    return _SOLVER.solve(sp.triu(matrix, format="csr"), right)


def _check_orientation(jacobians: Any) -> None:
    """Without a barrier in its law, a code may be content with cells that are inside out."""
    if not jacobians.min() > 0.0:
        raise _StoppedError("A cell is inside out.")


# --- felupe


def _felupe_attempt(task: _Task, steps: int) -> PeerResult:
    begin = time.perf_counter()
    field = _felupe_field(task.body)
    solid = felupe.SolidBody(_felupe_material(task), field)
    load = felupe.PointLoad(field, np.arange(len(task.forces)), task.forces)
    clamp = {"fixed": felupe.Boundary(field[0], mask=np.isin(np.arange(len(task.forces)), task.body.fixed))}
    dof0, dof1 = felupe.dof.partition(field, clamp)

    def check(dx: Floats, x: Any, f: Floats, *_: Any, **__: Any) -> tuple[float, float, bool]:
        """Felupe's own check divides by the reactions; here it is the tolerance that all codes have to meet."""
        norm = float(np.linalg.norm(f[dof1]))
        return float(np.linalg.norm(dx)), norm, norm <= task.target

    options = {"dof0": dof0, "dof1": dof1, "ext0": felupe.dof.apply(field, clamp, dof0), "solver": _pardiso}
    options |= {"check": check, "maxiter": MAX_ITERATIONS, "verbose": 0, "kwargs": {"parallel": False}}
    _pardiso(solid.assemble.matrix()[dof1][:, dof1], np.zeros(len(dof1)))
    ready, iterations = time.perf_counter(), 0
    for step in range(1, steps + 1):
        load.update(task.forces * (step / steps))
        result = felupe.newtonraphson(x0=field, items=[solid, load], **options)
        field, iterations = result.x, iterations + result.iterations
    end = time.perf_counter()
    _check_orientation(felupe.math.det(field.extract()[0]))
    return PeerResult(
        displacement=field[0].values.copy(),
        converged=True,
        iterations=iterations,
        load_steps=steps,
        seconds=end - ready,
        setup_seconds=ready - begin,
        residual_norm=float(result.fnorms[-1]),
    )


def _felupe_field(body: Body) -> Any:
    if body.is_tetrahedral:
        region = felupe.RegionTetra(felupe.Mesh(body.points, body.cells, "tetra"))
    else:
        region = felupe.RegionHexahedron(felupe.Mesh(body.points, body.cells, "hexahedron"))
    return felupe.FieldContainer([felupe.Field(region, dim=3)])


def _felupe_material(task: _Task) -> Any:
    if task.law == "neo-hookean":
        return felupe.NeoHookeCompressible(task.mu, task.lmbda)

    def stress(x: list[Any]) -> list[Any]:
        return [_trailing(task.evaluate(_leading(x[0]), np)[0], 2), x[-1]]

    def elasticity(x: list[Any]) -> list[Any]:
        return [_trailing(task.evaluate(_leading(x[0]), np)[1](), 4)]

    # Its MaterialStrain is the same law at twice the time of an assembly.
    return felupe.Material(stress, elasticity)


def _leading(tensor: Floats) -> Floats:
    """Cells and points before the axes of the tensor: (3, 3, a, b) becomes (a, b, 3, 3)."""
    return np.ascontiguousarray(np.moveaxis(tensor, (0, 1), (-2, -1)))


def _trailing(tensors: Floats, order: int) -> Floats:
    """The axes of the tensor, as many as its order, before cells and points."""
    return np.moveaxis(tensors, range(-order, 0), range(order))


# --- scikit-fem


@skfem.LinearForm
def _virtual_work(v: Any, w: Any) -> Any:
    return np.einsum("ij...,ij...", w["stress"], grad(v))


@skfem.BilinearForm
def _mass(u: Any, v: Any, w: Any) -> Any:
    return dot(u, v)


class _SkfemModel:
    """Residual and tangent of a task in scikit-fem's numbering.

    The residual is a linear form. A bilinear form of the tangent calls Python 576 times for hexahedra, at 1.2 s an
    assembly of the beam as its example writes it, so the cells' matrices are made at once, B^T A B with a table B of
    the basis' gradients, and scikit-fem assembles those.
    """

    def __init__(self, task: _Task) -> None:
        self.task = task
        self.basis = _skfem_basis(task.body)
        self.free = self.basis.complement_dofs(self.basis.nodal_dofs[:, task.body.fixed].ravel())
        self.load = np.zeros(self.basis.N)
        self.load[self.basis.nodal_dofs] = task.forces.T
        self._gradients = _gradient_table(self.basis)
        self._weighted = np.ascontiguousarray(self._gradients * self.basis.dx[..., None, None])
        self._cells = _mass.elemental(self.basis)

    def deformation(self, u: Floats) -> Floats:
        """Deformation gradient at the quadrature points, (cell, point, 3, 3)."""
        return _leading(self.basis.interpolate(u).grad) + np.eye(3)

    def evaluate(self, u: Floats, share: float) -> tuple[Floats, Callable[[], sp.csr_matrix]]:
        """Internal forces minus a share of the load, newtons, and what makes the tangent stiffness, N/m."""
        stress, moduli = self.task.evaluate(self.deformation(u), np)
        internal = _virtual_work.assemble(self.basis, stress=_trailing(stress, 2))
        return internal - share * self.load, lambda: self._assemble(moduli())

    def step(self, residual: Floats, tangent: Callable[[], sp.csr_matrix]) -> Floats:
        """Newton's step, metres."""
        return skfem.solve(*skfem.condense(tangent(), -residual, I=self.free), solver=_pardiso)

    def _assemble(self, moduli: Floats) -> sp.csr_matrix:
        cells, points, _, functions = self._gradients.shape
        left = self._weighted.reshape(cells, 9 * points, functions).swapaxes(1, 2)
        right = moduli.reshape(cells, points, 9, 9) @ self._gradients
        return self._cells.fromlocal(left @ right.reshape(cells, 9 * points, functions)).tocsr()


def _gradient_table(basis: Any) -> Floats:
    """Gradients of the basis functions at the quadrature points, (cell, point, 9, function), 1/m."""
    table = np.stack([function[0].grad for function in basis.basis], axis=-1)  # (3, 3, cell, point, function)
    _, _, cells, points, functions = table.shape
    return np.ascontiguousarray(np.moveaxis(table, (0, 1), (2, 3)).reshape(cells, points, 9, functions))


def _skfem_basis(body: Body) -> Any:
    points = np.ascontiguousarray(body.points.T)
    if body.is_tetrahedral:
        mesh, element, degree = skfem.MeshTet(points, np.ascontiguousarray(body.cells.T)), skfem.ElementTetP1(), 1
    else:
        cells = np.ascontiguousarray(body.cells.T[SKFEM_CORNERS])
        mesh, element, degree = skfem.MeshHex(points, cells), skfem.ElementHex1(), 3
    return skfem.Basis(mesh, skfem.ElementVector(element), intorder=degree)


def _scikit_fem_attempt(task: _Task, steps: int) -> PeerResult:
    begin = time.perf_counter()
    model = _SkfemModel(task)
    u, iterations = np.zeros(model.basis.N), 0
    model.step(*model.evaluate(u, 1.0))
    ready = time.perf_counter()
    for step in range(1, steps + 1):
        u, spent, norm = _skfem_newton(model, u, step / steps)
        iterations += spent
    end = time.perf_counter()
    _check_orientation(np.linalg.det(model.deformation(u)))
    return PeerResult(
        displacement=u[model.basis.nodal_dofs].T.copy(),
        converged=True,
        iterations=iterations,
        load_steps=steps,
        seconds=end - ready,
        setup_seconds=ready - begin,
        residual_norm=norm,
    )


def _skfem_newton(model: _SkfemModel, u: Floats, share: float) -> tuple[Floats, int, float]:
    """Newton's iterations for a share of the load: unknowns, number of iterations, norm of the residual."""
    for iteration in range(MAX_ITERATIONS + 1):
        residual, tangent = model.evaluate(u, share)
        norm = float(np.linalg.norm(residual[model.free]))
        if norm <= model.task.target:
            return u, iteration, norm
        if not np.isfinite(norm):
            break
        u = u + model.step(residual, tangent)
    raise _StoppedError(f"scikit-fem: residual {norm:.1e} N after {iteration} iterations.")


# --- torch-fem


class _ClosedForm(MechanicsMaterial):
    """A law for torch-fem. Its Hyperelastic3D derives the same from the energy at twice the time of a solve."""

    finite_strain = True

    def __init__(self, task: _Task) -> None:
        super().__init__()
        self.task = task

    def step(self, H_inc: Any, F: Any, stress: Any, state: Any, de0: Any, cl: Any, iter: int) -> tuple[Any, Any, Any]:
        """Stress and tangent after an increment of the displacement gradient."""
        P, tangent = self.task.evaluate(F + H_inc, torch)
        return P, state, tangent()


class _CountingSolid(Solid):
    """A solid that counts the tangents it assembles: one for each iteration, and one where a load step ends."""

    tangents = 0

    def assemble_matrix(self, k: Any, con: Any) -> Any:
        """The tangent, counted."""
        self.tangents += 1
        return super().assemble_matrix(k, con)


def _torch_fem_attempt(task: _Task, steps: int) -> PeerResult:
    with _double_precision():
        begin = time.perf_counter()
        model = _CountingSolid(torch.tensor(task.body.points), torch.tensor(task.body.cells), _ClosedForm(task))
        model.constraints[torch.tensor(task.body.fixed)] = True
        model.forces = torch.tensor(task.forces)
        with suppress(ConvergenceError):  # one iteration warms what PyTorch and MKL load at their first call
            _torch_fem_steps(model, 1, task.target, iterations=1)
        model.tangents = 0
        ready = time.perf_counter()
        displacement, internal, F = _torch_fem_steps(model, steps, task.target, MAX_ITERATIONS + 1)
        end = time.perf_counter()
    _check_orientation(torch.linalg.det(F))
    return PeerResult(
        displacement=displacement.numpy(),
        converged=True,
        iterations=model.tangents - steps,
        load_steps=steps,
        seconds=end - ready,
        setup_seconds=ready - begin,
        residual_norm=float(np.linalg.norm((internal.numpy() - task.forces)[task.body.free])),
    )


def _torch_fem_steps(model: _CountingSolid, steps: int, target: float, iterations: int) -> tuple[Any, Any, Any]:
    """Displacement, internal forces and deformation gradients; a load step that fails is not cut back."""
    displacement, internal, _, F, _ = model.solve(
        increments=torch.linspace(0.0, 1.0, steps + 1),
        max_iter=iterations,
        rtol=0.0,
        atol=target,
        max_cutbacks=0,
        method="direct",
        aggregate_integration_points=False,
    )
    return displacement, internal, F


@contextmanager
def _double_precision() -> Iterator[None]:
    """One thread and 64-bit numbers, which torch-fem takes from PyTorch's default."""
    dtype, threads = torch.get_default_dtype(), torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_default_dtype(dtype)
        torch.set_num_threads(threads)


# --- Do they agree?


def _cases() -> Iterator[tuple[str, Body, str, float, float, Floats]]:
    """Name, body, law, Young's modulus, Poisson's ratio and forces of every comparison."""
    bar = beam()
    tip = bar.node_sets["tip"]
    pull = np.zeros_like(bar.points)
    pull[tip, 2] = 1.0 / len(tip)
    yield "beam", bar, "neo-hookean", 5000.0, 0.45, pull
    push = sequence("s2").nodal_forces(0)
    yield "liver", liver(), "neo-hookean", YOUNG_MODULUS, POISSON_RATIO, push
    yield "beam", bar, "saint-venant-kirchhoff", 5000.0, 0.3, 0.6 * pull


def _ours(
    body: Body, law: str, young_modulus: float, poisson_ratio: float, forces: Floats
) -> tuple[Floats, float, int]:
    """Displacement of the reference, median time of five solves from rest, and its iterations."""
    seconds = []
    with threadpool_limits(1), Problem(body, MATERIALS[law](young_modulus, poisson_ratio)) as problem:
        problem.solve(forces)  # compiles, and factors the stiffness at rest
        for _ in range(5):
            begin = time.perf_counter()
            state = problem.solve(forces, stability=False)
            seconds.append(time.perf_counter() - begin)
    return state.displacement, float(np.median(seconds)), state.iterations


def work(row: str, given: Given) -> dict[str, Any]:
    """One problem by softtwin and by each code: the largest difference, times, load steps."""
    _, body, law, young_modulus, poisson_ratio, forces = next(
        case for case in _cases() if f"{case[0]}, {case[2]}" == row
    )
    expected, seconds, iterations = _ours(body, law, young_modulus, poisson_ratio, forces)
    found: dict[str, Any] = {"softtwin_s": seconds, "softtwin_iterations": iterations}
    for peer, solve in PEERS.items():
        runs = [solve(body, law, young_modulus, poisson_ratio, forces) for _ in range(3)]
        error = np.abs(runs[0].displacement - expected).max()
        peer_seconds = float(np.median([each.seconds for each in runs]))
        found[peer] = {
            "largest_difference_m": error,
            "agrees": bool(error < 1e-6 * np.abs(expected).max()),
            "seconds": peer_seconds,
            "setup_s": runs[0].setup_seconds,
            "load_steps": runs[0].load_steps,
            "iterations": runs[0].iterations,
            "residual_N": runs[0].residual_norm,
            "ratio_ours_to_theirs": seconds / peer_seconds,
            "note": runs[0].note,
        }
    return found


BENCHMARK = Benchmark(
    name="peers",
    title="The same equilibria by felupe, scikit-fem and torch-fem: differences and times",
    about=("reference",),
    work=work,
    rows=("beam, neo-hookean", "liver, neo-hookean", "beam, saint-venant-kirchhoff"),
    columns=(
        Column("softtwin", "ms", "{softtwin_s*1000:.0f}"),
        *(
            Column(peer, "ms; difference, m", f"{{{peer}.seconds*1000:.0f}}; {{{peer}.largest_difference_m:.0e}}")
            for peer in PEERS
        ),
    ),
)


if __name__ == "__main__":
    run(BENCHMARK)
