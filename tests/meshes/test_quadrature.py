"""Quadrature and shape functions of every kind of cell."""

from __future__ import annotations

from itertools import product
from math import factorial

import numpy as np
import pytest

from softtwin.meshes.elements import KINDS, Kind
from softtwin.meshes.quadrature import quadrature, reference_nodes, shape_functions

EVERY = pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
RULES = [
    ((3, 4), 1, 1),
    ((3, 4), 3, 5),
    ((3, 4), 4, 14),
    *(((3, 8), degree, points) for degree, points in ((1, 1), (3, 8), (5, 27))),
    ((2, 4), 3, 4),
    ((2, 3), 2, 3),
    ((2, 3), 4, 6),
]


@pytest.mark.parametrize(("key", "degree", "count"), RULES)
def test_monomials_are_integrated_exactly(key: tuple[int, int], degree: int, count: int) -> None:
    kind = KINDS[key]
    points, weights = quadrature(kind, degree)
    assert len(points) == len(weights) == count
    assert (points >= -1e-15).all() and (points <= 1.0).all()
    is_simplex = kind.shape in ("triangle", "tetrahedron")
    for powers in product(range(degree + 1), repeat=kind.dimension):
        if is_simplex and sum(powers) > degree:
            continue
        exact = np.prod([factorial(p) for p in powers]) / factorial(sum(powers) + kind.dimension)
        exact = exact if is_simplex else np.prod([1.0 / (p + 1) for p in powers])
        assert weights @ np.prod(points**powers, axis=1) == pytest.approx(exact, abs=1e-14)


@pytest.mark.parametrize(("key", "degree"), [((2, 3), 5), ((3, 10), 5)])
def test_a_rule_that_is_not_there_is_said(key: tuple[int, int], degree: int) -> None:
    with pytest.raises(ValueError, match=rf"quadrature: no rule of degree {degree} for a t"):
        quadrature(KINDS[key], degree)


@EVERY
def test_shape_functions_are_one_at_their_own_node_and_zero_at_the_others(kind: Kind) -> None:
    values, _ = shape_functions(kind, reference_nodes(kind))
    np.testing.assert_allclose(values, np.eye(kind.nodes), atol=1e-12)


@EVERY
def test_shape_functions_sum_to_one_and_have_exact_gradients(kind: Kind, rng) -> None:
    points, step = rng.uniform(0.1, 0.3, (5, kind.dimension)), 1e-5
    values, gradients = shape_functions(kind, points)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-12)
    for axis in range(kind.dimension):
        ahead, behind = (
            shape_functions(kind, points + sign * step * np.eye(kind.dimension)[axis])[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(gradients[:, :, axis], (ahead - behind) / (2.0 * step), atol=1e-8)
