"""Hyperelastic equilibria of a body under any mix of loads (PETSc SNES; MUMPS or multigrid)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix

from softtwin.meshes.body import Body

from ..data.loading import Loading
from ..data.materials import Material
from ..data.outcome import Equilibrium, NotConverged
from ..data.springs import Ligament, Springs, Support
from ..fem.fenicsx import MPI, assemble_matrix, create_matrix, form, ufl
from ..fem.forms import DiscreteLoad
from .continuation import in_load_steps
from .newton import Attempt, Newton, NewtonOptions
from .path import LoadPath
from .start import Proposal, Starts
from .system import System

__all__ = ["Ligament", "Loading", "NewtonOptions", "Problem", "Springs"]

Floats = NDArray[np.float64]
_FIRST_STEP = 0.25  # of the load where the whole load has failed


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
        weights: factor of each cell's energy, (cells,), in (0, 1], in place of the body's own fractions.
        quadrature: polynomial degree that the quadrature is exact for; the least that is safe if not given.
        comm: communicator that shares the mesh; each rank on its own if not given.
        springs: that hold named surfaces (`boundary`: all of it) and give way, beside what is held; ligaments by a name
            of their own.

    Raises:
        ValueError: a rigid motion is left, a parameter with another number of cells, a mixed material on linear cells,
            springs on a surface that is not there.
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
        springs: Mapping[str, Support] | None = None,
    ) -> None:
        self.options = options or NewtonOptions()
        everything = "xyz"[: body.dimension]
        kept = dict(held) if held is not None else ({"fixed": everything} if "fixed" in body.node_sets else {})
        self.system = System(body, material, kept, weights, quadrature, self.options.linear, comm, springs)
        self._space = self.system.space
        self._newton = Newton(self.system.forms, self.system.tangent, self.options)
        self._starts = Starts(self.system)

    @property
    def body(self) -> Body:
        """The body."""
        return self.system.body

    @property
    def held(self) -> Mapping[str, str]:
        """Axes whose displacement is prescribed at named node sets."""
        return self.system.held

    @property
    def material(self) -> Material:
        """Strain energy, with the parameters that it has now."""
        return self.system.material

    def close(self) -> None:
        """Free the PETSc objects; the problem cannot be used after, nor can derivatives of its states."""
        if isinstance(self.system, _Closed):
            return
        self._newton.close()
        self._starts.close()
        self.system.close()
        gone: Any = _Closed(self.system)  # PETSc ends the process that uses what was given back
        self.system = self._newton = self._starts = self._space = gone

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
        self.system.forms.set_material(material)
        self._newton.forget()
        self._starts.forget()

    def set_springs(self, factors: Mapping[str, float]) -> None:
        """Springs that are stiffer or softer than they were given; nothing is compiled again.

        Args:
            factors: how many times as stiff, above 0, by the surface that they hold; others are as given.

        Raises:
            ValueError: no springs there, or a factor out of range.
        """
        strange = sorted(factors.keys() - self.system.springs.keys())
        if strange:
            raise ValueError(
                f"Problem.set_springs: expected surfaces with springs, {sorted(self.system.springs)}, "
                f"got {strange[0]!r}."
            )
        for name, factor in factors.items():
            if not 0.0 < factor < np.inf:
                raise ValueError(f"Problem.set_springs[{name!r}]: expected a factor above 0, got {factor}.")
        self.system.forms.set_springs(factors)
        self._newton.forget()
        self._starts.forget()

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
        proposal: ArrayLike | Proposal | None = None,
        stability: bool = True,
        fallback: bool = True,
        trace: bool = False,
    ) -> Equilibrium:
        """The displacement that balances a load.

        Tries the full load from the guess, then from the warped linear response (before the guess where an equilibrium
        is too far), then from rest, then in load steps that are halved where they fail and grow where they succeed.
        What prescribed displacements turn goes by its screw (`LoadPath`), by half a turn at most.

        Args:
            load: the load, or nodal forces alone, (n, 3), newtons.
            guess: displacement whose neighbour is wanted, (n, 3), metres, or another equilibrium, which is first moved
                along its tangent by the change of the load, or turned where held nodes turn from there: so a twist goes
                on beyond half a turn; the warped linear response if not given.
            proposal: displacement that is thought to be near this load's equilibrium, a network's answer for instance,
                (n, 3), metres, or a function that says it (or None) from the linear response, (n, 3). It stands beside
                the warped response: the one of less energy is tried first. Where the proposal leads to a state that is
                no minimum, the others are tried, too.
            stability: also factor the tangent at the state and count its negative pivots.
            fallback: try the other ways where the guess fails; without, a failure there (and from the warped linear
                response, where an equilibrium is too far) is raised at once.
            trace: keep every iteration in the result.

        Raises:
            ValueError: wrong shape, NaN or infinity, unknown names, forces on held nodes.
            NotConverged: no way led to an equilibrium; it holds the last one that was found on the way.
        """
        given, wanted = self.system.load(load)
        path = LoadPath(self.system, given, wanted)
        self._newton.start_count()
        spent = 0
        if self.options.first_step == 1.0 or guess is not None or proposal is not None:
            for start in self._starts.candidates(path, guess, proposal, fallback):
                attempt = self._newton.run(wanted, start.unknowns, eliminate=start.may_leave, near=start.has_tangent)
                spent += attempt.iterations
                if attempt.converged and (start.name != "proposal" or self._is_lowest(attempt, wanted, stability)):
                    found = replace(attempt, iterations=spent)
                    return self._result(found, given, wanted, 1, start.name, stability=stability, trace=trace)
            if not fallback:
                raise NotConverged(
                    f"Problem.solve: no equilibrium near the guess ({attempt.reason_name} after {spent} iterations). "
                    "Try a smaller change of the load, or fallback=True.",
                    trace=tuple(self._newton.trace),
                )
        return self._solve_in_steps(path, spent, stability, trace)

    def _is_lowest(self, attempt: Attempt, load: DiscreteLoad, by_its_own: bool) -> bool:
        """Whether the energy is least where a stranger's proposal led; True where nobody knows.

        Steps by a definite matrix are led away from a state that is no minimum: its own tangent K has a direction that
        I - A^-1 K makes longer. Converged with such a matrix A it is one, but for errors that symmetry keeps at zero.

        Args:
            attempt: where the proposal led.
            load: that acts there.
            by_its_own: ask the tangent of the state itself, not the last one on the way.
        """
        tangent = self.system.tangent
        if not by_its_own and tangent.factorisations and tangent.linear.negative_pivots() == 0:
            return True
        return not tangent.negative_pivots(attempt.unknowns, load)

    def _solve_in_steps(self, path: LoadPath, spent: int, stability: bool, trace: bool) -> Equilibrium:
        first = min(_FIRST_STEP, self.options.first_step) if spent else self.options.first_step
        found = in_load_steps(self._newton, self._starts, path, first)
        spent += found.iterations
        if found.last is not None and found.reached == 1.0:
            whole = replace(found.last, iterations=spent)
            return self._result(whole, path.loading(1.0), path.whole, found.load_steps, "load steps", stability, trace)
        lines = tuple(self._newton.trace)
        last = None
        if found.last is not None:
            part = path.loading(found.reached), path.load(found.reached)
            last = self._result(found.last, *part, found.load_steps, "load steps", True, False)
        advice = (
            "No more load can be added there: a limit point, or a mesh too coarse for it. Try a smaller load, a finer "
            "mesh, or displacements prescribed instead of forces."
            if found.is_limit
            else "Try a smaller load, a finer mesh where it acts, or more max_load_steps."
        )
        raise NotConverged(
            f"Problem.solve: no equilibrium after {spent} Newton iterations in load steps; {100 * found.reached:.1f} % "
            f"of the load was reached (last reason: {found.tried.reason_name}, residual {found.tried.residual:.2g} N). "
            f"{advice}",
            found.reached,
            last,
            lines,
        )

    def _result(
        self,
        attempt: Attempt,
        given: Loading,
        load: DiscreteLoad,
        load_steps: int,
        start: str,
        stability: bool,
        trace: bool,
    ) -> Equilibrium:
        unknowns, forms, tangent = attempt.unknowns, self.system.forms, self.system.tangent
        energy = forms.potential(unknowns, load) + forms.pressure_potential(unknowns, load)
        factorisations = tangent.factorisations  # before those for the pivots
        return Equilibrium(
            displacement=self._space.field(unknowns),
            energy=energy,
            residual=attempt.residual,
            iterations=attempt.iterations,
            factorisations=factorisations,
            load_steps=load_steps,
            reason=attempt.reason_name,
            negative_pivots=tangent.negative_pivots(unknowns, load) if stability else None,
            pressure=self._space.pressure(unknowns),
            trace=tuple(self._newton.trace) if trace else (),
            local_iterations=self._newton.local_iterations,
            load=given,
            start=start,
        )

    # ------------------------------------------------------------------ the tangent at a state

    def energy(self, displacement: ArrayLike | Equilibrium) -> float:
        """Strain energy of a displacement (n, 3), joules; infinite where a cell is inside out."""
        return self.system.forms.energy(self.system.unknowns(displacement))

    def internal_forces(self, displacement: ArrayLike | Equilibrium) -> Floats:
        """Derivative of the strain energy: the nodal forces that hold a displacement, (n, 3), newtons."""
        return self._space.field(self.system.forms.internal(self.system.unknowns(displacement)))

    def external_forces(self, load: Loading | ArrayLike, displacement: ArrayLike | None = None) -> Floats:
        """Nodal forces equivalent to a load on free axes, (n, 3), newtons.

        Args:
            load: the load.
            displacement: gives the shape that a following pressure acts on, (n, 3), metres; rest if not given.
        """
        _, wanted = self.system.load(load)
        pressed = self.system.forms.pressed(self.system.unknowns(displacement), wanted)
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
        tangent = self.system.tangent
        tangent.linearise(*self.system.point(displacement))
        return self.system.in_body_order(tangent.matrix)

    def mass(self, density: float = 1.0) -> csr_matrix:
        """Consistent mass matrix in the body's order, (3n, 3n), kg.

        Args:
            density: kg/m^3.
        """
        trial, test = ufl.TrialFunction(self._space.space), ufl.TestFunction(self._space.space)
        dx = self._space.measure(2 * self.body.kind.degree)
        compiled = form(self.system.forms.weights * density * ufl.inner(trial, test) * dx)
        matrix = create_matrix(compiled)
        assemble_matrix(matrix, compiled, [])
        found = self.system.in_body_order(matrix)
        matrix.destroy()
        return found

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
        rows = self._space.rows(right.reshape(count, -1).T.reshape(-1, *self.body.points.shape))
        solved = self.system.tangent.solve(*self.system.point(displacement), rows, transpose)
        return self._space.field(solved).reshape(len(rows), count).T.reshape(right.shape)

    def negative_pivots(self, displacement: ArrayLike | Equilibrium | None = None) -> int | None:
        """Negative pivots of the tangent at a state: 0 is stable.

        None where nothing is factored (multigrid) or where following pressures make the tangent unsymmetric.

        Args:
            displacement: an equilibrium, or a displacement alone, (n, 3), under no following pressure; rest if not
                given.
        """
        return self.system.tangent.negative_pivots(*self.system.point(displacement))


class _Closed:
    """Stands where a problem's parts were."""

    def __init__(self, system: System) -> None:
        self.body, self.held, self.material = system.body, system.held, system.material

    def __getattr__(self, name: str) -> Any:
        raise RuntimeError(
            "Problem: expected an open problem, got one that was closed; ask for derivatives and deviations before."
        )
