"""What a usable result looks like, by the size of the body and the noise expected: levels of the checks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .forward import ForwardModel
from .hyperparameters import LogNormalPrior
from .policy import POLICY


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
        unlikely: chance of a pose, of another parameter or a landmark that lies too far from where it was expected.
        gradient: largest turn or stretch that nearly all cells stay below; a law that is linear holds for small ones.
        discrepancy_scale: how often as large as it was seen to be what the model gets wrong may be taken.
        correction: however large beside what was seen, less than a camera sees harms nobody: of a node, metres.
        minimum_variance_reduction: part of the variance of such a parameter, and of every combination of them, that a
            cloud must take away where all forces are known: one half, and it tells as much as was believed.
    """

    noise: float
    systematic: float
    movement: float
    outliers: float = field(default_factory=lambda: POLICY.outliers)
    extrapolation_ratio: float = field(default_factory=lambda: POLICY.load)
    informed: float = field(default_factory=lambda: POLICY.minimum_directions)
    unlikely: float = field(default_factory=lambda: POLICY.unlikely)
    discrepancy_scale: float = field(default_factory=lambda: POLICY.excess)
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
            noise=max(POLICY.misfit * size, POLICY.deviations * noise.median),
            systematic=max(POLICY.misfit_shared * size, noise.median),
            movement=POLICY.movement * size,
            correction=POLICY.noise_minimum,
            gradient=POLICY.linear if getattr(model, "is_linear", False) else np.inf,
        )
