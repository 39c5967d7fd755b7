"""What registration on a device needs of a body, its model and its unknowns: plain arrays, kept in one file."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from softtwin.surrogate.architecture import Network
from softtwin.surrogate.registry import ARCHITECTURES

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class Start:
    """Where the search for frames begins.

    Args:
        coefficients: (b, k).
        eta: logarithms of the scales, (b, 3).
        moved: largest displacement that the model's error is reckoned with, (b,), metres.
    """

    coefficients: Floats
    eta: Floats
    moved: Floats


@dataclass(frozen=True, eq=False)
class DeviceArrays:
    """A surrogate between unknown forces and the observed side, with what is believed of both.

    Coefficients are those of the forces, (f,), of an unknown pose, (6,) or none, of the patterns of the model's error,
    (m,), and of what these leave out, (q,), in this order: k in all. The scales are those of noise, forces and the
    model's error.

    Args:
        network: values of the network, (s, e), from its coordinates, (s, d).
        architecture: its name in `surrogate.registry`.
        encode: coordinates of the forces' coefficients, (d, f).
        rest: vertices of the observed side, (v, 3), metres.
        triangles: its triangles, (t, 3).
        nodes: of the body at rest, (n, 3), metres.
        offset: displacement of the vertices without any force, (3v,), metres.
        linear: linear part of their displacement, (3v, f), metres a newton.
        decode: their displacement by the network's values, (3v, e).
        patterns: of the model's error at the vertices, for a largest displacement of one metre, (3v, m).
        deviation: of a distance at each vertex by what the patterns leave out, likewise, (v,).
        remainder: surface modes of what they leave out, (v, q).
        curvature: mean curvature at rest, (v,), 1/m.
        shared: the smoothest surface modes, (v, c), by which noise that neighbours share is asked for.
        shared_variances: of their coefficients, for each length that is looked at, (l, c).
        whole_offset: as `offset`, of all nodes, (3n,).
        whole_linear: as `linear`, (3n, f).
        whole_decode: as `decode`, (3n, e).
        whole_patterns: as `patterns`, (3n, m).
        whole_rest: deviation of a component of each node that the patterns leave out, (n,).
        unseen: covariance of each node by the directions of force that were left out, for unit scale, (n, 3, 3).
        force_nodes: nodes that may carry force, (a,).
        force_patterns: forces there for each coefficient, (3a, f), newtons.
        median: logarithms of the scales, beforehand, (3,).
        spread: standard deviations of these, (3,); 0 of one that is known.
        below: the same below the median, (3,).
        lowest: (3,).
        highest: (3,).
        logs: logarithms of the coefficients' variances where the scales are 1, (k,).
        size: of the body, metres.
        pose_rotation: of the pose expected, (3, 3).
        pose_translation: of it, (3,), metres.
        pose_pivot: of its turn, in the camera's coordinates, (3,), metres.
        pose_deviations: of turn and shift, (6,); none, (0,), where the pose is exactly as expected.
        is_pose_said: displacements are told as if the pose were the one expected, (): see `Registration.frame`.
    """

    network: Network
    architecture: str
    encode: Floats
    rest: Floats
    triangles: Ints
    nodes: Floats
    offset: Floats
    linear: Floats
    decode: Floats
    patterns: Floats
    deviation: Floats
    remainder: Floats
    curvature: Floats
    shared: Floats
    shared_variances: Floats
    whole_offset: Floats
    whole_linear: Floats
    whole_decode: Floats
    whole_patterns: Floats
    whole_rest: Floats
    unseen: Floats
    force_nodes: Ints
    force_patterns: Floats
    median: Floats
    spread: Floats
    below: Floats
    lowest: Floats
    highest: Floats
    logs: Floats
    size: Floats
    pose_rotation: Floats
    pose_translation: Floats
    pose_pivot: Floats
    pose_deviations: Floats
    is_pose_said: NDArray[np.bool_]

    @property
    def parts(self) -> tuple[slice, slice, slice, slice]:
        """Coefficients of the forces, the pose, the error's patterns, and what these leave out."""
        counts = [self.linear.shape[1], len(self.pose_deviations), self.patterns.shape[1], self.remainder.shape[1]]
        ends = np.cumsum(counts).tolist()
        forces, pose, patterns, rest = (slice(end - count, end) for end, count in zip(ends, counts, strict=True))
        return forces, pose, patterns, rest

    @property
    def coefficient_count(self) -> int:
        """Number of coefficients, k."""
        return self.parts[-1].stop

    def save(self, path: Path | str) -> None:
        """Write all into one safetensors file."""
        arrays = {each.name: np.asarray(getattr(self, each.name), order="C") for each in fields(self)[2:]}
        weights = {f"network.{name}": value.numpy() for name, value in self.network.state_dict().items()}
        told = {"format": _FORMAT, "architecture": self.architecture}
        save_file({**arrays, **weights}, path, {"softtwin device arrays": json.dumps(told)})

    @classmethod
    def load(cls, path: Path | str) -> DeviceArrays:
        """What `save` has written.

        Raises:
            ValueError: another file, one that is damaged, or of another format.
        """
        try:
            with safe_open(path, "numpy") as file:
                told = json.loads((file.metadata() or {}).get("softtwin device arrays", "{}"))
                read = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        except (SafetensorError, OSError) as error:
            raise ValueError(
                f"DeviceArrays.load.path: expected a file that `save` has written, got {error}."
            ) from error
        if told.get("format") != _FORMAT:
            raise ValueError(
                f"DeviceArrays.load.path: expected arrays of format {_FORMAT}, got {told.get('format', 'others')}."
            )
        weights = {
            name.removeprefix("network."): torch.from_numpy(read.pop(name))
            for name in list(read)
            if name.startswith("network.")
        }
        network = ARCHITECTURES[told["architecture"]].from_state_dict(weights)
        return cls(network, told["architecture"], **read)
