"""Hyperelastic equilibria of a body under any mix of loads (PETSc SNES; MUMPS or multigrid)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix

from softtwin.meshes.body import Body

from ..data.loading import Loading, checked_loading
from ..data.materials import Material
from ..data.outcome import Equilibrium, NotConverged
from ..fem.discretisation import Discretisation
from ..fem.fenicsx import MPI, create_matrix, form, ufl
from ..fem.fenicsx import assemble_matrix as assemble
from ..fem.forms import Forms, Load
from .linear import LinearSolver
from .newton import Attempt, Newton, NewtonOptions

__all__ = ["Loading", "NewtonOptions", "Problem"]

Floats = NDArray[np.float64]
_GROWTH, _CUT = 1.5, 0.5  # of load steps after a success and a failure
_FIRST_STEP = 0.25  # of the load where the whole load has failed
_SMALLEST_STEP = 1e-6  # of the load; where not even that can be added there is a limit point
_SHARES = (1.0, 0.5, 0.25)  # of the load whose linear response is warped for a start
_TRUSTED = 0.9  # of the decrease that the tangent promises: less, and the warped response may be the better start
_LOST = 1e-12  # relative force on held nodes that may be round-off


class Problem:
    """Equilibria of one body of one material, with its factorisations kept from solve to solve.

    The symbolic factorisation is made once for the body. Everything that enters or leaves is in the body's node order.
    Use it as a context manager or call `close`: PETSc objects do not free themselves. Statics only: no inertia.

    With a communicator of several ranks the mesh is shared out between them; every rank makes the same calls with the
    same (whole) arrays and gets the whole answer.

    Args:
        body: the body.
        material: strain energy, with parameters for the whole body or for each cell.
        options: tolerance, limits and method.
        held: axes whose displacement is prescribed at named node sets, zero unless a load says otherwise:
            `{"fixed": "xyz", "symmetry": "x"}`; `{"fixed": "xyz"}` if not given.
        weights: filled part of each cell, (cells,), in (0, 1], of a sparse grid.
        quadrature: polynomial degree that the quadrature is exact for; the least that is safe if not given.
        comm: communicator that shares the mesh; each rank on its own if not given.

    Raises:
        ValueError: a rigid motion is left, a parameter with another number of cells, a mixed material on linear cells.
    """

    def __init__(
        self,
        body: Body,
        material: Material,
        options: NewtonOptions | None = None,
        *,
        held: Mapping[str, str] | None = None,
        weights: ArrayLike | None = None,
        quadrature: int | None = None,
        comm: Any = MPI.COMM_SELF,
    ) -> None:
        self.body, self.material = body, material
        self.options = options or NewtonOptions()
        if material.is_mixed and body.kind.degree != 2:
            raise ValueError(
                f"Problem.body: expected quadratic cells for {type(material).__name__} (Taylor-Hood needs a "
                f"displacement one degree above the pressure), got {body.kind.name}; body.quadratic() makes them."
            )
        everything = "xyz"[: body.dimension]
        self.held = dict(held) if held is not None else ({"fixed": everything} if "fixed" in body.node_sets else {})
        self._space = Discretisation(body, material.is_mixed, self.held, comm)
        checked = None if weights is None else _checked_weights(weights, len(body.cells))
        self._forms = Forms(self._space, material, checked, quadrature)
        self._newton = Newton(self._forms, self.options)
        self._rest: LinearSolver | None = None
        self._poisson: LinearSolver | None = None
        self._warped_form: Any = None
        self._unloaded = Load(np.zeros(self._space.owned), np.zeros(self._space.owned), {})

    def close(self) -> None:
        """Free the PETSc objects; the problem cannot be used after."""
        self._newton.close()
        for solver in (self._rest, self._poisson):
            _free(solver)
        self._forms.close()

    def __enter__(self) -> Problem:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def set_material(self, material: Material) -> None:
        """Other parameters of the same law; nothing is compiled again.

        Args:
            material: of the class, and with the shapes of parameters, that the problem was built with.

        Raises:
            ValueError: another law or other shapes.
        """
        self._forms.set_material(material)
        self.material = material
        self._newton.forget()
        _free(self._rest)
        self._rest = None

    @property
    def size(self) -> int:
        """How many unknowns there are, held ones and pressures included."""
        return int(self._space.size)

    @property
    def held_axes(self) -> NDArray[np.bool_]:
        """Which components of which nodes are held, (n, 3)."""
        return self._space.held

    # ------------------------------------------------------------------ equilibria

    def solve(
        self,
        load: Loading | ArrayLike,
        guess: ArrayLike | Equilibrium | None = None,
        *,
        stability: bool = True,
        fallback: bool = True,
        trace: bool = False,
    ) -> Equilibrium:
        """The displacement that balances a load.

        Tries the full load from the guess, then from the warped linear response (before the guess where an equilibrium
        is too far), then from rest, then in load steps that are halved where they fail and grow where they succeed.

        Args:
            load: the load, or nodal forces alone, (n, 3), newtons.
            guess: displacement to start from, (n, 3), metres, or another equilibrium, which is first moved along its
                tangent by the change of the load; the warped linear response if not given.
            stability: also factor the tangent at the state and count its negative pivots.
            fallback: try the other ways where the guess fails; without, a failure there (and from the warped linear
                response, where an equilibrium is too far) is raised at once.
            trace: keep every iteration in the result.

        Raises:
            ValueError: wrong shape, NaN or infinity, unknown names, forces on held nodes.
            NotConverged: no way led to an equilibrium; it holds the last one that was found on the way.
        """
        given, wanted = self._load(load)
        self._newton.start_count()
        spent = 0
        if self.options.first_step == 1.0 or guess is not None:
            for unknowns, eliminate in self._starts(wanted, guess, fallback):
                attempt = self._newton.run(wanted, unknowns, eliminate=eliminate)
                spent += attempt.iterations
                if attempt.converged:
                    found = replace(attempt, iterations=spent)
                    return self._result(found, given, wanted, load_steps=1, stability=stability, trace=trace)
            if not fallback:
                raise NotConverged(
                    f"Problem.solve: no equilibrium near the guess ({attempt.reason_name} after {spent} iterations). "
                    "Try a smaller change of the load, or fallback=True.",
                    trace=tuple(self._newton.trace),
                )
        return self._solve_in_steps(given, wanted, spent, stability, trace)

    def _load(self, load: Loading | ArrayLike) -> tuple[Loading, Load]:
        """A load in the body's numbers, a copy of the caller's, and as unknowns."""
        checked = checked_loading(load, self.body, self.held).scaled(1.0)
        if checked.forces is not None:
            self._check_lost(np.asarray(checked.forces))
        return checked, self._forms.load(checked)

    def _check_lost(self, forces: Floats) -> None:
        lost = np.where(self._space.held, forces, 0.0)
        if np.linalg.norm(lost) > _LOST * np.linalg.norm(forces):
            where = np.flatnonzero(np.abs(lost).sum(axis=1) > 0.0)
            newtons = np.linalg.norm(lost, axis=1).sum()
            raise ValueError(
                f"Problem.forces: expected no force on held nodes, got {newtons:.3g} N at {len(where)} of them "
                f"(first {where[:5]}), which would be lost; set them to zero or move them to free nodes."
            )

    def _starts(
        self, load: Load, guess: ArrayLike | Equilibrium | None, fallback: bool
    ) -> Iterator[tuple[Floats, bool]]:
        """States to start from, the most promising first, and whether cells may be balanced alone on the way.

        They may not where the equilibrium next to the guess is wanted: with them it may be another.
        """
        near, is_trusted = (None, False) if guess is None else self._near(guess, load)
        if near is not None and is_trusted:
            yield near, False
            if not fallback:
                return
        starts = [self._first_guess(load)]
        if near is not None and not is_trusted:
            starts = sorted([*starts, near], key=lambda start: self._merit(start, load))
        for start in starts:
            yield start, True
        if fallback and not self._has_lift(load):
            yield np.zeros_like(load.dead), True

    def _near(self, guess: ArrayLike | Equilibrium, load: Load) -> tuple[Floats, bool]:
        """The guess, an equilibrium moved along its tangent by the change of the load, and whether that can be trusted.

        A large change leads astray: from there Newton's method needs up to ten times the factorisations that it needs
        from the warped response.
        """
        start = self._unknowns(guess, "guess")
        start[self._space.fixed] = load.lift[self._space.fixed]
        if not isinstance(guess, Equilibrium):
            return start, True
        gap = self._forms.residual(start, load)
        gap[self._space.fixed] = 0.0
        self._linearise(guess)
        step = -self._newton.linear.solve(gap[None])[0]
        at, ahead = self._merit(start, load), self._merit(start + step, load)
        promised = at if self._space.mixed else -0.5 * self._space.dot(gap, step)
        if 0.0 <= _TRUSTED * promised <= at - ahead:
            return start + step, True
        return (start + step, False) if ahead < at else (start, False)

    def _merit(self, unknowns: Floats, load: Load) -> float:
        """How far from balance a state is, less is closer: its energy under the load; infinite inside out.

        With pressures as unknowns equilibrium is no minimum: the norm of the residual.
        """
        if self._space.mixed:
            gap = self._forms.residual(unknowns, load)
            merit = self._space.norm(gap) if np.isfinite(self._forms.energy(unknowns)) else np.inf
        else:
            work = self._forms.pressure_work(np.zeros_like(unknowns), unknowns, load)
            merit = self._forms.potential(unknowns, load) - work
        return merit if np.isfinite(merit) else np.inf

    def _has_lift(self, load: Load) -> bool:
        return self._space.dot(load.lift, load.lift) > 0.0

    def _first_guess(self, load: Load) -> Floats:
        linear = self._linear_response(load)
        if self.material.is_linear:
            return linear
        if self._space.mixed:
            return self._extended(load)
        if self._has_lift(load):
            return self._warped(linear, load)
        return self._lowest(linear, load)

    def _lowest(self, linear: Floats, load: Load) -> Floats:
        """Of rest and the warped responses to parts of the load, the one of least energy.

        Under the whole load of the liver's tools the response strains the cells beside them so much that its energy is
        above that of rest; the response to a quarter or a half still saves two thirds of the factorisations.
        """
        best, lowest = np.zeros_like(linear), 0.0
        for share in _SHARES:
            start = self._warped(share * linear, load)
            energy = self._merit(start, load)
            if energy < lowest:
                best, lowest = start, energy
            elif lowest < 0.0:
                break
        return best

    def _linear_response(self, load: Load) -> Floats:
        """K(0)^-1 of the dead forces, with prescribed displacements in their place."""
        right = load.dead.copy()
        if self._has_lift(load):
            right -= self._forms.tangent_times(np.zeros_like(right), load.lift)
        if load.pressure:
            right -= self._forms.residual(np.zeros_like(right), replace(load, dead=np.zeros_like(right)))
        right[self._space.fixed] = 0.0
        return load.lift + self._at_rest().solve(right[None])[0]

    def _extended(self, load: Load) -> Floats:
        """Prescribed displacements carried into the body by linear elasticity, no other load."""
        if not self._has_lift(load):
            return np.zeros_like(load.dead)
        return self._linear_response(Load(np.zeros_like(load.dead), load.lift, {}))

    def _at_rest(self) -> LinearSolver:
        if self._rest is None:
            matrix = self._forms.create_matrix()
            self._forms.tangent(np.zeros(self._space.owned), self._unloaded, matrix)
            self._rest = LinearSolver(matrix, self._space, self._newton.linear.method)
        return self._rest

    def _warped(self, linear: Floats, load: Load) -> Floats:
        """The linear response with its rotations made finite: the field whose gradient is closest to exp(W)(I + e) - I.

        On a beam bent by a quarter of its length its energy is within 2 % of the equilibrium's, where the linear
        response is 25 times off. Same idea as modal warping (Choi and Ko 2005), by a Poisson problem instead of modes.
        """
        space = self._space
        if self._poisson is None:
            self._prepare_warping()
        assert self._poisson is not None
        space.set_state(linear)
        space.set_function(self._forms.direction, load.lift)
        right = self._forms.assembled(self._warped_form)
        right[space.fixed] = 0.0
        return load.lift + self._poisson.solve(right[None])[0]

    def _prepare_warping(self) -> None:
        space = self._space
        trial, test = ufl.TrialFunction(space.space), ufl.TestFunction(space.space)
        dx = self._forms.dx
        laplacian = form(ufl.inner(ufl.grad(trial), ufl.grad(test)) * dx)
        missing = _warped_gradient(space.gradient(space.state)) - space.gradient(self._forms.direction)
        self._warped_form = form(ufl.inner(missing, space.gradient(test)) * dx)
        matrix = create_matrix(laplacian)
        assemble(matrix, laplacian, space.conditions)
        self._poisson = LinearSolver(matrix, space, self._newton.linear.method, turns=False)

    def _solve_in_steps(self, given: Loading, load: Load, spent: int, stability: bool, trace: bool) -> Equilibrium:
        reached, good = 0.0, 0
        step = min(_FIRST_STEP, self.options.first_step) if spent else self.options.first_step
        state = np.zeros_like(load.dead)
        last: Attempt | None = None
        for _ in range(self.options.max_load_steps):
            target = min(1.0, reached + step)
            start = state + self._extended(load.scaled(target - reached))
            attempt = self._newton.run(load.scaled(target), start, target, eliminate=True)
            spent += attempt.iterations
            if not attempt.converged:
                step *= _CUT
                if step < _SMALLEST_STEP:
                    break
                continue
            reached, state, good, last = target, attempt.unknowns, good + 1, attempt
            step *= _GROWTH
            if reached == 1.0:
                return self._result(replace(attempt, iterations=spent), given, load, good, stability, trace)
        lines = tuple(self._newton.trace)
        found = None
        if last is not None:
            found = self._result(last, given.scaled(reached), load.scaled(reached), good, True, False)
        advice = (
            "No more load can be added there: a limit point, or a mesh too coarse for it. Try a smaller load, a finer "
            "mesh, or displacements prescribed instead of forces."
            if step < _SMALLEST_STEP
            else "Try a smaller load, a finer mesh where it acts, or more max_load_steps."
        )
        raise NotConverged(
            f"Problem.solve: no equilibrium after {spent} Newton iterations in load steps; {100 * reached:.1f} % of "
            f"the load was reached (last reason: {attempt.reason_name}, residual {attempt.residual:.2g} N). {advice}",
            reached,
            found,
            lines,
        )

    def _result(
        self, attempt: Attempt, given: Loading, load: Load, load_steps: int, stability: bool, trace: bool
    ) -> Equilibrium:
        unknowns = attempt.unknowns
        energy = self._forms.potential(unknowns, load) + self._forms.pressure_potential(unknowns, load)
        iterations, factorisations = attempt.iterations, self._newton.factorisations
        lines = tuple(self._newton.trace) if trace else ()
        return Equilibrium(
            displacement=self._space.field(unknowns),
            energy=energy,
            residual=attempt.residual,
            iterations=iterations,
            factorisations=factorisations,
            load_steps=load_steps,
            reason=attempt.reason_name,
            negative_pivots=self._negative_pivots(unknowns, load) if stability else None,
            pressure=self._space.pressure(unknowns),
            trace=lines,
            local_iterations=self._newton.local_iterations,
            load=given,
        )

    # ------------------------------------------------------------------ the tangent at a state

    def energy(self, displacement: ArrayLike | Equilibrium) -> float:
        """Strain energy of a displacement (n, 3), joules; infinite where a cell is inside out."""
        return self._forms.energy(self._unknowns(displacement))

    def internal_forces(self, displacement: ArrayLike | Equilibrium) -> Floats:
        """Derivative of the strain energy: the nodal forces that hold a displacement, (n, 3), newtons."""
        return self._space.field(self._forms.internal(self._unknowns(displacement)))

    def external_forces(self, load: Loading | ArrayLike, displacement: ArrayLike | None = None) -> Floats:
        """Nodal forces equivalent to a load on free axes, (n, 3), newtons.

        Args:
            load: the load.
            displacement: gives the shape that a following pressure acts on, (n, 3), metres; rest if not given.
        """
        _, wanted = self._load(load)
        unknowns = self._unknowns(displacement)
        pressed = self._forms.pressed(unknowns, wanted)
        pressed[self._space.fixed] = 0.0
        return self._space.field(wanted.dead - pressed)

    def stiffness(self, displacement: ArrayLike | Equilibrium | None = None) -> csr_matrix:
        """Tangent stiffness in the body's order, (3n, 3n), N/m; rows and columns of held axes are the identity's.

        An equilibrium's following pressures are part of it; a displacement alone has none.

        Raises:
            RuntimeError: the mesh is shared between ranks, or pressures are unknowns.
        """
        if self._space.comm.size > 1 or self._space.mixed:
            raise RuntimeError("Problem.stiffness: expected one rank and displacements alone as unknowns.")
        self._linearise(displacement)
        return self._in_body_order(self._newton.matrix)

    def mass(self, density: float = 1.0) -> csr_matrix:
        """Consistent mass matrix in the body's order, (3n, 3n), kg.

        Args:
            density: kg/m^3.
        """
        trial, test = ufl.TrialFunction(self._space.space), ufl.TestFunction(self._space.space)
        dx = self._space.measure(2 * self.body.kind.degree)
        compiled = form(self._forms.weights * density * ufl.inner(trial, test) * dx)
        matrix = create_matrix(compiled)
        assemble(matrix, compiled, [])
        found = self._in_body_order(matrix)
        matrix.destroy()
        return found

    def _in_body_order(self, matrix: Any) -> csr_matrix:
        indptr, indices, data = matrix.getValuesCSR()
        index = np.empty(self.body.points.size, dtype=np.int64)
        rows = (self.body.dimension * self._space.nodes[:, None] + np.arange(self.body.dimension)).ravel()
        index[rows] = self._space.own_numbers
        return csr_matrix((data, indices, indptr), shape=matrix.getSize())[index][:, index]

    def apply_inverse(
        self, columns: ArrayLike, displacement: ArrayLike | Equilibrium | None = None, *, transpose: bool = False
    ) -> Floats:
        """K(u)^-1 applied to many right-hand sides with one factorisation.

        Args:
            columns: nodal forces or cotangents, (3n, k) or (3n,), in the body's order; held axes are ignored.
            displacement: an equilibrium, whose pressures belong to its tangent; or a displacement alone, (n, 3),
                metres, under no following pressure; rest if not given. The last factorisation is used again where it
                was made at the same state.
            transpose: K(u)^-T; another matrix where a following pressure makes the tangent unsymmetric.

        Raises:
            ValueError: wrong shape, or a displacement alone where the pressure is an unknown.
        """
        right = np.asarray(columns, dtype=np.float64)
        count = self.body.points.size
        if right.shape[:1] != (count,) or right.ndim > 2:
            raise ValueError(f"apply_inverse.columns: expected shape ({count}, k), got {right.shape}.")
        if not np.isfinite(right).all():
            raise ValueError("apply_inverse.columns: expected finite numbers, got NaN or infinity.")
        self._linearise(displacement)
        rows = self._space.rows(right.reshape(count, -1).T.reshape(-1, *self.body.points.shape))
        rows[:, self._space.fixed] = 0.0
        solved = self._newton.linear.solve(rows, transpose)
        return self._space.field(solved).reshape(len(rows), count).T.reshape(right.shape)

    def negative_pivots(self, displacement: ArrayLike | Equilibrium | None = None) -> int | None:
        """Negative pivots of the tangent at a state: 0 is stable.

        None where nothing is factored (multigrid) or where following pressures make the tangent unsymmetric.

        Args:
            displacement: an equilibrium, or a displacement alone, (n, 3), under no following pressure; rest if not
                given.
        """
        return self._negative_pivots(*self._tangent_point(displacement))

    def _negative_pivots(self, unknowns: Floats, load: Load) -> int | None:
        if self._newton.linear.method == "multigrid":
            return None
        self._newton.linearise(unknowns, load)
        pivots = self._newton.linear.negative_pivots()
        return None if pivots is None else pivots - self._space.pressures  # a saddle point has one for each pressure

    def _linearise(self, state: ArrayLike | Equilibrium | None) -> None:
        self._newton.linearise(*self._tangent_point(state))

    def _tangent_point(self, state: ArrayLike | Equilibrium | None) -> tuple[Floats, Load]:
        """What a tangent depends on: unknowns, and following pressures."""
        if isinstance(state, Equilibrium):
            pressure = {name: float(value) for name, value in state.load.pressure.items() if value != 0.0}
            return self._unknowns(state), replace(self._unloaded, pressure=pressure)
        if state is not None and self._space.mixed:
            raise ValueError(
                "Problem.displacement: expected an Equilibrium, for the tangent depends on its pressure, "
                f"got {type(state).__name__}."
            )
        return self._unknowns(state), self._unloaded

    def _unknowns(self, state: ArrayLike | Equilibrium | None, name: str = "displacement") -> Floats:
        if state is None:
            return np.zeros(self._space.owned)
        if isinstance(state, Equilibrium):
            return self._space.unknowns(f"Problem.{name}", state.displacement, state.pressure)
        return self._space.unknowns(f"Problem.{name}", state)


def _free(solver: LinearSolver | None) -> None:
    if solver is not None:
        solver.close()
        solver.matrix.destroy()


def _checked_weights(weights: ArrayLike, cells: int) -> Floats:
    values = np.asarray(weights, dtype=np.float64)
    if values.shape != (cells,):
        raise ValueError(f"Problem.weights: expected one number for each of the {cells} cells, got {values.shape}.")
    if not ((values > 0.0) & (values <= 1.0)).all():
        raise ValueError(f"Problem.weights: expected numbers in (0, 1], got {values.min()} to {values.max()}.")
    return values


def _warped_gradient(G: Any) -> Any:
    """exp(W)(I + e) - I for a displacement gradient G = e + W (Rodrigues' formula)."""
    identity = ufl.Identity(3)
    W = ufl.skew(G)
    angle = ufl.sqrt(ufl.inner(W, W) / 2 + 1e-12)
    rotation = identity + ufl.sin(angle) / angle * W + (1 - ufl.cos(angle)) / angle**2 * W * W
    return rotation * (identity + ufl.sym(G)) - identity
