"""States that Newton's method may start from, the most promising first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.outcome import Equilibrium
from ..fem.fenicsx import add_matrix, assemble_matrix, create_matrix, facet_matrix, form, ufl
from ..fem.forms import DiscreteLoad
from .linear import LinearSolver
from .path import LoadPath
from .system import System
from .tangent import factored

Floats = NDArray[np.float64]
Proposal = Callable[[Floats], Floats | None]
"""From the linear response to a load, (n, 3), to a displacement thought to be near its equilibrium, if there is one."""
_SHARES = (1.0, 0.5, 0.25)  # of the load whose linear response is warped for a start
_TRUSTED = 0.9  # of the decrease that the tangent promises: less, and the warped response may be the better start


@dataclass(frozen=True, eq=False)
class Start:
    """Unknowns to start from.

    Args:
        unknowns: this rank's.
        name: where it comes from: `guess`, `proposal`, `linear response` (warped), `rotation` or `rest`.
        may_leave: whether another equilibrium than the nearest may be found from here: then a few cells may be balanced
            alone on the way.
        has_tangent: whether the tangent that is factored is that of a state nearby.
    """

    unknowns: Floats
    name: str
    may_leave: bool = True
    has_tangent: bool = False


class Starts:
    """First guesses for one body; what they need is factored when it is first asked for."""

    def __init__(self, system: System) -> None:
        self._system, self._space, self._forms = system, system.space, system.forms
        self._rest: LinearSolver | None = None
        self._poisson: LinearSolver | None = None
        self._warped_forms: list[Any] = []

    def close(self) -> None:
        """Free the PETSc objects."""
        self.forget()
        _free(self._poisson)

    def forget(self) -> None:
        """The material has changed."""
        _free(self._rest)
        self._rest = None

    def candidates(
        self,
        path: LoadPath,
        guess: ArrayLike | Equilibrium | None,
        proposal: ArrayLike | Proposal | None,
        fallback: bool,
    ) -> Iterator[Start]:
        """Starts for a load, the most promising first.

        Args:
            path: of the load that is wanted.
            guess: state whose neighbour is wanted: it comes first while its tangent can be trusted.
            proposal: displacement that is thought to be near an equilibrium of this load, whichever, or a function that
                says it: it competes with the warped linear response, and the one of less energy comes first.
            fallback: also rest, and what comes after a guess that is near.
        """
        load, seen = path.whole, path.seen(1.0)
        near, is_trusted = (None, False) if guess is None else self._near(guess, path)
        if near is not None and is_trusted:
            yield near
            if not fallback:
                return
        linear = self._linear_response(seen)
        first, merit = self._first_guess(linear, seen)
        if seen is not load:  # merits differ by the work on the way of the frame
            linear, first, merit = path.carried(linear, 1.0), path.carried(first, 1.0), None
        starts = [Start(first, "linear response")]
        screws = self.screws(path)
        if screws is not None:
            starts.append(Start(self.ahead(path, screws, np.zeros_like(load.dead), 0.0, 1.0), "rotation"))
        if near is not None and not is_trusted:
            starts.append(near)
        proposed = proposal(self._space.field(linear)) if callable(proposal) else proposal
        if proposed is not None:
            starts.append(Start(self._lifted(proposed, load, "proposal"), "proposal"))
        if len(starts) > 1:
            merits = [self._merit(first, load) if merit is None else merit]
            merits += [self._merit(start.unknowns, load) for start in starts[1:]]
            starts = [starts[place] for place in np.argsort(merits, kind="stable")]
        yield from starts
        if fallback and not self._has_lift(seen):
            yield Start(path.carried(np.zeros_like(load.dead), 1.0), "rest")

    def _lifted(self, state: ArrayLike | Equilibrium, load: DiscreteLoad, name: str) -> Floats:
        """A state with its held unknowns where the load wants them."""
        start = self._system.unknowns(state, name)
        start[self._space.fixed] = load.lift[self._space.fixed]
        return start

    def _near(self, guess: ArrayLike | Equilibrium, path: LoadPath) -> tuple[Start, bool]:
        """The guess, an equilibrium moved along its tangent by the change of the load, and whether that can be trusted.

        A large change leads astray: from there Newton's method needs up to ten times the factorisations that it needs
        from the warped response. Where held nodes turn far from the guess, it turns with them.
        """
        load = path.whole
        start = self._lifted(guess, load, "guess")
        if not isinstance(guess, Equilibrium):
            turned = self._turned(guess, path)
            return Start(start if turned is None else turned, "guess", may_leave=False), True
        gap = self._forms.residual(start, load)
        gap[self._space.fixed] = 0.0
        at, tangent = self._merit(start, load), self._system.tangent
        solved = tangent.solve_as_it_is(load, gap[None])  # it may be near enough, and saves a factorisation
        if solved is not None:
            step = -solved[0]
            if self._descends(start, step, gap, at, load)[0] and self._reduces_residual(start + step, gap, load):
                return Start(start + step, "guess", may_leave=False, has_tangent=True), True
        step = -tangent.solve(*self._system.point(guess), gap[None])[0]
        is_kept, ahead = self._descends(start, step, gap, at, load)
        if is_kept:
            return Start(start + step, "guess", may_leave=False, has_tangent=True), True
        turned = self._turned(guess, path)
        if turned is not None:
            return Start(turned, "guess", may_leave=False), True
        return Start(start + step if ahead < at else start, "guess"), False

    def _descends(
        self, start: Floats, step: Floats, gap: Floats, merit: float, load: DiscreteLoad
    ) -> tuple[bool, float]:
        """Whether a step leads as far down as its tangent promises, and the merit where it leads.

        Args:
            start: unknowns.
            step: from there.
            gap: the residual there.
            merit: there.
            load: that is wanted.
        """
        ahead = self._merit(start + step, load)
        promised = merit if self._space.mixed else -0.5 * self._space.dot(gap, step)
        return bool(0.0 <= _TRUSTED * promised <= merit - ahead), ahead

    def _reduces_residual(self, unknowns: Floats, gap: Floats, load: DiscreteLoad) -> bool:
        """Whether less is left of a residual: further steps with the same tangent go on from there."""
        left = self._forms.residual(unknowns, load)
        left[self._space.fixed] = 0.0
        return bool(self._space.norm(left) < self._space.norm(gap))

    def _turned(self, guess: ArrayLike | Equilibrium, path: LoadPath) -> Floats | None:
        """The guess turned as held nodes turn from there; None where they do not, or where that folds a cell."""
        state = self._system.unknowns(guess, "guess")
        way = path.since(self._space.field(state))
        turned = self.ahead(way, self.screws(way), state, 0.0, 1.0) if way.turns else None
        return None if turned is None or self._merit(turned, path.whole) == np.inf else turned

    def _merit(self, unknowns: Floats, load: DiscreteLoad) -> float:
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

    def _has_lift(self, load: DiscreteLoad) -> bool:
        return self._space.dot(load.lift, load.lift) > 0.0

    def _first_guess(self, linear: Floats, load: DiscreteLoad) -> tuple[Floats, float | None]:
        """Where to start from, and its merit if that is known."""
        if self._system.material.is_linear:
            return linear, None
        if self._space.mixed:
            return self.extended(load.lift), None
        if self._has_lift(load):
            return self._warped(linear, load), None
        return self._lowest(linear, load)

    def _lowest(self, linear: Floats, load: DiscreteLoad) -> tuple[Floats, float]:
        """Of rest and the warped responses to parts of the load, the one of least energy, and that energy.

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
        return best, lowest

    def _linear_response(self, load: DiscreteLoad) -> Floats:
        """K(0)^-1 of the dead forces, with prescribed displacements in their place."""
        right = load.dead.copy()
        if self._has_lift(load):
            right -= self._forms.tangent_times(np.zeros_like(right), load.lift)
        if load.pressure:
            right -= self._forms.residual(np.zeros_like(right), replace(load, dead=np.zeros_like(right)))
        right[self._space.fixed] = 0.0
        return load.lift + self._at_rest().solve(right[None])[0]

    def extended(self, lift: Floats) -> Floats:
        """Prescribed displacements carried into the body by linear elasticity, no other load."""
        load = replace(DiscreteLoad.none(self._space), lift=lift)
        return self._linear_response(load) if self._has_lift(load) else np.zeros_like(lift)

    def screws(self, path: LoadPath) -> tuple[Floats, Floats] | None:
        """Screws of held nodes over a path, angles and velocities, carried into the body; None where none turns far."""
        screws = path.screws
        return None if screws is None else (self._harmonic(screws[0]), self._harmonic(screws[1]))

    def _harmonic(self, lift: Floats) -> Floats:
        load = replace(DiscreteLoad.none(self._space), lift=lift)
        return self._warped(np.zeros_like(lift), load)

    def ahead(
        self, path: LoadPath, screws: tuple[Floats, Floats] | None, state: Floats, reached: float, target: float
    ) -> Floats:
        """A state at a part of a load moved by the change of the prescribed displacements to another part.

        The body goes by the screws, and by linear elasticity for what these leave.

        Args:
            path: parts of the load.
            screws: as `screws` gives them.
            state: unknowns.
            reached: the part of the load that it is at.
            target: the part wanted.
        """
        seen = path.from_frame(state, reached)
        missing = path.seen(target).lift - path.seen(reached).lift
        if screws is not None:
            angles, velocities = screws
            seen = path.screwed(seen, (target - reached) * angles, (target - reached) * velocities)
            missing[self._space.fixed] = (path.seen(target).lift - seen)[self._space.fixed]
        return path.carried(seen + self.extended(missing), target)

    def _at_rest(self) -> LinearSolver:
        if self._rest is None:
            matrix = self._forms.create_matrix()
            self._forms.tangent(np.zeros(self._space.owned), DiscreteLoad.none(self._space), matrix)
            self._rest = factored(matrix, self._system.tangent)
        return self._rest

    def _warped(self, linear: Floats, load: DiscreteLoad) -> Floats:
        """The linear response with its rotations made finite: the field whose gradient is closest to exp(W)(I + e) - I.

        On a beam bent by a quarter of its length its energy is within 2 % of the equilibrium's, where the linear
        response is 25 times off. Same idea as modal warping (Choi and Ko 2005), by a Poisson problem instead of modes.
        """
        space = self._space
        if self._poisson is None:
            self._poisson = self._prepare_warping()
        space.set_state(linear)
        space.set_function(self._forms.direction, load.lift)
        right = self._forms.assembled(*self._warped_forms)
        right[space.fixed] = 0.0
        return load.lift + self._poisson.solve(right[None])[0]

    def _prepare_warping(self) -> LinearSolver:
        space, dx, split = self._space, self._forms.dx, self._forms.split
        (trial, p), (test, q) = split(ufl.TrialFunction(space.space)), split(ufl.TestFunction(space.space))
        energy = ufl.inner(ufl.grad(trial), ufl.grad(test))
        laplacian = form((energy + p * q if space.mixed else energy) * dx)  # pressures are kept out of it
        state, direction = split(space.state)[0], split(self._forms.direction)[0]
        missing = _warped_gradient(space.gradient(state)) - space.gradient(direction)
        warped = [ufl.inner(missing, space.gradient(test)) * dx]
        matrix = create_matrix(laplacian)
        assemble_matrix(matrix, laplacian, space.conditions)
        for springs in self._forms.springs:  # they hold the field where the linear response has it
            add_matrix(matrix, facet_matrix(form(ufl.inner(trial, test) / space.body.size * springs.ds), space.fixed))
            warped.append(ufl.inner(state - direction, test) / space.body.size * springs.ds)
        self._warped_forms = [form(part) for part in warped]
        return factored(matrix, self._system.tangent, turns=False)


def _warped_gradient(G: Any) -> Any:
    """exp(W)(I + e) - I for a displacement gradient G = e + W (Rodrigues' formula)."""
    identity = ufl.Identity(3)
    W = ufl.skew(G)
    angle = ufl.sqrt(ufl.inner(W, W) / 2 + 1e-12)
    rotation = identity + ufl.sin(angle) / angle * W + (1 - ufl.cos(angle)) / angle**2 * W * W
    return rotation * (identity + ufl.sym(G)) - identity


def _free(solver: LinearSolver | None) -> None:
    if solver is not None:
        solver.close()
        solver.matrix.destroy()
