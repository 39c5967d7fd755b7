"""Stress and moduli by invariants are those that jets by the deformation gradient give, law by law."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from softtwin.meshes import compiled as compilation
from softtwin.reference.data.materials import MATERIALS, Energy, Material, MooneyRivlin
from softtwin.surrogate import invariants
from softtwin.surrogate.invariants import densities, has_invariants, invariants_of
from softtwin.surrogate.jets import JetAlgebra

Floats = NDArray[np.float64]
COUNT = 60
LAWS = {name: law(1.0, 0.3) for name, law in MATERIALS.items() if name != "linear-elastic"}
LAWS["mooney-rivlin"] = MooneyRivlin(1.0, 1.0, 1.0)

needs_numba = pytest.mark.skipif(compilation.numba is None, reason="numba is absent: the extra `app`")


@pytest.fixture
def gradients(rng: np.random.Generator) -> Floats:
    """Far from rest, right side out."""
    found = np.eye(3) + 0.4 * rng.uniform(-1.0, 1.0, (4 * COUNT, 3, 3))
    return found[np.linalg.det(found) > 0.1][:COUNT]


def law_of(name: str) -> tuple[Material, Any]:
    """A law, and parameters of it that differ from point to point."""
    law = LAWS[name]
    spread = np.linspace(0.0, 1.0, COUNT)
    known = {
        each: 0.4 + 0.05 * spread if each == "poisson_ratio" else 3.0 + number + spread
        for number, each in enumerate(law.parameters)
    }
    return law, SimpleNamespace(**known)


@needs_numba
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", LAWS)
def test_derivatives_are_those_of_jets(name: str, order: int, gradients: Floats) -> None:
    law, parameters = law_of(name)
    assert has_invariants(law)
    algebra = JetAlgebra(order)
    jet = law.energy(algebra.variable(gradients), None, parameters, algebra)
    flat = gradients.reshape(-1, 9)
    known = invariants_of(flat)
    energy, derivative = densities(law, parameters, flat, known, order)
    wanted = jet.first if order == 1 else jet.second
    size = np.abs(wanted).max()
    np.testing.assert_allclose(energy, jet.value, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(derivative, wanted, rtol=1e-11, atol=1e-13 * size)
    np.testing.assert_allclose(known[:, 2], np.linalg.det(gradients), rtol=1e-12)


@needs_numba
def test_one_parameter_for_all_is_enough(gradients: Floats) -> None:
    law = MATERIALS["neo-hookean"](1.0, 0.3)
    one = SimpleNamespace(young_modulus=np.array([3.0]), poisson_ratio=np.array([0.4]))
    each = SimpleNamespace(young_modulus=np.full(COUNT, 3.0), poisson_ratio=np.full(COUNT, 0.4))
    flat = gradients.reshape(-1, 9)
    known = invariants_of(flat)
    for found, wanted in zip(densities(law, one, flat, known, 2), densities(law, each, flat, known, 2), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_laws_that_are_written_otherwise_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small strains are no function of C; nor is what looks at one direction. Jets take these."""
    assert not has_invariants(MATERIALS["linear-elastic"](1.0, 0.3))
    assert not has_invariants(Energy(lambda F, mu: mu * F[0, 0] ** 2, {"mu": 1.0}))
    monkeypatch.setattr(invariants, "IS_COMPILED", False)
    assert not has_invariants(MATERIALS["neo-hookean"](1.0, 0.3))
