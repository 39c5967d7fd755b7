"""The organ before gravity: the stress-free body that known loads deform into the shape that a scan shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body, BodyError
from softtwin.meshes.embedding import carried, outer

from .data.loading import Loading
from .data.materials import Material
from .data.outcome import Equilibrium, NotConverged
from .data.springs import Support, ligaments_of
from .fem.fenicsx import MPI
from .fem.inverse_forms import InverseForms
from .solve.linear import LinearSolver
from .solve.newton import NewtonOptions, force_rounding
from .solve.problem import Problem

Floats = NDArray[np.float64]
S = TypeVar("S")
Method = Literal["newton", "fixed point"]
_METHODS = ("newton", "fixed point")
_CLOSE = 1e-6  # of the body's size: so near the fixed point's shapes come to the scanned one
_CUT, _GROWTH, _SMALLEST_STEP = 0.5, 1.5, 1e-3  # of load steps
_HALVINGS = 10  # of one step of Newton's method
_NEAR = 15  # iterations; what needs more is too far, and a shorter load step comes sooner
_MOST_ROUNDS = 40  # of the fixed point


@dataclass(frozen=True, eq=False)
class Unloaded:
    """A stress-free body, and how the loads of the scan deform it.

    Args:
        body: the unloaded shape: nodes, skin and inner surfaces moved, all numbers as in the scanned body.
        displacement: from it to the scanned shape, (n, 3), metres: an equilibrium of the body under the loads.
        gap: greatest distance of a node of that equilibrium from the scanned one, metres: 0 where the shape was the
            unknown itself (Newton).
        residual: norm of the out-of-balance nodal forces there, newtons.
        iterations: of Newton's method, or rounds of the fixed point.
        load_steps: successful load steps; 1 where the whole load was taken at once.
        negative_pivots: of the tangent there: 0 is stable, so that the organ would hang so by itself.
    """

    body: Body
    displacement: Floats
    gap: float
    residual: float
    iterations: int
    load_steps: int
    negative_pivots: int | None

    @property
    def is_stable(self) -> bool:
        """Whether the unloaded body keeps the scanned shape under its loads when it is disturbed a little."""
        return self.negative_pivots == 0


def unloaded(
    scanned: Body,
    material: Material,
    load: Loading | ArrayLike,
    *,
    held: Mapping[str, str] | None = None,
    springs: Mapping[str, Support] | None = None,
    method: Method = "newton",
    options: NewtonOptions | None = None,
    quadrature: int | None = None,
    comm: Any = MPI.COMM_SELF,
) -> Unloaded:
    """The stress-free body whose equilibrium under known loads is a scanned shape.

    Newton's method writes equilibrium on the scanned shape, with the unloaded one as the unknown (Govindjee and Mihalic
    1996): no equilibrium is searched, and the answer is exact for the discrete body. The fixed point (Sellier 2011)
    solves equilibria of a guessed body and moves it back by what they miss.

    Args:
        scanned: the body as the scan shows it, under the loads.
        material: strain energy of the unloaded body.
        load: what acts in the scan: weight per unloaded volume, pressures on the scanned surface, forces; where
            displacements are prescribed, the unloaded nodes lie that far back.
        held: axes held at named node sets, as in `Problem`.
        springs: that hold named surfaces and are slack at the unloaded shape.
        method: `newton`, or `fixed point`, which is slower and stands beside it as a check.
        options: of Newton's method: tolerance relative to the forces, most iterations of one load step, most steps.
        quadrature: polynomial degree that the quadrature is exact for, as in `Problem`. The same one makes forward and
            back the same; by default curved quadratic cells take a higher one than straight ones (1e-6 m on a bar).
        comm: communicator that shares the mesh.

    Raises:
        ValueError: as `Problem` says, or another method.
        NotConverged: no such body was found; for loads too great for the tissue there is none.
    """
    if ligaments_of(springs or {}):
        raise ValueError(
            "unloaded.springs: expected springs on surfaces, got ligaments, whose length without load is not known."
        )
    if method not in _METHODS:
        raise ValueError(f"unloaded.method: expected one of {_METHODS}, got {method!r}.")
    given = {"held": held, "springs": springs, "options": options, "quadrature": quadrature, "comm": comm}
    found = _by_newton if method == "newton" else _by_fixed_point
    return found(scanned, material, load, given)


def moved_body(body: Body, displacement: ArrayLike) -> Body:
    """A body in another shape: nodes, skin and inner surfaces moved along, all numbers kept.

    Args:
        body: the body.
        displacement: of its nodes, (n, 3), metres.

    Raises:
        BodyError: cells are inside out there.
    """
    field = np.asarray(displacement, dtype=np.float64)
    skin = None if body.skin is None else outer(body).moved(field)
    return replace(body, points=body.points + field, inner=carried(body, field), skin=skin)


def _by_newton(scanned: Body, material: Material, load: Loading | ArrayLike, given: dict[str, Any]) -> Unloaded:
    with Problem(scanned, material, **given) as problem:
        loading, _ = problem.system.load(load)
        search = _Newton(problem, loading)
        try:
            unknowns, load_steps = _in_load_steps(search, np.zeros(search.space.owned), problem.options)
        finally:
            search.close()
        back = problem.system.space.field(unknowns)
        shape = _Shape(back, -back, problem.system.space.pressure(unknowns))
    return _told(scanned, shape, material, loading, given, search.iterations, load_steps)


def _by_fixed_point(scanned: Body, material: Material, load: Loading | ArrayLike, given: dict[str, Any]) -> Unloaded:
    with Problem(scanned, material, **given) as problem:
        loading, _ = problem.system.load(load)
        options = problem.options
    search = _FixedPoint(scanned, material, loading, given)
    shape, load_steps = _in_load_steps(search, _Shape.at(scanned), options)
    return _told(scanned, shape, material, loading, given, search.iterations, load_steps)


class _Search(Protocol[S]):
    """From the unloaded shape of one part of the load to that of another."""

    iterations: int

    def run(self, state: S, share: float) -> S | None:
        """The shape for a part of the load from that of another part; None where that is too far."""


def _in_load_steps(search: _Search[S], state: S, options: NewtonOptions) -> tuple[S, int]:
    """The shape for the whole load, at once or in steps, and how many led there.

    Raises:
        NotConverged: some part of the load could not be reached.
    """
    reached, step, good = 0.0, 1.0, 0
    for _ in range(options.max_load_steps):
        target = min(1.0, reached + step)
        tried = search.run(state, target)
        if tried is None:
            step *= _CUT
            if step < _SMALLEST_STEP:
                break
            continue
        state, reached, good = tried, target, good + 1
        if reached == 1.0:
            return state, good
        step *= _GROWTH
    raise NotConverged(
        f"unloaded: no stress-free shape was found after {search.iterations} iterations; one for "
        f"{100 * reached:.1f} % of the load was. Tissue so soft cannot carry that load in the scanned shape: "
        "expected a stiffer material, less density or pressure, or a larger support.",
        reached,
    )


class _Newton:
    """Newton's method on the unloaded shape; its states are unknowns."""

    def __init__(self, problem: Problem, loading: Loading) -> None:
        self.options, self.space = problem.options, problem.system.space
        self._forms = InverseForms(problem.system.forms, loading)
        self._matrix = self._forms.create_matrix()
        self._linear = LinearSolver(self._matrix, self.space, "mumps", symmetric=False)
        self._round_off = force_rounding(problem.system.forms)
        self.iterations = 0

    def close(self) -> None:
        """Free the PETSc objects."""
        self._linear.close()
        self._matrix.destroy()
        self._forms.close()

    def run(self, state: Floats, share: float) -> Floats | None:
        """The shape for a part of the load from that of another part; None where that is too far."""
        self._forms.set_share(share)
        enough = self.options.tolerance * self.space.norm(self._forms.residual(np.zeros_like(state)))
        residual = self._forms.residual(state)
        for _ in range(min(_NEAR, self.options.max_iterations)):
            norm = self.space.norm(residual)
            if norm <= enough:
                return state
            self.iterations += 1
            self._forms.tangent(state, self._matrix)
            try:
                state, residual, length = self._ahead(state, residual)
            except RuntimeError:  # a singular tangent
                return None
            if length == 0.0:
                return state if norm <= self._round_off else None
        return None

    def _ahead(self, state: Floats, residual: Floats) -> tuple[Floats, Floats, float]:
        """So far along a step as the next one, by the same tangent, is shorter (Deuflhard's natural monotonicity).

        The residual's norm is no good measure: a few cells that are crushed or stretched make most of it.
        """
        step, length = self._linear.solve(residual[None])[0], 1.0
        size = self.space.norm(step)
        for _ in range(_HALVINGS):
            ahead = state - length * step
            there = self._forms.residual(ahead)
            if np.isfinite(there).all():
                following = self._linear.solve(there[None])[0]
                if self.space.norm(following) <= (1.0 - length / 4.0) * size:
                    return ahead, there, length
            length *= _CUT
        return state, residual, 0.0


@dataclass(frozen=True, eq=False)
class _Shape:
    """Where the nodes were, from the scanned shape; the displacement that leads there again; pressures."""

    back: Floats
    displacement: Floats
    pressure: Floats | None

    @staticmethod
    def at(scanned: Body) -> _Shape:
        """The scanned shape itself, without load."""
        return _Shape(np.zeros_like(scanned.points), np.zeros_like(scanned.points), None)


class _FixedPoint:
    """Sellier's fixed point; its states are shapes."""

    def __init__(self, scanned: Body, material: Material, loading: Loading, given: dict[str, Any]) -> None:
        self._scanned, self._material, self._loading, self._given = scanned, material, loading, given
        self.iterations = 0

    def run(self, state: _Shape, share: float) -> _Shape | None:
        """The shape for a part of the load from that of another part; None where that is too far."""
        back, nearest = state.back, np.inf
        for _ in range(_MOST_ROUNDS):
            self.iterations += 1
            found = self._forward(back, share)
            gap = np.inf if found is None else float(np.linalg.norm(back + found.displacement, axis=1).max())
            if found is None or gap >= nearest:
                return None
            if gap <= _CLOSE * self._scanned.size:
                return _Shape(back, found.displacement, found.pressure)
            nearest, back = gap, -found.displacement
        return None

    def _forward(self, back: Floats, share: float) -> Equilibrium | None:
        """The equilibrium of the body moved back, near the scanned shape if one is there; None where there is none."""
        try:
            with Problem(moved_body(self._scanned, back), self._material, **self._given) as problem:
                guess = -back if back.any() and not self._material.is_mixed else None
                return problem.solve(self._loading.scaled(share), guess, stability=False)
        except (BodyError, NotConverged):
            return None


def _told(
    scanned: Body,
    shape: _Shape,
    material: Material,
    loading: Loading,
    given: dict[str, Any],
    iterations: int,
    load_steps: int,
) -> Unloaded:
    """The result, with balance and stability of the scanned shape as the unloaded body itself has them."""
    try:
        body = moved_body(scanned, shape.back)
    except BodyError as error:
        raise NotConverged(f"unloaded: the shape that was found is no body ({error}); expected a finer mesh.") from None
    with Problem(body, material, **given) as problem:
        system = problem.system
        _, wanted = system.load(loading)
        unknowns = system.space.unknowns("displacement", shape.displacement, shape.pressure)
        residual = system.space.norm(system.forms.residual(unknowns, wanted))
        pivots = system.tangent.negative_pivots(unknowns, wanted)
    gap = float(np.linalg.norm(shape.back + shape.displacement, axis=1).max())
    return Unloaded(body, shape.displacement, gap, residual, iterations, load_steps, pivots)
