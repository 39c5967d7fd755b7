"""One iteration of the search for a batch of clouds, as operations of torch that depend on no value of theirs.

What is done is what `gauss_newton` and `local_model` do for one cloud: the trial is looked at and taken or not, the
scales make some steps towards the maximum of the evidence, the next trial is made.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..loss import REJECTED, Huber, Tukey
from ..policy import ACCURACY
from .arrays import DeviceArrays
from .closest import ClosestPoints, Match
from .evidence import ERROR, FORCE, NOISE, Hyperpriors, Sums, law_of, scored
from .pose import PosePriors, Poses, poses_at, seen_slopes

_HUBER, _TUKEY = Huber(), Tukey()
_SCORINGS = 2  # steps towards the maximum of the evidence in each iteration
_NO_STEP = 1e-6  # metres: no step that moves all watched vertices less is tried
_NOTHING = -40.0  # logarithm of the variance of what is no unknown
_CURVED = float(np.sqrt(np.pi / 8.0))
_TINY = 1e-300


class Evaluations(NamedTuple):
    """Clouds at some coefficients: see `evaluation.Evaluation`."""

    at: Tensor  # coefficients, (b, k)
    tangents: Tensor  # derivative of the network's values by the forces' coefficients, (b, e, f)
    poses: Poses | None
    match: Match
    fields: Tensor  # of `Operations.fields` at the closest points, (b, p, t)
    error: Tensor  # standard deviation of the distances by what the model gets wrong from point to point, (b, p)
    unexplained: Tensor  # distances less what that explains, (b, p)

    def residuals(self, noise: Tensor) -> Tensor:
        """Less what they are in the mean for points of a noise, (b,): see `surface_distance.expected_distance`."""
        bent = noise[:, None] * self.fields[..., 0]
        return self.unexplained + noise[:, None] * bent / (1.0 + _CURVED * bent.abs())


class Local(NamedTuple):
    """Where each cloud's search is, and the model of its objective there; see `local_model.LocalModel`."""

    at: Tensor  # coefficients, (b, k)
    eta: Tensor  # logarithms of the scales, (b, 3)
    point_noise: Tensor  # of the residuals' mean, (b,)
    deviations: Tensor  # of the points, (b, p)
    weights: Tensor  # of the points, (b, p)
    distances: Tensor  # (b, p)
    value: Tensor  # of the objective, (b,)
    gradient: Tensor  # (b, k)
    inverse: Tensor  # of the Hessian, (b, k, k)
    by_scales: Tensor  # derivative of the gradient by the scales' logarithms, (b, k, 3)
    tangents: Tensor  # of the network's values, (b, e, f)
    left: Tensor  # last step of the scales, in their standard deviations, (b,)
    is_graduated: Tensor  # noise is held above what is believed, (b,)
    shrunk: Tensor  # mean square of the residuals as robust weights leave it, (b,)
    shared: Tensor  # what the points pull at noise that neighbours share, (b, 3c)
    shared_mixed: Tensor  # what they tell of it and of the coefficients, (b, k, 3c)
    shared_own: Tensor  # what they tell of it, (b, 3c, 3c)
    sums: Sums


class Search(NamedTuple):
    """All that an iteration changes."""

    local: Local
    proposed: Tensor  # coefficients, (b, k)
    promised: Tensor  # decrease of the objective, (b,)
    taken: Tensor  # largest movement of the trial's step, (b,), metres
    limit: Tensor  # of it, (b,), metres
    is_first: Tensor  # nothing is known yet, (b,)
    is_kept: Tensor  # the trial is taken, whatever it costs, (b,)
    is_last: Tensor  # the loss is the last one, (b,)
    has_ended: Tensor  # (b,)
    has_settled: Tensor  # (b,)


def blank(arrays: DeviceArrays, groups: int, batch: int, points: int, device: str) -> Search:
    """Memory of a search, which its start is written into.

    Args:
        arrays: what is sought.
        groups: of points of like variance.
        batch: clouds.
        points: of each.
        device: where.
    """
    b, p, f, e = batch, points, arrays.linear.shape[1], arrays.decode.shape[1]
    k, g, c = arrays.coefficient_count, groups, 3 * arrays.shared.shape[1]

    def ones(*shape: int) -> Tensor:
        return torch.ones(b, *shape, dtype=torch.float64, device=device)

    def flags() -> Tensor:
        return torch.zeros(b, dtype=torch.bool, device=device)

    sums = Sums(ones(g, k, k), ones(g, k), ones(g), ones(g), ones(g), ones(g))
    local = Local(
        at=ones(k),
        eta=ones(3),
        point_noise=ones(),
        deviations=ones(p),
        weights=ones(p),
        distances=ones(p),
        value=ones(),
        gradient=ones(k),
        inverse=ones(k, k),
        by_scales=ones(k, 3),
        tangents=ones(e, f),
        left=ones(),
        is_graduated=flags(),
        shrunk=ones(),
        shared=ones(c),
        shared_mixed=ones(k, c),
        shared_own=ones(c, c),
        sums=sums,
    )
    return Search(local, ones(k), ones(), ones(), ones(), flags(), flags(), flags(), flags(), flags())


class Operations:
    """The operations, on one device.

    Args:
        arrays: see `DeviceFrames`.
        device: see there.
        is_fused: what is done is compiled.
    """

    def __init__(self, arrays: DeviceArrays, device: str, is_fused: bool = False) -> None:
        self.forces, self.pose, self.patterns, self.rest_part = arrays.parts
        f = self.forces.stop

        def put(array: NDArray[Any], kind: torch.dtype = torch.float64) -> Tensor:
            return torch.from_numpy(np.array(array)).to(device, kind)

        self.network = arrays.network.rounded().to(device).requires_grad_(False).eval()
        self.encode = put(arrays.encode)
        self.rest, self.offset = put(arrays.rest), put(arrays.offset)
        self.moving = put(np.hstack([arrays.linear, arrays.decode, arrays.patterns]))
        self.fields = put(np.column_stack([arrays.curvature, arrays.deviation, arrays.remainder, arrays.shared]))
        self.whole_offset, self.whole_rest, self.unseen = (
            put(arrays.whole_offset),
            put(arrays.whole_rest),
            put(arrays.unseen),
        )
        self.whole = put(np.hstack([arrays.whole_linear, arrays.whole_decode, arrays.whole_patterns]))
        self.variances = put(arrays.shared_variances)
        self.force_patterns = put(arrays.force_patterns)
        self.closest = ClosestPoints(put(arrays.triangles, torch.int64), 1e-12 * float(arrays.size), device, is_fused)
        self.watched = slice(None, None, max(1, len(arrays.rest) // ACCURACY.watched))
        self.groups = ACCURACY.groups if arrays.deviation.any() else 1
        slopes = np.zeros((3, arrays.coefficient_count))
        slopes[FORCE, self.forces] = slopes[ERROR, self.patterns.start :] = 2.0
        self.prior: PosePriors | None = None
        if len(arrays.pose_deviations):
            given = (arrays.pose_rotation, arrays.pose_translation, arrays.pose_pivot, arrays.pose_deviations)
            self.prior = PosePriors(*map(put, given))
        self.is_said, self.nodes = bool(arrays.is_pose_said), put(arrays.nodes)
        scales = (arrays.median, arrays.spread, arrays.below, arrays.lowest, arrays.highest)
        self.priors = Hyperpriors(*map(put, (*scales, slopes, arrays.logs)))
        self.modes = slice(2, 2 + arrays.remainder.shape[1])
        self.decoded = slice(f, f + arrays.decode.shape[1])
        self._logs = put(arrays.logs)
        self.least = float(np.exp(arrays.lowest[NOISE]))

    def believe(self, count: int | None) -> None:
        """Take the first directions of force alone for unknown, and nothing of the model's error; all if not given."""
        self.priors.logs.copy_(self._logs)
        if count is not None:
            self.priors.logs[count : self.forces.stop] = _NOTHING
            self.priors.logs[self.patterns.start :] = _NOTHING

    # ------------------------------------------------------------------ the state

    def network_at(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Values, (b, e), and their derivative by the forces' coefficients, (b, e, f)."""
        at = self.network.traced((coefficients[:, self.forces] @ self.encode.T).float())
        values, slopes = at.values, at.jvp(self.encode.float())
        return values.double(), slopes.double()

    def columns(self, coefficients: Tensor, values: Tensor, moved: Tensor) -> Tensor:
        """Of the columns of `moving` and `whole`, (b, f + e + m)."""
        return torch.cat([coefficients[:, self.forces], values, moved[:, None] * coefficients[:, self.patterns]], dim=1)

    def poses_at(self, coefficients: Tensor) -> Poses | None:
        """At coefficients of all unknowns, (b, k); None where the pose is no unknown."""
        return None if self.prior is None else poses_at(self.prior, coefficients[:, self.pose])

    def movement(self, coefficients: Tensor, local: Local, is_point: Tensor, moved: Tensor) -> Tensor:
        """Largest displacement that the model's error is reckoned with in the next frame, (b,), metres."""
        values = self.network_at(coefficients)[0]
        shift = (self.columns(coefficients, values, moved) @ self.moving.T + self.offset).view(len(values), -1, 3)
        return torch.linalg.vector_norm(shift, dim=2).amax(dim=1) + rms(local, is_point)

    # ------------------------------------------------------------------ one iteration

    def iteration(self, search: Search, clouds: Tensor, is_point: Tensor, moved: Tensor, settled: float) -> Search:
        """Look at the trials, take them or not, and make the next.

        Args:
            search: where it is.
            clouds: (b, p, 3), metres.
            is_point: which of these there are, (b, p).
            moved: largest displacement that the model's error is reckoned with, (b,), metres.
            settled: where it has ended, in posterior deviations a coefficient.
        """
        trial = self._evaluated(search.proposed, clouds, moved)
        gain = torch.nan_to_num((search.local.value - self._value(search, trial, is_point)) / search.promised, nan=-1.0)
        is_kept = (search.is_kept | (gain > 0.0)) & ~search.has_ended
        local = _chosen(is_kept, self._local(search, trial, clouds, is_point, moved), search.local)
        limit = torch.where(search.is_kept, search.limit, _next_limit(search.limit, search.taken, gain))

        whole = -(local.inverse @ local.gradient[..., None])[..., 0]
        pull = -(whole * local.gradient).sum(dim=1)
        length = (pull.clamp_min(0.0) / whole.shape[1]).sqrt()
        largest = torch.linalg.vector_norm(self._moved_by(whole, local.tangents, moved), dim=2).amax(dim=1)
        share = (limit / largest.clamp_min(_TINY)).clamp_max(1.0)

        is_known = torch.isfinite(length) & torch.isfinite(local.eta).all(dim=1)
        is_short = torch.maximum(length, local.left) < torch.where(search.is_last, settled, ACCURACY.handed_on)
        is_short = is_short & ~local.is_graduated & is_known & ~search.has_ended
        hands_on = is_short & ~search.is_last
        ends = (is_short & search.is_last) | (((limit <= _NO_STEP) | ~is_known) & ~hands_on)
        is_near = is_known & search.is_last & (length < ACCURACY.enough)
        step = torch.where((hands_on | ends | search.has_ended)[:, None], 0.0, share[:, None] * whole)
        return Search(
            local=local,
            proposed=local.at + step,
            promised=((share - 0.5 * share.square()) * pull).clamp_min(_TINY),
            taken=share * largest,
            limit=limit,
            is_first=torch.zeros_like(is_kept),
            is_kept=hands_on,
            is_last=search.is_last | hands_on,
            has_ended=search.has_ended | ends,
            has_settled=torch.where(search.has_ended, search.has_settled, is_near),
        )

    def _evaluated(self, c: Tensor, clouds: Tensor, moved: Tensor) -> Evaluations:
        values, tangents = self.network_at(c)
        positions = self.rest + (self.columns(c, values, moved) @ self.moving.T + self.offset).view(len(c), -1, 3)
        poses = self.poses_at(c)
        match = self.closest.match(positions, clouds if poses is None else poses.back(clouds))
        fields = _summed(self.fields, self.closest.triangles[match.triangles], match.weights)
        error = moved[:, None] * fields[..., 1]
        explained = error * (fields[..., self.modes] @ c[:, self.rest_part, None])[..., 0]
        return Evaluations(c, tangents, poses, match, fields, error, match.distances - explained)

    def _value(self, search: Search, trial: Evaluations, is_point: Tensor) -> Tensor:
        """Of the objective at a trial, at the scales before, (b,)."""
        local = search.local
        precision = torch.exp(-self.priors.log_variances(local.eta))
        scaled = trial.residuals(local.point_noise) / local.deviations
        return _objective(scaled, is_point, search.is_last, precision, trial.at)

    def _jacobian(self, trial: Evaluations, clouds: Tensor, moved: Tensor) -> Tensor:
        """Derivative of the residuals by the coefficients, (b, p, k)."""
        match, poses = trial.match, trial.poses
        corners = self.closest.triangles[match.triangles]
        rows = (3 * corners[..., None] + torch.arange(3, device=corners.device)).flatten(2)
        by = _summed(self.moving, rows, (match.weights[..., None] * match.directions[:, :, None]).flatten(2))
        parts = [by[..., self.forces] + by[..., self.decoded] @ trial.tangents]
        if self.prior is not None and poses is not None:
            parts.append(seen_slopes(self.prior, poses, clouds, match.directions @ poses.rotation.mT))
        parts.append(moved[:, None, None] * by[..., self.decoded.stop :])
        parts.append(-trial.error[..., None] * trial.fields[..., self.modes])
        return torch.cat(parts, dim=2)

    def _local(self, search: Search, trial: Evaluations, clouds: Tensor, is_point: Tensor, moved: Tensor) -> Local:
        """The model of the objective about a trial, at scales on the way to the most likely ones."""
        c, priors, is_last, before = trial.at, self.priors, search.is_last, search.local
        places, group_error, error = _grouped(trial.error, is_point, self.groups)
        jacobian = self._jacobian(trial, clouds, moved)
        far = torch.where(is_point, trial.match.distances.abs(), torch.nan)
        robust = (1.4826 * torch.nanmedian(far, dim=1)[0]).clamp_min(self.least)
        noise = torch.where(search.is_first, robust, torch.exp(before.eta[:, NOISE]))
        eta = priors.within(torch.cat([torch.log(noise)[:, None], before.eta[:, 1:]], dim=1))

        residuals = trial.residuals(torch.where(search.is_first, noise, before.point_noise))
        spread = torch.hypot(noise[:, None], torch.exp(eta[:, ERROR, None]) * error)
        weights = _weight(residuals / spread, is_last) * is_point
        sums = _sums(jacobian, (jacobian @ c[..., None])[..., 0] - residuals, weights, places, group_error)
        law = law_of(sums, priors, eta)
        missed = weights * (residuals + (jacobian @ (law.root * law.mean - c)[..., None])[..., 0]).square()
        cut = torch.where(is_last, 1.0 / _TUKEY.consistency - 1.0, 1.0 / _HUBER.consistency - 1.0)
        sums = sums._replace(tail=cut[:, None] * _by_group(missed, places).sum(dim=2))
        for _ in range(_SCORINGS):
            eta, left = scored(sums, priors, eta, law)
            law = law_of(sums, priors, eta)
        point_noise, promised = torch.exp(eta[:, NOISE]), _promised(sums, law.root * law.mean - c)
        least = torch.log(ACCURACY.graduation * promised)
        is_graduated = least > eta[:, NOISE]
        eta = torch.cat([torch.maximum(eta[:, NOISE], least)[:, None], eta[:, 1:]], dim=1)
        law = law_of(sums, priors, eta)

        residuals, own = trial.residuals(point_noise), torch.exp(eta[:, NOISE, None])
        deviations = torch.hypot(own, torch.exp(eta[:, ERROR, None]) * error)
        weights = _weight(residuals / deviations, is_last) * is_point
        pulls, precision = weights * residuals / deviations.square(), law.root.square().reciprocal()
        share = (own / deviations).square()
        by_noise = 2.0 * torch.stack([share * pulls, torch.zeros_like(pulls), (1.0 - share) * pulls], dim=1) @ jacobian
        shared = -(trial.match.directions[..., None] * trial.fields[:, :, None, self.modes.stop :]).flatten(2)
        weighted = (weights / deviations.square())[..., None] * shared
        shrunk = (weights * residuals / deviations).square().sum(dim=1) / weights.sum(dim=1).clamp_min(_TINY)
        return Local(
            at=c,
            eta=eta,
            point_noise=point_noise,
            deviations=deviations,
            weights=weights,
            distances=trial.match.distances,
            value=_objective(residuals / deviations, is_point, is_last, precision, c),
            gradient=(pulls[:, None] @ jacobian)[:, 0] + precision * c,
            inverse=law.root[:, :, None] * law.inverse * law.root[:, None],
            by_scales=(by_noise + priors.slopes * (precision * c)[:, None]).mT,
            tangents=trial.tangents,
            left=left,
            is_graduated=is_graduated,
            shrunk=shrunk.clamp_min(_TINY),
            shared=(pulls[:, None] @ shared)[:, 0],
            shared_mixed=jacobian.mT @ weighted,
            shared_own=shared.mT @ weighted,
            sums=sums,
        )

    def _moved_by(self, change: Tensor, tangents: Tensor, moved: Tensor) -> Tensor:
        """First-order displacement of watched vertices, (b, w, 3), by a change of the coefficients."""
        values = (tangents @ change[:, self.forces, None])[..., 0]
        columns = self.columns(change, values, moved)
        rows = self.moving.view(-1, 3, self.moving.shape[1])[self.watched].flatten(0, 1)
        shift = (columns @ rows.T).view(len(change), -1, 3)
        if self.prior is None:
            return shift
        turn, along = (self.prior.deviations * change[:, self.pose])[:, None].split(3, dim=2)
        arms = self.rest[self.watched] @ self.prior.rotation.T + self.prior.translation - self.prior.pivot
        seen = torch.linalg.cross(turn.expand(-1, len(arms), -1), arms.expand(len(turn), -1, -1)) + along
        return shift + seen @ self.prior.rotation


def _summed(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Weighted sums of rows, (b, p, r), of a table, (t, c): (b, p, c)."""
    found = torch.nn.functional.embedding_bag(
        rows.flatten(0, 1), table, per_sample_weights=weights.flatten(0, 1), mode="sum"
    )
    return found.view(*rows.shape[:2], -1)


def _promised(sums: Sums, step: Tensor) -> Tensor:
    """Root mean square change of the residuals by a step, (b,), metres."""
    square = ((sums.information @ step[:, None, :, None])[..., 0] @ step[..., None]).sum(dim=(1, 2))
    return (square.clamp_min(0.0) / sums.weight.sum(dim=1).clamp_min(1.0)).sqrt().clamp_min(_TINY)


def _weight(scaled: Tensor, is_last: Tensor) -> Tensor:
    inside = (1.0 - (scaled / _TUKEY.c).square()).clamp_min(0.0)
    return torch.where(is_last[:, None], inside.square(), _HUBER.k / scaled.abs().clamp_min(_HUBER.k))


def _objective(scaled: Tensor, is_point: Tensor, is_last: Tensor, precision: Tensor, c: Tensor) -> Tensor:
    inside, size = (1.0 - (scaled / _TUKEY.c).square()).clamp_min(0.0), scaled.abs()
    last = _TUKEY.c**2 / 6.0 * (1.0 - inside**3)
    first = torch.where(size <= _HUBER.k, 0.5 * size.square(), _HUBER.k * (size - 0.5 * _HUBER.k))
    cost = torch.where(is_last[:, None], last, first) * is_point
    return cost.sum(dim=1) + 0.5 * (precision * c.square()).sum(dim=1)


def _grouped(error: Tensor, is_point: Tensor, groups: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points of like variance, by the standard deviation that the model's error gives them.

    Args:
        error: that, (b, p).
        is_point: (b, p).
        groups: how many, g.

    Returns:
        Numbers of the points in each group, (b, g, s), p where there is none; root mean square error of each group,
        (b, g), and that for each point, (b, p).
    """
    batch, count = error.shape
    order = torch.where(is_point, error, torch.inf).argsort(dim=1)
    whole = is_point.sum(dim=1, keepdim=True)
    small, larger = whole // groups, whole % groups
    number = torch.arange(groups, device=error.device)
    begin = number * small + torch.minimum(number, larger)
    size = small + (number < larger)
    most = -(-count // groups)
    inside = torch.arange(most, device=error.device)
    rank = (begin[..., None] + inside).clamp_max(count - 1)
    places = torch.take_along_dim(order[:, None].expand(-1, groups, -1), rank, dim=2)
    places = torch.where(inside < size[..., None], places, count)
    squares = _by_group(error.square(), places)
    group_error = (squares.sum(dim=2) / size.clamp_min(1)).sqrt()
    spread = torch.zeros(batch, count + 1, dtype=error.dtype, device=error.device)
    spread.scatter_(1, places.flatten(1), group_error[..., None].expand_as(places).flatten(1))
    return places, group_error, spread[:, :count]


def _by_group(values: Tensor, places: Tensor) -> Tensor:
    """Values of points, (b, p), in groups, (b, g, s), with zeros where there is no point."""
    padded = torch.nn.functional.pad(values, (0, 1))
    return torch.take_along_dim(padded[:, None].expand(-1, places.shape[1], -1), places, dim=2)


def _sums(jacobian: Tensor, data: Tensor, weights: Tensor, places: Tensor, error: Tensor) -> Sums:
    """See `evidence.Sums`."""
    rows = torch.cat([jacobian, data[..., None]], dim=2) * weights.sqrt()[..., None]
    padded = torch.nn.functional.pad(rows, (0, 0, 0, 1))
    b, g, s = places.shape
    parts = torch.take_along_dim(padded, places.flatten(1)[..., None], dim=1).view(b * g, s, -1)
    gram = (parts.mT @ parts).view(b, g, parts.shape[2], -1)
    count = _by_group(weights, places).sum(dim=2)
    return Sums(gram[..., :-1, :-1], gram[..., -1, :-1], gram[..., -1, -1], count, torch.zeros_like(count), error)


def rms(local: Local, is_point: Tensor) -> Tensor:
    """Root mean square distance of the points that count, (b,), metres; of all where none does."""
    counts = (local.weights >= REJECTED) & is_point
    counts = torch.where(counts.any(dim=1, keepdim=True), counts, is_point)
    return ((local.distances.square() * counts).sum(dim=1) / counts.sum(dim=1)).sqrt()


def _next_limit(limit: Tensor, taken: Tensor, gain: Tensor) -> Tensor:
    """See `gauss_newton`."""
    grown = torch.where(gain > 0.7, torch.maximum(limit, 2.0 * taken), limit)
    return torch.where(gain <= 0.0, torch.minimum(limit, taken) / 3.0, torch.where(gain < 0.3, 0.5 * limit, grown))


def _chosen(is_kept: Tensor, made: Local, before: Local) -> Local:
    def one(new: Any, old: Any) -> Any:
        if isinstance(new, tuple):
            return type(new)(*map(one, new, old))  # type: ignore[call-arg]
        return torch.where(is_kept.view(-1, *[1] * (new.dim() - 1)), new, old)

    return one(made, before)


def mapped(function: Any, tree: Any) -> Any:
    """A tuple of tensors, or of such tuples, with a function of each tensor in its place."""
    return type(tree)(*(mapped(function, each) for each in tree)) if isinstance(tree, tuple) else function(tree)


def copied(target: Any, source: Any) -> None:
    """Write the tensors of one such tuple into the memory of another."""
    for old, new in zip(target, source, strict=True):
        if isinstance(old, tuple):
            copied(old, new)
        else:
            old.copy_(new)
