"""What a usable result looks like, by the size of the body and the noise expected: levels of the checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .forward import ForwardModel
from .hyperparameters import LogNormalPrior

# Turn (radians) or stretch that a linear law holds for, half of which it is off by, relative: a centimetre of movement
# is then good to a camera's noise.
_SMALL = 0.03
# Chance of a score, a choice: forces that are localised by the cloud that they explain leave larger scores than
# chi-square has. It is far below that of the other checks.
UNLIKELY = 1e-5


@dataclass(frozen=True)
class Expectations:
    """What a usable result looks like.

    Args:
        noise: largest standard deviation of a point's distance, metres: beyond it organ and cloud do not match.
        systematic: largest part of it that neighbouring points share, metres: noise is shared by none.
        movement: largest displacement of a node, metres; nothing is known of larger ones.
        outliers: largest share of points that may be wrong.
        extrapolation_ratio: largest load relative to what the model has learned.
        informed: fewest directions that a cloud must tell, where so many are unknown.
        pose: largest move of the pose in deviations of its prior.
        parameter: the same of stiffness and other unknowns beside the forces.
        gradient: largest turn or stretch that nearly all cells stay below; a law that is linear holds for small ones.
        discrepancy_scale: how often as large as it was seen to be what the model gets wrong may be taken.
        correction: however large beside what was seen, so little of it harms nobody: of an observed node, metres.
        minimum_variance_reduction: part of the variance of such a parameter, and of every combination of them, that a
            cloud must take
            away where all forces are known.
    """

    noise: float
    systematic: float
    movement: float
    outliers: float = 0.4
    extrapolation_ratio: float = 1.2
    informed: float = 2.0
    pose: float = 3.0
    parameter: float = 3.0
    discrepancy_scale: float = 1.5
    correction: float = 0.0
    minimum_variance_reduction: float = 0.5
    gradient: float = np.inf

    @classmethod
    def of(cls, model: ForwardModel, noise: LogNormalPrior) -> Expectations:
        """By the size of the model's body and the noise that is expected.

        Args:
            model: the forward model.
            noise: what is believed of the noise beforehand.
        """
        size = model.body.size
        return cls(
            noise=max(0.025 * size, 3.0 * noise.median),
            systematic=max(0.005 * size, noise.median),
            movement=0.35 * size,
            correction=0.0005 * size,
            gradient=_SMALL if getattr(model, "is_linear", False) else np.inf,
        )
