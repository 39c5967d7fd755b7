"""What the forward model gets wrong, as parameters: patterns over the organ, and a smooth rest on its surface."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.embedding import outer

from ..evaluation import Evaluation, Slopes
from ..expectations import Expectations
from ..forward import Discrepancy
from ..hyperparameters import DISCREPANCY, LogNormalPrior
from ..policy import ACCURACY, POLICY
from ..surface_distance import SurfaceDistance
from ..surface_modes import SurfaceModes
from ..verdict import Check, Code, checked
from .block import BlockPosterior, FieldBlock, ParameterBlock

Floats = NDArray[np.float64]
_COMPONENTS = 3.0  # whose variances add up along the normal: errors are largest across the surface that is pulled
_SMOOTHNESS = 1.5  # of what the patterns leave out, as of all fields: once differentiable


class ModelError(FieldBlock):
    """Patterns of what the forward model may get wrong, of unit variance (Kennedy and O'Hagan 2001).

    The amplitude is the largest displacement that is reckoned with, metres. `remainder` is the block of what the
    patterns leave out.

    Args:
        discrepancy: of the model, for a largest displacement of one metre.
        observed: the observed side.
        amplitude: largest displacement that is reckoned with, metres.
    """

    has_own_figures: ClassVar[bool] = True

    def __init__(self, discrepancy: Discrepancy, observed: SurfaceDistance, amplitude: float = 1.0) -> None:
        super().__init__(discrepancy.modes, observed, amplitude)
        self.discrepancy = discrepancy
        self._left_out = discrepancy.rest[observed.nodes]
        self._rest_modes = _modes_of_rest(discrepancy, observed)

    def with_amplitude(self, amplitude: float) -> ModelError:
        """The same for another largest displacement, metres."""
        other = copy.copy(self)
        other.amplitude = amplitude
        other.__dict__.pop("remainder", None)
        return other

    @cached_property
    def remainder(self) -> RemainderOfModelError:
        """What the patterns leave out, as far as it is smooth."""
        deviation = np.sqrt(_COMPONENTS) * self.amplitude * self._left_out
        return RemainderOfModelError(deviation, *self._rest_modes)

    def hyperpriors(self, observed: SurfaceDistance) -> Mapping[int, LogNormalPrior]:
        """Of the discrepancy scale."""
        return {
            DISCREPANCY: LogNormalPrior(
                1.0,
                POLICY.discrepancy_spread,
                POLICY.discrepancy_minimum,
                spread_below=POLICY.discrepancy_spread_below,
            )
        }

    def log_variances(self, eta: Floats) -> tuple[float, Mapping[int, float]]:
        """See `ParameterBlock.log_variances`."""
        return 2.0 * float(eta[DISCREPANCY]), {DISCREPANCY: 2.0}

    def checks(self, found: BlockPosterior, expected: Expectations) -> Iterator[Check]:
        """Whether the cloud asks for more than the model was seen to get wrong: that is none of it."""
        correction, scale = self.added(found.mean), found.scales.discrepancy
        size = float(np.sqrt((correction**2).sum(axis=1).mean()))
        level = expected.discrepancy_scale if size > expected.correction else np.inf  # so little of it harms nobody
        much = (
            f"the cloud asks for {scale:.1f} times what the model was seen to get wrong, {1e3 * size:.1f} mm: some of "
            "it shows no state of this organ, or the organ is not as it was taken for"
        )
        made = checked(Code.DISCREPANCY_SCALE, scale, level, much, unit="times what was seen")
        yield made if np.isfinite(level) else replace(made, level=None)


class RemainderOfModelError(ParameterBlock):
    """What the patterns of a model's error leave out, as far as neighbours share it: it explains distances.

    Args:
        deviation: of the distance of an observed node, all three components of the rest across the surface, (m,),
            metres.
        modes: of the observed side, in which it varies over it.
        logs: logarithms of their variances, for a field of unit variance.
    """

    has_own_figures: ClassVar[bool] = True

    def __init__(self, deviation: Floats, modes: SurfaceModes, logs: Floats) -> None:
        self.deviation, self.modes, self.logs = deviation, modes, logs

    @property
    def size(self) -> int:
        """Number of modes."""
        return len(self.modes.values)

    @property
    def is_moving(self) -> bool:
        """False."""
        return False

    def log_variances(self, eta: Floats) -> tuple[Floats, Mapping[int, float]]:
        """See `ParameterBlock.log_variances`."""
        return 2.0 * eta[DISCREPANCY] + self.logs, {DISCREPANCY: 2.0}

    def local_error(self, at: Evaluation) -> Floats:
        """Standard deviation of each distance by what the model gets wrong from point to point, (p,), metres.

        It changes over some edges of the mesh, less than points of a cloud lie apart.
        """
        return at.once((self, "local error"), lambda: at.observed.at_points(at.match, self.deviation))

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """See `ParameterBlock.jacobian`."""
        match = slopes.match
        if match is None:
            return np.zeros((slopes.rows.shape[0], self.size))
        corners = at.observed.triangles[match.triangles]
        return -self.local_error(at)[:, None] * self.modes.at(corners, match.weights)

    def explained(self, at: Evaluation, coefficients: Floats) -> Floats:
        """See `ParameterBlock.explained`."""
        return self.local_error(at) * at.observed.at_vertices(at.match, self.modes.modes @ coefficients)


def _modes_of_rest(discrepancy: Discrepancy, observed: SurfaceDistance) -> tuple[SurfaceModes, Floats]:
    """Surface modes of what the patterns leave out, and the logarithms of their variances.

    A field of Matérn's covariance on an area A is independent at (2 nu + 1) A kappa^2 / (4 pi nu^2) places, where
    kappa^2 = 2 nu / l^2: that is tr(C)^2 / tr(C^2) in its modes.
    """
    whole = outer(observed.body).rest
    corners = whole.points[whole.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    modes, nu = observed.modes, _SMOOTHNESS
    base = 4.0 * np.pi * nu**2 * discrepancy.places / ((2.0 * nu + 1.0) * area)
    logs, _ = modes.log_variances(np.sqrt(2.0 * nu / base), nu)
    carried = np.cumsum(np.exp(logs))
    kept = min(len(logs), 1 + int(np.searchsorted(carried, ACCURACY.carried)))
    return modes.leading(kept), logs[:kept]
