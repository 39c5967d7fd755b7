"""What a law that is linear in the displacement gets wrong, by how far the body turns and stretches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.metrics import displacement_gradients

Floats = NDArray[np.float64]
_NEARLY_ALL = 95.0  # per cent of the cells


def displacement_gradient_norm(body: Body, displacement: Floats) -> float:
    """Norm of the displacement's gradient that nearly all cells stay below, dimensionless.

    Args:
        body: the body.
        displacement: of its nodes, (n, 3), metres.
    """
    gradients = displacement_gradients(body, displacement)
    return float(np.percentile(np.linalg.norm(gradients, ord=2, axis=(1, 2)), _NEARLY_ALL))


def linear_law_error(body: Body, displacement: Floats) -> float:
    """Standard deviation of a component of any node's displacement by what a linear law leaves out, metres.

    Green's strain is e + G' G / 2 with the displacement's gradient G and its symmetric part e: beside e, a linear law
    leaves out half of |G|. So much of the largest displacement is what a node is taken to be off by, in any direction:
    what one part of a body is wrong about, the parts behind it are carried along by.

    Args:
        body: the body.
        displacement: that a linear law has found, (n, 3), metres.
    """
    largest = float(np.linalg.norm(displacement, axis=1).max())
    return 0.5 * displacement_gradient_norm(body, displacement) * largest / np.sqrt(3.0)
