"""A simulated camera: clouds of an organ whose true states are known, as noisy, partial and misaligned as is asked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.registration.pose import Pose

from ..config import ConfigError

Floats = NDArray[np.float64]

TRUTH = "truth.npz"  # in the folder of a twin that a simulated camera may look at
POINTS = 1000
AROUND_S = 16.0  # seconds in which the load goes around
TOWARDS = np.array([-0.3, -1.0, 0.25])  # from the organ towards the camera
_SIDEWAYS = np.cross(TOWARDS, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(TOWARDS, [0.0, 0.0, 1.0]))
_LEAST = 20  # points that are always left


@dataclass(frozen=True)
class View:
    """How the simulated camera sees.

    Args:
        noise: standard deviation of a point, metres.
        share: of the visible side that is seen, in (0, 1].
        rotation: of the camera about the vertical axis, radians.
        translation: of the camera sideways, metres.
    """

    noise: float = 5e-4
    share: float = 1.0
    rotation: float = 0.0
    translation: float = 0.0

    @property
    def is_misaligned(self) -> bool:
        """Whether the camera's coordinates are not the body's, so that the pose is to be found."""
        return bool(self.rotation or self.translation)


@dataclass(frozen=True, eq=False)
class Shot:
    """What came from a camera.

    Args:
        cloud: points, (p, 3), metres, in the camera's coordinates.
        truth: true nodal displacements, (n, 3), metres; None where they are not known.
        pose: true pose; None where it is not known.
        net_force: true, (3,), newtons; None where it is not known.
    """

    cloud: object
    truth: Floats | None = None
    pose: Pose | None = None
    net_force: Floats | None = None


class TrueStates:
    """Equilibria of the reference under a load that goes around; between them a periodic cubic spline.

    Args:
        modes: of the displacements, (3n, m).
        coefficients: of each equilibrium, (s, m), metres.
        net_forces: of each, (s, 3), newtons.
    """

    def __init__(self, modes: Floats, coefficients: Floats, net_forces: Floats) -> None:
        both = np.hstack([coefficients, net_forces]).astype(np.float64)
        angles = np.linspace(0.0, 2.0 * np.pi, len(both) + 1)
        self._modes, self._spline = modes, CubicSpline(angles, np.vstack([both, both[:1]]), bc_type="periodic")

    @classmethod
    def read(cls, folder: Path) -> TrueStates:
        """The states beside a twin.

        Raises:
            ConfigError: there are none, or they cannot be read.
        """
        try:
            with np.load(folder / TRUTH, allow_pickle=False) as found:
                return cls(found["modes"], found["coefficients"], found["net_forces"])
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(f"demo: expected true states in {folder / TRUTH} ({error}).") from None

    def at(self, angle: float) -> tuple[Floats, Floats]:
        """Nodal displacements, (n, 3), metres, and net force, (3,), newtons, at an angle in radians."""
        values = self._spline(angle % (2.0 * np.pi))
        return (self._modes @ values[:-3]).reshape(-1, 3), values[-3:]


def shot(body: Body, states: TrueStates, angle: float, view: View, rng: np.random.Generator) -> Shot:
    """What the simulated camera sees of the true state at an angle.

    Args:
        body: the body.
        states: true states.
        angle: where the load is on its way around, radians.
        view: how the camera sees.
        rng: source of random numbers.
    """
    truth, net = states.at(angle)
    seen = "observed" if "observed" in body.surfaces else None
    cloud = partial_view(body, truth, TOWARDS, POINTS, view.noise, rng, surface=seen)
    pose = pose_of(view, body)
    return Shot(pose.apply(_part(cloud, view.share)), truth, pose, net)


def pose_of(view: View, body: Body) -> Pose:
    """The true pose: a turn about the vertical through the body's middle, then a shift sideways."""
    centre, cosine, sine = body.points.mean(axis=0), np.cos(view.rotation), np.sin(view.rotation)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Pose(rotation, centre - rotation @ centre + view.translation * _SIDEWAYS)


def _part(cloud: Floats, share: float) -> Floats:
    """The points on one side of what is seen, as an instrument or a fold hides the others."""
    count = min(len(cloud), max(_LEAST, round(share * len(cloud))))
    return cloud[np.sort(np.argsort(cloud @ _SIDEWAYS)[:count])]
