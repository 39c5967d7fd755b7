"""How a cloud is trusted and by what it is registered, and which of it suits a model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer, outer_nodes
from softtwin.meshes.metrics import edge_lengths

from .forward import ForwardModel
from .gauss_newton import GaussNewton
from .hyperparameters import LogNormalPrior
from .lbfgs import LBFGS
from .parameters.nodal_forces import LikelihoodInformed
from .policy import ACCURACY, POLICY
from .residuals.normals import NORMAL_DEVIATION
from .surface_distance import Distance

_MANY = 10_000  # points: of no cloud that is left after thinning are there more
NOISE_MEDIAN = 5e-4  # metres: of clouds of which nobody says anything


def noise_prior(median: float = NOISE_MEDIAN) -> LogNormalPrior:
    """What is believed of the standard deviation of a point's distance, metres.

    Args:
        median: of it.
    """
    return LogNormalPrior(median, POLICY.noise_spread, minimum=POLICY.noise_minimum)


@dataclass(frozen=True)
class SparseLocalisation:
    """How a cold start finds where forces act: they are expected again where a round before has found some.

    Args:
        rounds: how often.
        reach: forces within this part of the body's size are gathered together.
        informed: which directions are kept of gathered forces.
        points: so many of the cloud are enough, but for the last round.
        leading: directions of force that a search begins with.
    """

    rounds: int = field(default_factory=lambda: POLICY.rounds)
    reach: float = field(default_factory=lambda: POLICY.force_reach)
    informed: LikelihoodInformed = field(default_factory=LikelihoodInformed)
    points: int = field(default_factory=lambda: ACCURACY.few_points)
    leading: int = field(default_factory=lambda: ACCURACY.leading)

    def __post_init__(self) -> None:
        for name in ("points", "leading"):
            if getattr(self, name) < 1:
                raise ValueError(f"SparseLocalisation.{name}: expected at least 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class RegistrationOptions:
    """How a cloud is trusted and by what it is registered.

    Args:
        noise: what is believed of the standard deviation of a point's distance, metres; found from the cloud.
        solver: how the objective is minimised.
        maximum_points: larger clouds are thinned to so many points.
        localisation: how a cold start finds where forces act.
        distance: of points to the surface, or to the planes of its triangles; see `SurfaceDistance`.
        normal_deviation: standard deviation of a measured normal across itself, radians.
        correlated: reckon with noise that neighbouring points share; see `surface_modes`.
    """

    noise: LogNormalPrior = field(default_factory=noise_prior)
    solver: GaussNewton | LBFGS = field(default_factory=GaussNewton)
    maximum_points: int = field(default_factory=lambda: ACCURACY.points)
    localisation: SparseLocalisation = field(default_factory=SparseLocalisation)
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
        if self.maximum_points < 1:
            raise ValueError(f"RegistrationOptions.maximum_points: expected at least 1, got {self.maximum_points}.")


def options_for(model: ForwardModel, has_zone: bool) -> RegistrationOptions:
    """Options that suit a model.

    Within a zone forces are not gathered: what a cloud was used to believe it would be used to find once more, and
    margins would be too narrow. An exact model looks for their place with all points: it is only as good as the end of
    the descent.

    Args:
        model: forward model.
        has_zone: the nodes that may carry force are those that a tool can touch.
    """
    if model.error == 0.0:
        return RegistrationOptions(localisation=SparseLocalisation(0 if has_zone else POLICY.rounds, points=_MANY))
    if has_zone:
        return RegistrationOptions(localisation=SparseLocalisation(rounds=0, points=_MANY))
    return RegistrationOptions()


def expected_force(body: Body, young_modulus: float) -> float:
    """Nodal force to begin with, newtons: a part of Young's modulus (Pa) times the square of a typical edge."""
    edge = float(np.median(edge_lengths(body.points, body.cells)))
    return POLICY.force_size * young_modulus * edge**2


def expected_pressure(body: Body, young_modulus: float) -> float:
    """Force of an unknown pressure's changes at a node to begin with, newtons: Young's modulus (Pa) on a node's area.

    What surrounds an organ and slides along it changes its shape as a whole: pressures are as large as it is stiff.
    `prepare` takes this for known: where a cloud had to tell the size, noise that neighbours share took the place of
    changes of the pressure, and landmarks inside were met less well (`benchmarks/lungs.py`).
    """
    return young_modulus * outer(body).rest.area / len(outer_nodes(body))
