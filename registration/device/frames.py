"""Clouds registered together on one device: Gauss-Newton in a trust region, each cloud with its own scales and limit.

One iteration is a fixed sequence of operations for the whole batch, which a GPU replays from a CUDA graph: closest
points, network and derivatives, sums, scales, step. Clouds that have settled stay where they are while others go on.
What is sought, and where the search ends, is that of `gauss_newton` and `local_model`. Noise that neighbours share is
not sought here, but it is said where it may be there; unknown inputs, landmarks, the place of forces and the verdict
are `Registrar`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from softtwin.surrogate.precision import without_tf32

from ..policy import ACCURACY, POLICY
from ..thinning import is_isolated
from .arrays import DeviceArrays, Start
from .conclusion import Concluded, Conclusion
from .evidence import NOISE
from .operations import Operations, Search, blank, copied, mapped

Floats = NDArray[np.float64]
Execution = Literal["compiled", "graphs", "eager"]
_LIMIT_OF_SIZE = 0.5  # as `meshes.clouds` has it
_WARM_UP = 2  # runs before a capture, as CUDA asks for


@dataclass(frozen=True, eq=False)
class Frames:
    """Registered clouds.

    Args:
        start: what the search for the next ones may begin with.
        displacement: of all nodes with what the model's error explains, (b, n, 3), metres.
        margin: distance within which each node is of where it was found, with the confidence asked for, (b, n),
            metres.
        forces: at the nodes that may carry some, (b, a, 3), newtons.
        rotation: of the pose found, from the body's coordinates to the cloud's, (b, 3, 3).
        translation: of it, (b, 3), metres.
        noise: standard deviation of a point's distance, (b,), metres.
        rms_distance: root mean square distance of the points that count, (b,), metres.
        outliers: share of the points that pulled nothing, (b,).
        has_converged: the search has ended, (b,).
        may_share_noise: neighbouring points may share noise, which is not sought here, (b,): take
            `Registrar` for these.
        iterations: of the whole batch.
    """

    start: Start
    displacement: Floats
    margin: Floats
    forces: Floats
    rotation: Floats
    translation: Floats
    noise: Floats
    rms_distance: Floats
    outliers: Floats
    has_converged: NDArray[np.bool_]
    may_share_noise: NDArray[np.bool_]
    iterations: int


class DeviceFrames:
    """Registers clouds of one body, some at a time.

    Args:
        arrays: body, surrogate, unknowns; see `from_registration.arrays_of`.
        batch: clouds at a time.
        points: most points of a cloud; as many as `policy.ACCURACY` has if not given.
        device: `cpu` or `cuda`.
        confidence: of the margins.
        execution: of the operations on a GPU: `compiled`, fused by torch.compile (a minute or more at the first call)
            and replayed from CUDA graphs; `graphs`, replayed alone; `eager`, each of some thousand started by itself.
            On a processor always the last.
        settled: where a search has ended; where `policy.ACCURACY` has it if not given.

    Raises:
        ValueError: fewer than one cloud, or points than a cloud has to have; another confidence or execution; a GPU
            that torch does not see.
    """

    def __init__(
        self,
        arrays: DeviceArrays,
        batch: int = 1,
        points: int | None = None,
        device: str = "cpu",
        *,
        confidence: float = 0.95,
        execution: Execution = "compiled",
        settled: float | None = None,
    ) -> None:
        points = ACCURACY.points if points is None else points
        settled = ACCURACY.settled if settled is None else settled
        if batch < 1 or points < POLICY.minimum_points:
            raise ValueError(
                f"DeviceFrames: expected a batch of 1 and {POLICY.minimum_points:.0f} points at least, got {batch} and "
                f"{points}."
            )
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"DeviceFrames.confidence: expected a number in (0, 1), got {confidence}.")
        if execution not in get_args(Execution):
            raise ValueError(f"DeviceFrames.execution: expected one of {get_args(Execution)}, got {execution!r}.")
        if device == "cuda" and not torch.cuda.is_available():
            raise ValueError(
                f"DeviceFrames.device: expected a GPU that torch can use, found none (torch {torch.__version__})."
            )
        self.arrays, self.batch, self.points, self._settled = arrays, batch, points, settled
        is_fused = device == "cuda" and execution == "compiled"
        self._operations = Operations(arrays, device, is_fused)
        self._conclusion = Conclusion(self._operations, confidence)
        self._at_rest_tree = cKDTree(arrays.rest)
        self._clouds = torch.zeros(batch, points, 3, dtype=torch.float64, device=device)
        self._is_point = torch.zeros(batch, points, dtype=torch.bool, device=device)
        self._moved = torch.ones(batch, dtype=torch.float64, device=device)
        self._search = blank(arrays, self._operations.groups, batch, points, device)
        self._graphs: dict[str, tuple[Any, Any]] | None = {} if device == "cuda" and execution != "eager" else None
        self._iteration: Callable[..., Search] = self._operations.iteration
        self._concluded: Callable[..., Concluded] = self._conclusion.concluded
        if is_fused:
            self._iteration = torch.compile(self._iteration, fullgraph=True, dynamic=False)
            self._concluded = torch.compile(self._concluded, fullgraph=True, dynamic=False)

    def register(self, clouds: Sequence[ArrayLike], start: Start | None = None) -> Frames:
        """The states that bring the observed side to clouds.

        Args:
            clouds: as many as the batch has, (p, 3) each, metres.
            start: where each begins, of the frames before (`Frames.start`) or of `start_of`; at rest if not given.

        Raises:
            ValueError: another number of clouds; one that has another shape, too few or too many points, or NaN, or
                lies too far from the body; a start of other unknowns or of another number of clouds.
        """
        points, is_point = self._checked(clouds)
        begin = self._at_rest() if start is None else self._checked_start(start)
        with torch.no_grad(), without_tf32():
            self._clouds.copy_(points)
            self._is_point.copy_(is_point)
            self._moved.copy_(torch.from_numpy(begin.moved))
            iterations = self._from_rest(begin, clouds) if start is None else self._descend(begin, is_near=True)
            found: Concluded = self._run("conclude", self._conclude)
            return self._told(found, iterations)

    # ------------------------------------------------------------------ the search

    def _from_rest(self, start: Start, clouds: Sequence[ArrayLike]) -> int:
        """With few directions of force, then with all; the model's error is reckoned with the movement found so far.

        Points that lie by themselves count at the end alone: see `strategies.cold_start`.
        """
        is_point, iterations = self._is_point.clone(), 0
        for place, cloud in enumerate(clouds):
            is_kept = torch.from_numpy(~is_isolated(np.asarray(cloud, dtype=np.float64)))
            self._is_point[place, : len(is_kept)] = is_kept.to(self._is_point.device)
        for count in (min(ACCURACY.leading, self.arrays.linear.shape[1]), None):
            self._operations.believe(count)
            iterations += self._descend(start, is_near=False)
            local = self._search.local
            self._moved.copy_(self._operations.movement(local.at, local, self._is_point, self._moved))
            start = Start(*map(_host, (local.at, local.eta, self._moved)))
        self._is_point.copy_(is_point)
        return iterations + self._descend(start, is_near=True)

    def _descend(self, start: Start, is_near: bool) -> int:
        """Search from a start until all have ended; how many iterations that took."""
        search = self._search
        search.proposed.copy_(torch.from_numpy(start.coefficients))
        search.local.at.copy_(search.proposed)
        search.local.eta.copy_(torch.from_numpy(start.eta))
        search.local.point_noise.copy_(torch.exp(search.local.eta[:, NOISE]))
        search.limit.fill_(ACCURACY.first_step * float(self.arrays.size))
        for flag in (search.is_first, search.is_kept):
            flag.fill_(True)
        for flag in (search.has_ended, search.has_settled):
            flag.fill_(False)
        search.is_last.fill_(is_near)
        iterations, has_ended = 0, False
        while not has_ended and iterations < ACCURACY.iterations:
            has_ended, iterations = bool(self._run("iterate", self._iterate).all()), iterations + 1
        return iterations

    def _iterate(self) -> Tensor:
        made = self._iteration(self._search, self._clouds, self._is_point, self._moved, self._settled)
        copied(self._search, made)
        return self._search.has_ended

    def _conclude(self) -> Concluded:
        return self._concluded(self._search.local, self._search.has_settled, self._is_point, self._moved)

    def _run(self, name: str, work: Callable[[], Any]) -> Any:
        """Work on memory that stays where it is: captured the first time, and replayed."""
        if self._graphs is None:
            return work()
        if name not in self._graphs:
            before = mapped(torch.clone, self._search)
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UP):
                    work()
            torch.cuda.current_stream().wait_stream(stream)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                outputs = work()
            copied(self._search, before)
            self._graphs[name] = graph, outputs
        graph, outputs = self._graphs[name]
        graph.replay()
        return outputs

    # ------------------------------------------------------------------ from and to the host

    def _at_rest(self) -> Start:
        """No force, scales as believed, a model's error for a movement as large as a first step may be."""
        arrays, count = self.arrays, self.batch
        eta = np.tile(np.clip(arrays.median, arrays.lowest, arrays.highest), (count, 1))
        moved = np.full(count, ACCURACY.first_step * float(arrays.size))
        return Start(np.zeros((count, arrays.coefficient_count)), eta, moved)

    def _checked_start(self, start: Start) -> Start:
        shapes = {"coefficients": (self.batch, self.arrays.coefficient_count), "eta": (self.batch, 3)}
        for name, shape in {**shapes, "moved": (self.batch,)}.items():
            given = getattr(start, name)
            if given.shape != shape or not np.isfinite(given).all():
                raise ValueError(f"DeviceFrames.start.{name}: expected finite numbers, {shape}, got {given.shape}.")
        return start

    def _checked(self, clouds: Sequence[ArrayLike]) -> tuple[Tensor, Tensor]:
        """Points, (b, p, 3), and which of them there are, (b, p)."""
        if len(clouds) != self.batch:
            raise ValueError(f"DeviceFrames.clouds: expected {self.batch}, got {len(clouds)}.")
        points, is_point = np.zeros((self.batch, self.points, 3)), np.zeros((self.batch, self.points), dtype=bool)
        for place, cloud in enumerate(clouds):
            given = np.asarray(cloud, dtype=np.float64)
            if given.ndim != 2 or given.shape[1] != 3 or not POLICY.minimum_points <= len(given) <= self.points:
                raise ValueError(
                    f"DeviceFrames.clouds[{place}]: expected (p, 3) with {POLICY.minimum_points:.0f} to {self.points} "
                    f"points, got {given.shape}; `Cloud.thinned` makes it smaller."
                )
            if not np.isfinite(given).all():
                raise ValueError(f"DeviceFrames.clouds[{place}]: expected finite numbers, got NaN or infinity.")
            self._check_place(f"DeviceFrames.clouds[{place}]", given)
            points[place, : len(given)], is_point[place, : len(given)] = given, True
        return torch.from_numpy(points), torch.from_numpy(is_point)

    def _check_place(self, name: str, cloud: Floats) -> None:
        """Refuse what no search could make a state of: see `meshes.clouds.check_cloud`, which VTK is needed for."""
        if len(np.unique(cloud[:, 0])) < POLICY.minimum_points:
            count = len(np.unique(cloud, axis=0))
            if count < POLICY.minimum_points:
                raise ValueError(f"{name}: expected {POLICY.minimum_points:.0f} points at least, got {count} places.")
        few = cloud[:: max(1, len(cloud) // ACCURACY.glance)]
        few = (few - self.arrays.pose_translation) @ self.arrays.pose_rotation
        far, limit = float(np.median(self._at_rest_tree.query(few)[0])), _LIMIT_OF_SIZE * float(self.arrays.size)
        if far > limit:
            extent = float(np.linalg.norm(np.ptp(cloud, axis=0)))
            raise ValueError(
                f"{name}: expected points within {limit:.3g} m of the body at rest, half of them lie {far:.3g} m off "
                f"or more; the cloud is {extent:.3g} m across: is it in metres, and in the coordinates that were said?"
            )

    def _told(self, found: Concluded, iterations: int) -> Frames:
        told = {name: _host(value) for name, value in found._asdict().items()}
        eta = _host(self._search.local.eta)
        start = Start(told.pop("coefficients"), eta, told.pop("moved"))
        told["forces"] = told["forces"].reshape(self.batch, -1, 3)
        converged = _host(self._search.has_settled)
        return Frames(start, **told, noise=np.exp(eta[:, NOISE]), has_converged=converged, iterations=iterations)


def _host(tensor: Tensor) -> NDArray[Any]:
    return tensor.detach().cpu().numpy().copy()
