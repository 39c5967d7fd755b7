"""What the organ's colours and the figures say of a registered cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtwin.meshes.body import Body
from softtwin.meshes.closest import distances
from softtwin.meshes.embedding import outer
from softtwin.registration.result import Registration

from ..twin import Twin

Floats = NDArray[np.float64]


def margins_of(twin: Twin, found: Registration) -> dict[str, float]:
    """The largest 95 % margin of each inner structure inside the organ, where it is shown, metres, by name."""
    known = found.uncertainty
    return {name: twin.margin_inside(name, known.margin(points)) for name, points in twin.embeddings.items()}


def errors_of(twin: Twin, found: Registration, truth: Floats | None) -> dict[str, float]:
    """Mean distance of each inner structure from where it truly is, metres, by name; empty where that is not known.

    Args:
        twin: the twin.
        found: the registration.
        truth: true nodal displacements, (n, 3), metres.
    """
    if truth is None:
        return {}
    missing = found.displacement - truth
    return {
        name: float(np.linalg.norm(points.displace(missing), axis=1).mean()) for name, points in twin.embeddings.items()
    }


def shown_values(shows: str, body: Body, found: Registration, truth: Floats | None) -> Floats | None:
    """What the colours show at the nodes, (n,), metres, NaN where nothing is told; None where that is nowhere.

    Args:
        shows: a word of `bands.SCALES`.
        body: at rest.
        found: the registration.
        truth: true nodal displacements, (n, 3), metres.
    """
    if shows == "error":
        return None if truth is None else np.linalg.norm(found.displacement - truth, axis=1)
    if shows == "margin":
        return np.asarray(found.uncertainty.margin())
    if shows == "movement":
        return np.linalg.norm(found.displacement, axis=1)
    return near_cloud(body, found.displacement, found.explained)


def near_cloud(body: Body, displacement: Floats, cloud: Floats) -> Floats:
    """Mean distance to the surface of the cloud's points about each node, (n,), metres; NaN where there are none.

    Args:
        body: at rest.
        displacement: nodal, (n, 3), metres.
        cloud: (p, 3), metres, in the body's coordinates.
    """
    away = np.abs(distances(outer(body).moved(displacement), cloud))
    nodes = body.boundary_nodes
    nearest = nodes[cKDTree(body.points[nodes] + displacement[nodes]).query(cloud)[1]]
    count = np.bincount(nearest, minlength=len(body.points))
    total = np.bincount(nearest, weights=away, minlength=len(body.points))
    return np.divide(total, count, out=np.full(len(body.points), np.nan), where=count > 0)
