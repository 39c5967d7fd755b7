"""A registration of the usual kind as arrays for a device: the same unknowns, the same surrogate, the same beliefs."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from softtwin.surrogate.model import ReducedSurrogate, Surrogate

from ..hyperparameters import DISCREPANCY, FORCE, LENGTH, NOISE
from ..parameters.correlated_noise import CorrelatedNoise
from ..parameters.discrepancy import ModelError, RemainderOfModelError
from ..parameters.inputs import InputBlocks
from ..parameters.nodal_forces import NodalForces
from ..parameters.pose import PosePrior
from ..policy import ACCURACY
from ..pose import Pose
from ..problem import Problem
from ..result import Registration
from ..setup import Setup
from .arrays import DeviceArrays, Start

Floats = NDArray[np.float64]
_OWN = [NOISE, FORCE, DISCREPANCY]  # hyperparameters that are sought there, in the order of `evidence`


def arrays_of(setup: Setup, found: Registration) -> DeviceArrays:
    """The same unknowns as those of a registered cloud, and the same surrogate.

    Args:
        setup: of the registrar.
        found: by it, with a trained network, from points alone.

    Raises:
        ValueError: what is not registered on a device: unknown inputs, landmarks, normals, further
            blocks, distances to planes, or a model that is no trained network.
    """
    _check(found)
    problem, surrogate, forces = found.problem.unshared, cast(Surrogate, found.prepared.whole), found.prepared.forces
    reduced, known, observed = cast(ReducedSurrogate, problem.model), surrogate.encoder_decoder, problem.observed
    error = None if problem.error is None else problem.error.with_amplitude(1.0)
    nodes, vertices, count = len(problem.observed.body.points), len(observed.rest), forces.size
    modes = np.zeros((3 * nodes, 0)) if error is None else error.modes
    pose = problem.pose
    mean = Pose.identity() if pose is None else pose.mean
    left_out = None if error is None else error.remainder
    logs = np.zeros(0) if left_out is None else left_out.logs
    shared = CorrelatedNoise(observed.modes) if setup.options.correlated else None

    def at_vertices(columns: Floats) -> Floats:
        return observed.carried(columns.reshape(len(observed.nodes), -1)).reshape(3 * vertices, -1)

    own = {name: getattr(problem.hyperprior, name)[_OWN] for name in ("median", "spread", "below")}
    return DeviceArrays(
        **own,
        lowest=problem.hyperprior.lowest[_OWN],
        highest=problem.hyperprior.highest[_OWN],
        logs=np.concatenate([np.zeros(problem.size - len(logs)), logs]),
        network=surrogate.network,
        architecture=surrogate.card["architecture"],
        encode=reduced.encode,
        rest=observed.rest,
        triangles=observed.triangles,
        nodes=observed.body.points,
        offset=at_vertices(reduced.offset_rows)[:, 0],
        linear=at_vertices(reduced.rows[:, :count]),
        decode=at_vertices(reduced.rows[:, count:]),
        patterns=at_vertices(modes.reshape(nodes, 3, -1)[observed.nodes]),
        deviation=np.zeros(vertices) if left_out is None else observed.carried(left_out.deviation),
        remainder=np.zeros((vertices, 0)) if left_out is None else left_out.modes.modes,
        curvature=observed.vertex_curvature,
        shared=np.zeros((vertices, 0)) if shared is None else shared.leading(ACCURACY.first_modes).modes.modes,
        shared_variances=np.zeros((0, 0)) if shared is None else _variances(problem.with_shared(shared), shared),
        whole_offset=known.offset,
        whole_linear=np.column_stack([reduced.linear(each) for each in np.eye(count)]),
        whole_decode=cast(Floats, known.decode),
        whole_patterns=modes,
        whole_rest=np.zeros(nodes) if error is None else error.discrepancy.rest,
        unseen=_covariances(found.prepared.unseen.reshape(nodes, 3, -1)),
        force_nodes=forces.nodes,
        force_patterns=forces.patterns,
        size=np.array(problem.observed.body.size),
        pose_rotation=mean.rotation,
        pose_translation=mean.translation,
        pose_pivot=np.zeros(3) if pose is None else mean.apply(pose.centre),
        pose_deviations=np.zeros(0) if pose is None else pose.deviations,
        is_pose_said=np.array(pose is not None and pose.is_said),
    )


def start_of(found: Registration) -> Start:
    """Where the next frame begins."""
    coefficients = found.problem.unshared.sized(found.coefficients)
    moved = np.linalg.norm(found.evaluation.positions, axis=1).max() + found.rms_distance
    return Start(coefficients[None], found.eta[_OWN][None], np.array([moved]))


def _check(found: Registration) -> None:
    problem, surrogate = found.problem, found.prepared.whole
    network = getattr(surrogate, "network", None)
    if network is None or not network.is_graph or surrogate.encoder_decoder.decode is None:  # type: ignore[attr-defined]
        raise ValueError(
            "arrays_of.found: expected one of a trained network with few values (architecture reduced), got one "
            f"of {type(surrogate).__name__ if network is None else type(network).__name__}."
        )
    has = {
        "unknown inputs": problem.inputs is not None,
        "landmarks or normals": len(problem.terms) > 0,
        "distances to planes": problem.observed.distance != "surface",
    }
    others = [
        type(block).__name__
        for block in problem.blocks
        if not isinstance(
            block, (NodalForces, ModelError, RemainderOfModelError, CorrelatedNoise, PosePrior, InputBlocks)
        )
    ]
    more = [name for name, is_there in has.items() if is_there] + others
    if more:
        raise ValueError(
            f"arrays_of.found: expected forces and the model's error as all that is unknown, got {', '.join(more)}."
        )


def _variances(problem: Problem, shared: CorrelatedNoise) -> Floats:
    """Of the smoothest modes' coefficients in a field of unit variance, (l, c), for the lengths that are looked at."""
    prior = problem.hyperprior
    lengths = np.linspace(prior.lowest[LENGTH], prior.highest[LENGTH], ACCURACY.lengths)
    modes = shared.leading(ACCURACY.first_modes).modes
    return np.exp([modes.log_variances(np.exp(each))[0] for each in lengths])


def _covariances(factor: Floats) -> Floats:
    """Of nodes, (n, 3, 3), from a factor of all, (n, 3, r)."""
    return factor @ factor.transpose(0, 2, 1)
