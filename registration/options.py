"""How a cloud is trusted and by what it is registered, and which of it suits a model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from softtwin.meshes.body import Body
from softtwin.meshes.metrics import edge_lengths

from .evidence import Scale
from .forward import ForwardModel
from .gauss_newton import GaussNewton
from .lbfgs import LBFGS
from .problem import NORMAL_DEVIATION
from .residuals import Distance
from .unknowns import Informed

_SPREAD_ANYWHERE = (
    0.7  # of the logarithm of a nodal force, where a cloud tells the size of forces of which most are none
)
_MANY = 10_000  # points: of no cloud that is left after thinning are there more
_CLEAR, _LOUD = 2.0, 1.5  # times the least noise, times the model's error
_CLOSE = 0.01  # reach of a surrogate's forces whose zone is unknown: with more, their doubt is larger than their error
NOISE = Scale(5e-4, 1.5, least=1e-4)  # metres; no camera is better than the least


@dataclass(frozen=True)
class Gathering:
    """How a cold start finds where forces act: they are expected again where a round before has found some.

    Args:
        rounds: how often.
        reach: forces within this part of the body's size are gathered together.
        informed: which directions are kept of gathered forces.
        points: so many of the cloud are enough, but for the last round.
    """

    rounds: int = 2
    reach: float = 0.035
    informed: Informed = field(default_factory=Informed)
    points: int = 300

    def __post_init__(self) -> None:
        if self.points < 1:
            raise ValueError(f"Gathering.points: expected at least 1, got {self.points}.")


@dataclass(frozen=True)
class Belief:
    """When the size of the forces is left to the cloud, whatever was expected of it.

    Args:
        clear: in clouds of less noise, metres.
        loud: and in clouds of more, beside which what the model gets wrong is small, metres.
        spread: of the logarithm of the size then.
    """

    clear: float = 0.0
    loud: float = np.inf
    spread: float = 1.0


@dataclass(frozen=True)
class RegistrationOptions:
    """How a cloud is trusted and by what it is registered.

    Args:
        noise: what is believed of the standard deviation of a point's distance, metres; found from the cloud.
        solver: how the objective is minimised.
        most_points: larger clouds are thinned to so many points.
        gathering: how a cold start finds where forces act.
        belief: when the size of the forces is left to the cloud.
        distance: of points to the surface, or to the planes of its triangles; see `SurfaceDistance`.
        normal_deviation: standard deviation of a measured normal across itself, radians.
        correlated: look for noise that neighbouring points share; see `correlated.find_correlated`.
    """

    noise: Scale = NOISE
    solver: GaussNewton | LBFGS = field(default_factory=GaussNewton)
    most_points: int = 1000
    gathering: Gathering = field(default_factory=Gathering)
    belief: Belief = field(default_factory=Belief)
    distance: Distance = "surface"
    normal_deviation: float = NORMAL_DEVIATION
    correlated: bool = True

    def __post_init__(self) -> None:
        if self.distance not in ("surface", "plane"):
            raise ValueError(f"RegistrationOptions.distance: expected surface or plane, got {self.distance!r}.")
        if not 0.0 < self.normal_deviation < np.inf:
            raise ValueError(
                f"RegistrationOptions.normal_deviation: expected a positive angle, got {self.normal_deviation}."
            )
        if self.most_points < 1:
            raise ValueError(f"RegistrationOptions.most_points: expected at least 1, got {self.most_points}.")


def options_for(model: ForwardModel, has_zone: bool, has_pose: bool = False) -> RegistrationOptions:
    """Options that suit a model.

    Within a zone forces are not gathered: what a cloud was used to believe it would be used to find once more, and
    margins would be too narrow. An exact model is only as good as the end of the descent. What a surrogate gets wrong
    could be taken for large forces: it is left to clouds of more noise than that to tell their size. But where the
    pose is unknown, forces that are expected small would be taken for a turn of the organ, which is worse.

    Args:
        model: forward model.
        has_zone: the nodes that may carry force are those that a tool can touch.
        has_pose: the pose is unknown.
    """
    clear, loud = _CLEAR * NOISE.least, _LOUD * model.error
    if model.error == 0.0:
        gathering = Gathering(rounds=0 if has_zone else Gathering.rounds, points=_MANY)
        return RegistrationOptions(gathering=gathering, belief=Belief(clear))
    if has_zone:
        belief = Belief(clear if has_pose else 0.0, loud)
        return RegistrationOptions(gathering=Gathering(rounds=0, points=_MANY), belief=belief)
    return RegistrationOptions(gathering=Gathering(reach=_CLOSE), belief=Belief(loud=loud, spread=_SPREAD_ANYWHERE))


def expected_force(body: Body, young_modulus: float) -> float:
    """Nodal force to begin with, newtons: 1 % of Young's modulus (Pa) over the square of a typical edge."""
    edge = float(np.median(edge_lengths(body.points, body.cells)))
    return 0.01 * young_modulus * edge**2
