"""What steps with a kept factorisation learn from each other: a quadratic energy, other factors, no curvature."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.reference.data.secants import Secants

Floats = np.ndarray


def dot(a: Floats, b: Floats) -> float:
    return float(a @ b)


def stiffness(size: int, seed: int) -> Floats:
    root = np.random.default_rng(seed).standard_normal((size, size))
    return root @ root.T + size * np.eye(size)


def test_of_a_quadratic_energy_it_learns_the_whole_stiffness() -> None:
    """With exact line searches BFGS ends after as many steps as there are unknowns, whatever it began with."""
    size = 7
    true, kept = stiffness(size, 0), stiffness(size, 1)
    secants, at, load = Secants(dot), np.zeros(size), np.arange(1.0, size + 1.0)
    for _ in range(size + 1):
        gap = true @ at - load
        step = secants.improved(at, gap, np.linalg.solve(kept, gap), 0)
        at = at - (gap @ step) / (step @ true @ step + 1e-300) * step
    np.testing.assert_allclose(true @ at, load, atol=1e-8)


def test_its_steps_lead_downhill() -> None:
    size = 7
    true, kept = stiffness(size, 0), stiffness(size, 1)
    secants, rng = Secants(dot), np.random.default_rng(2)
    for point in rng.standard_normal((12, size)):
        gap = true @ point
        assert secants.improved(point, gap, np.linalg.solve(kept, gap), 0) @ gap > 0.0


def test_another_factorisation_forgets_them() -> None:
    size = 5
    true, kept = stiffness(size, 0), stiffness(size, 1)
    secants, rng = Secants(dot), np.random.default_rng(2)
    for made, point in zip((0, 0, 1), rng.standard_normal((3, size)), strict=True):
        gap = true @ point
        plain = np.linalg.solve(kept, gap)
        step = secants.improved(point, gap, plain, made)
        assert np.array_equal(step, plain) is (made == 1 or not secants._pairs)


def test_steps_along_which_the_energy_curves_down_teach_nothing() -> None:
    secants = Secants(dot)
    down = -np.eye(3)
    for point in (np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, 0.0])):
        gap = down @ point
        np.testing.assert_array_equal(secants.improved(point, gap, gap.copy(), 0), gap)


def test_a_tangent_of_before_is_brought_up_to_date() -> None:
    """What the last step has told holds exactly, and all of it makes steps better."""
    rng = np.random.default_rng(4)
    root = rng.standard_normal((6, 6))
    true, secants, wanted, at = np.eye(6) + 0.3 * root @ root.T, Secants(dot), rng.standard_normal(6), np.zeros(6)
    before = np.linalg.norm(true @ wanted - wanted)
    for step in rng.standard_normal((8, 6)):
        secants.improved(at, true @ at, true @ at, 0)
        moved = at + step
        found = secants.improved(moved, true @ moved, true @ moved, 0) - secants.improved(at, true @ at, true @ at, 0)
        np.testing.assert_allclose(found, step, rtol=1e-8, atol=1e-8)
        at = moved
    assert np.linalg.norm(true @ secants.improved(at, wanted, wanted, 0) - wanted) < 0.5 * before
