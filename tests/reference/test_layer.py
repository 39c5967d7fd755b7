"""The reference as a torch layer: gradients and their gradients against differences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
torch = pytest.importorskip("torch", reason="torch is absent")

import ufl

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import Energy, NeoHookean
from softtwin.reference.derivatives.layer import EquilibriumLayer
from softtwin.reference.solve.problem import NewtonOptions, Problem

E, NU = 5.0, 0.3  # soft and small: displacements, forces and moduli of like size suit differences
EXACT = NewtonOptions(tolerance=1e-12)


@pytest.fixture(scope="module")
def body() -> Body:
    return beam((2, 1, 1), (1.0, 0.5, 0.5), "hexahedron")


@pytest.fixture
def layer(body: Body) -> Iterator[EquilibriumLayer]:
    with Problem(body, NeoHookean(E, NU), EXACT) as problem:
        yield EquilibriumLayer(problem)


def forces_of(body: Body, values: torch.Tensor) -> torch.Tensor:
    """Forces on the tip alone from (tip nodes, 3) values."""
    full = torch.zeros(body.points.shape, dtype=values.dtype)
    return full.index_put((torch.as_tensor(body.node_sets["tip"].copy()),), values)


def test_gradients_and_their_gradients(layer: EquilibriumLayer, body: Body) -> None:
    values = 0.05 * torch.randn(
        len(body.node_sets["tip"]), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    young, poisson = torch.tensor(E, dtype=torch.float64), torch.tensor(NU, dtype=torch.float64)
    inputs = tuple(t.requires_grad_() for t in (values, young, poisson))

    def displaced(values: torch.Tensor, young: torch.Tensor, poisson: torch.Tensor) -> torch.Tensor:
        u = layer(forces_of(body, values), young, poisson)
        return (u**2).sum() + u[int(body.node_sets["tip"][0])].sum()

    # Central differences with steps h err by h^2 u''' (1e-12) and by the solver's 1e-12 over h: 1e-5 covers both.
    assert torch.autograd.gradcheck(displaced, inputs, eps=1e-5, atol=1e-6, rtol=1e-5)
    assert torch.autograd.gradgradcheck(displaced, inputs, eps=1e-5, atol=1e-5, rtol=1e-4)


def test_parameters_of_each_cell_have_gradients(body: Body) -> None:
    with Problem(body, NeoHookean(np.full(len(body.cells), E), NU), EXACT) as problem:
        layer = EquilibriumLayer(problem)
        forces = forces_of(body, torch.full((4, 3), 0.05, dtype=torch.float64))
        young = torch.tensor([4.0, 6.0], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda y: layer(forces, y), (young,), eps=1e-5, atol=1e-6)


def test_an_energy_of_ones_own_has_gradients(body: Body) -> None:
    def neo_hookean(F: Any, mu: Any, lmbda: Any) -> Any:
        ln_J = ufl.ln(ufl.det(F))
        return mu / 2 * (ufl.inner(F, F) - 3) - mu * ln_J + lmbda / 2 * ln_J**2

    with Problem(body, Energy(neo_hookean, {"mu": 2.0, "lmbda": np.full(len(body.cells), 3.0)}), EXACT) as problem:
        layer = EquilibriumLayer(problem)
        forces = forces_of(body, torch.full((4, 3), 0.05, dtype=torch.float64))
        mu = torch.tensor(1.9, dtype=torch.float64, requires_grad=True)
        lmbda = torch.tensor([2.5, 3.5], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(
            lambda m, k: layer(forces, lmbda=k, mu=m), (mu, lmbda), eps=1e-5, atol=1e-6, rtol=1e-5
        )
        assert problem.material.parameters["mu"] == pytest.approx(1.9, abs=1e-4)


def test_a_batch_is_its_samples_and_types_are_kept(layer: EquilibriumLayer, body: Body) -> None:
    one = forces_of(body, torch.full((4, 3), 0.05))
    both = layer(torch.stack([one, 2 * one]))
    assert both.dtype == torch.float32 and both.shape == (2, *body.points.shape)
    assert torch.equal(both[0], layer(one)) and layer.last is not None


def test_a_network_can_be_trained_through_the_reference(layer: EquilibriumLayer, body: Body) -> None:
    """A force that a linear map makes of a code is found from the displacement that it causes."""
    wanted = forces_of(body, torch.tensor([[0.0, 0.02, 0.05]], dtype=torch.float64).repeat(4, 1))
    target = layer(wanted).detach()
    torch.manual_seed(0)
    network = torch.nn.Linear(2, 3, dtype=torch.float64)
    code = torch.tensor([1.0, -0.5], dtype=torch.float64)
    optimiser = torch.optim.LBFGS(network.parameters(), max_iter=30, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        value = ((layer(forces_of(body, network(code).repeat(4, 1))) - target) ** 2).sum()
        value.backward()
        return value

    first = loss().item()
    optimiser.step(loss)
    assert loss().item() < 1e-8 * first


def test_unknown_parameters_are_refused(layer: EquilibriumLayer, body: Body) -> None:
    with pytest.raises(
        TypeError, match=r"EquilibriumLayer: expected the parameters \('young_modulus', 'poisson_ratio'\)"
    ):
        layer(torch.zeros(body.points.shape), density=3.0)
