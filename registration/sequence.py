"""Frame after frame: each cloud starts from what the last one found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.clouds import check_cloud

from .minimise import Registrar, Registration

Floats = NDArray[np.float64]


def register_sequence(registrar: Registrar, clouds: Iterable[Floats]) -> Iterator[Registration]:
    """Register clouds in their order, as they come; the caller may stop between any two.

    Args:
        registrar: model, observed side, control and options.
        clouds: one cloud a frame, (p, 3), metres.

    Raises:
        CloudError: a cloud that is empty, holds NaN, or lies too far from the body.
    """
    coefficients = None
    for cloud in clouds:
        check_cloud(cloud, registrar.model.body)
        result = registrar.register(cloud, coefficients)
        coefficients = result.coefficients
        yield result
