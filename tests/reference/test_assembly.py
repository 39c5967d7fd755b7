"""Tangents summed from their cells are those that DOLFINx inserts."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from verification_cases import PLANE, QUADRATIC, SPACE, box

from softtwin.reference.data.materials import IncompressibleNeoHookean, Material, NeoHookean
from softtwin.reference.fem import assembly
from softtwin.reference.fem.discretisation import Discretisation
from softtwin.reference.fem.fenicsx import assemble_matrix, create_matrix
from softtwin.reference.fem.forms import DiscreteLoad, Forms

CASES = [(kind, False) for kind in (*PLANE, *SPACE)] + [(kind, True) for kind in QUADRATIC]


@pytest.mark.parametrize(("kind", "mixed"), CASES)
def test_the_sum_of_cells_is_the_assembled_matrix(kind: str, mixed: bool, rng: np.random.Generator) -> None:
    body = box(kind, 2)
    young = rng.uniform(1e3, 5e3, len(body.cells))
    material: Material = IncompressibleNeoHookean(young) if mixed else NeoHookean(young, 0.45)
    space = Discretisation(body, mixed, {"x0": "xyz"[: body.dimension], "y0": "y"})
    forms = Forms(space, material, rng.uniform(0.5, 1.0, len(body.cells)))
    unknowns = 0.01 * rng.standard_normal(space.owned)
    unknowns[space.fixed] = 0.0

    summed, inserted = forms.create_matrix(), create_matrix(forms.tangent_form)
    state = summed.stateGet()
    forms.tangent(unknowns, DiscreteLoad(np.zeros(space.owned), np.zeros(space.owned), {}), summed)
    assemble_matrix(inserted, forms.tangent_form, space.conditions)

    assert summed.getAttr("values") is not None, "DOLFINx assembled both"
    assert summed.stateGet() > state, "a solver would keep its old factors"
    for mine, theirs in zip(summed.getValuesCSR(), inserted.getValuesCSR(), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-13 * np.abs(theirs).max())


def test_a_body_too_large_for_its_cells_to_be_kept_is_left_to_dolfinx(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assembly, "_MOST_ENTRIES", 1000)
    forms = Forms(Discretisation(box("tetra", 2), False, {"x0": "xyz"}), NeoHookean(4500.0, 0.45))
    matrix = forms.create_matrix()
    forms.tangent(np.zeros(forms.space.owned), DiscreteLoad(*np.zeros((2, forms.space.owned)), {}), matrix)
    assert matrix.getAttr("values") is None
    assert matrix.norm() > 0.0
