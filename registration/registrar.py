"""Clouds to states of one body: prepared once, then frame after frame, each from what the last one found."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.reference.data.outcome import NotConverged

from .cloud import Cloud
from .conclusion import conclude
from .expectations import Expectations
from .forward import ForwardModel
from .hyperparameters import LogNormalPrior
from .options import RegistrationOptions
from .parameters.block import ParameterBlock
from .parameters.inputs import InputBlocks
from .parameters.nodal_forces import LikelihoodInformed, NodalForces, known_forces, nodal_forces, normal_forces
from .parameters.pose import PosePrior
from .policy import ACCURACY, POLICY
from .prepared import Prepared
from .residuals.term import ResidualTerm
from .result import Registration, badness
from .setup import Ended, Setup
from .strategies.cold_start import finish, localise
from .strategies.elsewhere import compared, is_missed
from .strategies.refinement import refine
from .strategies.resuming import Found, resume
from .strategies.tracking import has_left, track
from .surface_distance import SurfaceDistance
from .tracker import Tracker
from .verdict import Verdict

Floats = NDArray[np.float64]


class Registrar:
    """Registers clouds to one body with one model; what does not depend on the cloud is prepared once.

    Args:
        model: forward model.
        observed: the observed side.
        forces: the unknown forces.
        options: noise, solver, thinning, search for the place of the forces.
        pose: prior of the pose; None for clouds in the body's coordinates.
        expectations: what a usable result looks like; by the body's size and the noise if not given.
        inputs: unknown inputs beside the forces, which the model takes; none if not given.
        blocks: further parameters.
        modulus_deviation: of the logarithm of Young's modulus, where this is no unknown: forces found are the more in
            doubt by it. Under nodal forces alone states depend on forces over stiffness, and are not.
        anywhere: makes the same with forces anywhere, which is asked where neighbouring points are missed alike; None
            for forces that act nowhere else.

    Raises:
        ValueError: inputs that the model does not take, or a negative deviation.
    """

    def __init__(
        self,
        model: ForwardModel,
        observed: SurfaceDistance,
        forces: NodalForces,
        options: RegistrationOptions | None = None,
        *,
        pose: PosePrior | None = None,
        expectations: Expectations | None = None,
        inputs: InputBlocks | None = None,
        blocks: Sequence[ParameterBlock] = (),
        modulus_deviation: float = 0.0,
        anywhere: Callable[[], Registrar] | None = None,
    ) -> None:
        if not 0.0 <= modulus_deviation < np.inf:
            raise ValueError(f"Registrar.modulus_deviation: expected 0 or more, got {modulus_deviation}.")
        self.setup = Setup.of(
            model,
            observed,
            forces,
            options or RegistrationOptions(),
            expectations=expectations,
            pose=pose,
            inputs=inputs,
            blocks=tuple(blocks),
        )
        is_found = inputs is not None and inputs.modulus is not None
        self.modulus_deviation = 0.0 if is_found else modulus_deviation
        self.anywhere = None if anywhere is None else cache(anywhere)  # made when it is first asked for

    @property
    def model(self) -> ForwardModel:
        """The forward model."""
        return self.setup.model

    @property
    def observed(self) -> SurfaceDistance:
        """The observed side."""
        return self.setup.observed

    @property
    def forces(self) -> NodalForces:
        """The unknown forces."""
        return self.setup.forces

    @property
    def pose(self) -> PosePrior | None:
        """Prior of the pose; None for clouds in the body's coordinates."""
        return self.setup.pose

    @property
    def options(self) -> RegistrationOptions:
        """Noise, solver, thinning, search for the place of the forces."""
        return self.setup.options

    def with_pose(self, pose: PosePrior) -> Registrar:
        """The same with an unknown pose."""
        anywhere, other = self.anywhere, self._with(replace(self.setup, pose=pose))
        other.anywhere = None if anywhere is None else cache(lambda: anywhere().with_pose(pose))
        return other

    def _with(self, setup: Setup) -> Registrar:
        other = copy.copy(self)
        other.setup = setup
        return other

    def with_model(self, model: ForwardModel) -> Registrar:
        """The same with another model of the same body, such as a surrogate that has learned more since.

        Args:
            model: the model; results of the one before it may be started from.
        """
        anywhere, other = self.anywhere, self._with(self.setup.with_model(model))
        other.anywhere = None if anywhere is None else cache(lambda: anywhere().with_model(model))
        return other

    def limited(self, until: float) -> Registrar:
        """The same, which begins no step after a time of the monotonic clock, seconds, and gives the best so far."""
        return self._with(self.setup.with_solver(until=until))

    def beside(self, before_step: Callable[[], None]) -> Registrar:
        """The same for a thread beside the frames: see `Tracker`.

        Args:
            before_step: called before each step; it may wait.
        """
        return self._with(self.setup.with_solver(until=np.inf, before_step=before_step))

    def with_terms(self, *terms: ResidualTerm) -> Registrar:
        """The same with other measurements that pull beside the cloud, landmarks say, in place of those before.

        Args:
            terms: of the same observed side; normals come with the cloud.
        """
        return self._with(replace(self.setup, terms=terms))

    def register(self, cloud: ArrayLike, start: Registration | None = None) -> Registration:
        """The forces, the state and the pose that bring the observed side to a cloud.

        Args:
            cloud: observed points, (p, 3), metres; with the normals measured there behind them (p, 6): see `Cloud`.
            start: an earlier frame's result to start from; no force if not given.

        Raises:
            CloudError: a cloud without one point of finite coordinates, or one that lies too far from the body.
            NotConverged: the model found no state at the start.
        """
        return self.asked(cloud, self._registered(cloud, start)[0])

    def track(self, cloud: ArrayLike, last: Registration) -> Registration:
        """The next frame of a sequence from the last one alone, with forces in the zone alone; see `Tracker`.

        Args:
            cloud: observed points, (p, 3), metres.
            last: the last usable result.

        Raises:
            CloudError, NotConverged: as for `register`.
        """
        begin = time.perf_counter()
        return self._concluded(track(self.setup, self.setup.checked(cloud), last), begin)

    def resumed(self, cloud: ArrayLike, found: Found) -> Registration:
        """A cloud from what another process has found for it: see `strategies.resuming`.

        Args:
            cloud: observed points, (p, 3), metres.
            found: for it.

        Raises:
            CloudError, NotConverged: as for `register`.
        """
        begin = time.perf_counter()
        return self._concluded(resume(self.setup, self.setup.checked(cloud), found), begin)

    def is_lost(self, found: Registration, last: Registration) -> bool:
        """Whether what was tracked has to be searched for from rest: it is not accepted, or met much worse.

        Args:
            found: what was tracked.
            last: from where.
        """
        return found.judgement.verdict is not Verdict.ACCEPTED or has_left(self.setup, found, last)

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """The next frame of a sequence: from the last one, and from rest where that is not accepted.

        Args:
            cloud: observed points, (p, 3), metres.
            last: the last usable result; None for the first frame.

        Raises:
            CloudError: a cloud without one point of finite coordinates, or one that lies too far from the body.
            NotConverged: the model found no state at rest.
        """
        if last is None:
            return self.register(cloud)
        try:
            found, has_searched = self._registered(cloud, last)
        except NotConverged:
            return self.register(cloud)
        found = self.asked(cloud, found)
        if found.judgement.verdict is Verdict.ACCEPTED or has_searched or self.setup.is_late:
            return found
        return min(found, self.register(cloud), key=badness)

    def refine(
        self, cloud: ArrayLike, draft: Registration, fast: ForwardModel, last: Registration | None = None
    ) -> Registration:
        """What this model makes of a cloud, from what a faster model of the same body has found for it.

        Args:
            cloud: observed points, (p, 3), metres.
            draft: the faster model's result: see `strategies.refinement`.
            fast: that model.
            last: this model's result for the frame before.

        Raises:
            CloudError, NotConverged: as for `register`.
        """
        begin = time.perf_counter()
        ended = refine(self.setup, self.setup.checked(cloud), draft, fast, last)
        return self.asked(cloud, replace(self._concluded(ended, begin), draft=draft))

    def is_missed(self, found: Registration) -> bool:
        """Whether forces in the zone leave what neighbouring points share, and those elsewhere may explain it.

        Args:
            found: a result with forces in the zone alone.
        """
        return self.anywhere is not None and found.judgement.is_usable and is_missed(self.setup, found)

    def asked(self, cloud: ArrayLike, found: Registration) -> Registration:
        """A result, doubtful where forces elsewhere explain what it leaves: a second registration where it is missed.

        Args:
            cloud: that it is of, (p, 3), metres.
            found: the result.
        """
        if not self.is_missed(found) or self.anywhere is None or self.setup.is_late:
            return found
        try:
            anywhere = self.anywhere()
        except ValueError:  # a network has learned no forces there
            return found
        solver = self.options.solver
        with suppress(NotConverged):
            hurried = anywhere._with(anywhere.setup.with_solver(until=solver.until, before_step=solver.before_step))
            other = hurried.with_terms(*self.setup.terms).register(cloud)
            if other.judgement.is_usable:
                return found.with_check(compared(found, other))
        return found

    def _registered(self, cloud: ArrayLike, start: Registration | None) -> tuple[Registration, bool]:
        """The result, and whether it was searched for from rest."""
        begin, setup = time.perf_counter(), self.setup
        points = setup.checked(cloud)
        if start is None:
            return self._cold(points, begin), True
        result = self._concluded(track(setup, points, start), begin)
        if has_left(setup, result, start) and not setup.is_late:
            now = time.monotonic()
            hurried = self.limited(now + ACCURACY.searching * (setup.options.solver.until - now))
            other = hurried._cold(points, begin, result)
            best = other if other is result else min(other, result, key=badness)
            return replace(best, seconds=time.perf_counter() - begin), True
        return result, False

    def _cold(self, points: Cloud, begin: float, known: Registration | None = None) -> Registration:
        """From rest; once more, from fewer directions, where neighbours share more noise than each point has alone.

        So it looks in a wrong minimum, as it does with a camera or a model that errs by patches; a search that began
        with all directions was led by none. The second result is taken where it meets the cloud much better. Where time
        is over before the end, the better one of this and what is known; that at once, if it is accepted.
        """
        begun = localise(self.setup, points)
        if known is not None and self.setup.is_late and known.judgement.verdict is Verdict.ACCEPTED:
            return known
        cold = self._concluded(finish(self.setup, points, begun), begin)
        leading = self.options.localisation.leading
        if leading < self.setup.forces.size and cold.shared_noise_dominates and not self.setup.is_late:
            with suppress(NotConverged):
                again = localise(self.setup, points, max(1, leading // 2))
                other = self._concluded(finish(self.setup, points, again), begin)
                cold = other if POLICY.excess * other.scatter < cold.scatter else cold
        return cold if known is None or not self.setup.is_late else min(known, cold, key=badness)

    def _concluded(self, ended: Ended, begin: float) -> Registration:
        return conclude(self.setup, ended, self.modulus_deviation, time.perf_counter() - begin)


def prepare(
    model: ForwardModel,
    nodes: ArrayLike | None,
    triangles: ArrayLike | None = None,
    *,
    force_scale: float,
    smoothness: float = 0.02,
    directions: int = 64,
    options: RegistrationOptions | None = None,
    pose: PosePrior | None = None,
    inputs: InputBlocks | None = None,
    blocks: Callable[[SurfaceDistance], Sequence[ParameterBlock]] | None = None,
    modulus_deviation: float = 0.0,
    elsewhere: ArrayLike | None = None,
    along_normals: bool = False,
) -> Registrar:
    """A registrar with forces at the nodes that may carry some, reduced to what a cloud can tell.

    Args:
        model: forward model.
        nodes: nodes that may carry force; None where all forces are known (the model's own loading).
        triangles: the observed side, (t, 3); the whole boundary if not given.
        force_scale: size of a nodal force to begin with, newtons; see `expected_force`.
        smoothness: correlation length of neighbouring forces, metres; 0 for none.
        directions: most directions of force kept.
        options: noise, solver, thinning, search for the place of the forces.
        pose: prior of the pose; None for clouds in the body's coordinates.
        inputs: unknown inputs beside the forces; none if not given. Nodes that they move carry no unknown force.
        blocks: further parameters, by the observed side.
        modulus_deviation: as for `Registrar`.
        elsewhere: further nodes, where forces are thought of when those given leave what neighbouring points share.
        along_normals: forces act along the surface's normal alone, see `normal_forces`; nothing is gathered then.

    Raises:
        ValueError: no node is left on the free boundary; nothing is unknown; conditions that the model does not take.
    """
    options = options or RegistrationOptions()
    if along_normals:  # a pressure acts all over the surface, and those that press the body as a whole are not bounded
        options = replace(options, localisation=replace(options.localisation, rounds=0, leading=directions))
    observed = SurfaceDistance(model.body, triangles, options.distance)
    spread = 0.0 if along_normals else POLICY.force_spread
    scale = LogNormalPrior(force_scale, spread, minimum=1e-2 * force_scale)
    if nodes is None:
        if inputs is None and pose is None and blocks is None:
            raise ValueError("prepare.nodes: expected nodes that may carry force where nothing else is unknown.")
        options = replace(options, localisation=replace(options.localisation, rounds=0))
        forces = known_forces(model.body, scale)
    else:
        carrying = np.asarray(nodes, dtype=np.int64)
        if inputs is not None:
            carrying = np.setdiff1d(carrying, inputs.moved_nodes)
        every = (normal_forces if along_normals else nodal_forces)(model.body, carrying, scale, smoothness)
        rule = LikelihoodInformed(options.noise.minimum, maximum=directions)
        forces = Prepared.of(model, observed, every, inputs).informed(observed, rule).forces

    def anywhere() -> Registrar:
        return prepare(
            model,
            np.union1d(np.asarray(nodes, dtype=np.int64), np.asarray(elsewhere, dtype=np.int64)),
            triangles,
            force_scale=force_scale,
            smoothness=smoothness,
            directions=directions,
            options=options,
            pose=pose,
            inputs=inputs,
            blocks=blocks,
            along_normals=along_normals,
        )

    return Registrar(
        model,
        observed,
        forces,
        options,
        pose=pose,
        inputs=inputs,
        blocks=() if blocks is None else blocks(observed),
        modulus_deviation=modulus_deviation,
        anywhere=None if elsewhere is None or nodes is None else anywhere,
    )


def register_sequence(registrar: Registrar, clouds: Iterable[ArrayLike]) -> Iterator[Registration]:
    """Register clouds in their order, as they come; the caller may stop between any two.

    A frame starts from the last one that was not refused: see `Tracker`.

    Args:
        registrar: model, observed side, unknowns and options.
        clouds: one cloud a frame, (p, 3), metres.

    Raises:
        CloudError: a cloud without one point of finite coordinates, or one that lies too far from the body.
    """
    tracker = Tracker()
    for cloud in clouds:
        yield tracker.take(cloud, registrar)
