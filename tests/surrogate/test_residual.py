"""Energy, internal forces and residual in torch: the reference's to rounding, and physics that needs no reference."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from softtwin.meshes.body import Body
from softtwin.meshes.grid import gridded
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import (
    Energy,
    IncompressibleNeoHookean,
    IsochoricNeoHookean,
    LinearElastic,
    Material,
    MooneyRivlin,
    NeoHookean,
    SaintVenantKirchhoff,
)
from softtwin.reference.data.springs import Springs
from softtwin.surrogate.residual import ElasticBody

from .conftest import DEVICES

LAWS: dict[str, Material] = {
    "linear": LinearElastic(4500.0, 0.3),
    "Saint-Venant-Kirchhoff": SaintVenantKirchhoff(4500.0, 0.45),
    "Neo-Hookean": NeoHookean(4500.0, 0.45),
    "isochoric Neo-Hookean": IsochoricNeoHookean(4500.0, 0.49),
    "Mooney-Rivlin": MooneyRivlin.from_elastic(4500.0, 0.45),
}
KINDS = ["tetrahedron", "hexahedron"]


def body_of(kind: str, degree: int = 1, curved: bool = False) -> Body:
    if kind == "gridded":  # hexahedra whose cut cells count with their filled part
        return gridded(beam((3, 2, 2), (1.0, 0.25, 0.25), "tetrahedron"), 0.11)
    made = beam((3, 2, 2), (1.0, 0.25, 0.25), "tetrahedron" if kind == "tetrahedron" else "hexahedron")
    made = made.quadratic() if degree == 2 else made
    points = made.points + 0.01 * np.sin(7.0 * made.points[:, [1, 2, 0]]) if curved else made.points
    return Body(points, made.cells, made.node_sets)


def some_displacement(body: Body, rng: np.random.Generator, size: float = 0.02) -> np.ndarray:
    return size * np.sin(5.0 * body.points @ rng.standard_normal((3, 3)))


def only(fields: Tensor, i: int) -> Tensor:
    return fields[i : i + 1]


def batch(*fields: np.ndarray) -> Tensor:
    return torch.from_numpy(np.stack(fields))


CELLS = {f"{k}-{d}-{c}": (k, d, c) for k in KINDS for d, c in ((1, False), (2, False), (2, True))}
CELLS["gridded"] = ("gridded", 1, False)
PAIRS = [  # every law and every kind of cells each time; each with each before a release
    pytest.param(
        LAWS[law], *cells, id=f"{name}-{law}",
        marks=() if law == "Neo-Hookean" or name == "hexahedron-2-True" else pytest.mark.slow,
    )
    for name, cells in CELLS.items() for law in LAWS
]  # fmt: skip


@pytest.mark.fenicsx
@pytest.mark.parametrize(("law", "kind", "degree", "curved"), PAIRS)
def test_energy_forces_and_residual_are_the_references(
    law: Material, kind: str, degree: int, curved: bool, rng
) -> None:
    from softtwin.reference.solve.problem import Problem

    body = body_of(kind, degree, curved)
    weights = None if kind == "gridded" else rng.uniform(0.3, 1.0, len(body.cells))
    assert (kind == "gridded") == (body.fractions is not None and body.fractions.min() < 0.9)
    fields = [some_displacement(body, rng) for _ in range(2)]
    physics = ElasticBody(body, law, weights)
    energies, forces = physics.energy(batch(*fields)).numpy(), physics.internal_forces(batch(*fields)).numpy()
    loads = [np.abs(forces).max() * rng.standard_normal(body.points.shape) for _ in fields]
    residuals = physics.residual(batch(*fields), batch(*loads)).numpy()
    with Problem(body, law, weights=weights) as problem:
        stiffness = problem.stiffness(fields[0])
        free = np.repeat(np.isin(np.arange(len(body.points)), body.free), 3)
        found = physics.stiffness(torch.from_numpy(fields[0]))[free][:, free]
        assert abs(found - stiffness[free][:, free]).max() < 1e-10 * abs(stiffness).max()
        for field, load, energy, force, residual in zip(fields, loads, energies, forces, residuals, strict=True):
            expected = problem.internal_forces(field)
            missing = (expected - load)[body.free]
            assert residual == pytest.approx(np.linalg.norm(missing) / np.linalg.norm(load[body.free]), rel=1e-10)
            assert energy == pytest.approx(problem.energy(field), rel=1e-10)
            np.testing.assert_allclose(force, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.fenicsx
def test_each_cell_has_its_own_parameters_and_equilibria_have_no_residual(rng) -> None:
    from softtwin.reference.solve.problem import NewtonOptions, Problem

    body = body_of("hexahedron")
    law = NeoHookean(rng.uniform(3e3, 6e3, len(body.cells)), 0.45)
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"]] = [0.0, 0.1, -0.3]
    with Problem(body, law, NewtonOptions(tolerance=1e-10)) as problem:
        found = problem.solve(forces).displacement
    physics = ElasticBody(body, law)
    residuals = physics.residual(batch(found, 1.01 * found), batch(forces, forces)).numpy()
    assert residuals[0] < 1e-9 and residuals[1] > 1e-3
    potentials = physics.potential(batch(found, 1.01 * found, 0.99 * found), batch(*[forces] * 3))
    assert potentials.argmin() == 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
def test_forces_are_the_derivative_of_the_energy(law: Material, kind: str, rng) -> None:
    body = body_of(kind, 2)
    physics, fields = ElasticBody(body, law), batch(*(some_displacement(body, rng) for _ in range(3)))
    fields.requires_grad_()
    (slopes,) = torch.autograd.grad(physics.energy(fields).sum(), fields)
    torch.testing.assert_close(physics.internal_forces(fields).detach(), slopes, rtol=0.0, atol=1e-10)


def test_the_residual_can_be_a_loss(rng) -> None:
    """Its derivative by the displacement, for training, against central differences; the weights of a body on another
    device or in another precision come along with `to`."""
    body = body_of("hexahedron")
    physics = ElasticBody(body, LAWS["Neo-Hookean"])
    u, b = batch(some_displacement(body, rng)), batch(0.1 * rng.standard_normal(body.points.shape))
    u.requires_grad_()
    (slope,) = torch.autograd.grad(physics.residual(u, b).sum(), u)
    way, step = batch(rng.standard_normal(body.points.shape)), 1e-6
    with torch.no_grad():
        ahead, behind = (physics.residual(u + sign * step * way, b) for sign in (1.0, -1.0))
    assert float((slope * way).sum()) == pytest.approx(float(ahead - behind) / (2.0 * step), rel=1e-6)
    single = physics.to(torch.float32)
    assert single.energy(u.detach().float()).dtype == torch.float32


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
def test_a_rigid_motion_costs_nothing_but_in_the_linear_law(law: Material) -> None:
    body = body_of("tetrahedron")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = body.points @ turn.T + 0.3 - body.points
    energies = ElasticBody(body, law).energy(batch(np.zeros_like(moved), np.full_like(moved, 0.3), moved)).numpy()
    np.testing.assert_allclose(energies[:2], 0.0, atol=1e-10)
    assert (abs(energies[2]) > 1.0) == isinstance(law, LinearElastic)


@pytest.mark.parametrize("device", DEVICES)
def test_a_batch_on_any_device_is_its_samples_on_the_cpu(device: str, rng) -> None:
    body = body_of("hexahedron")
    u = batch(*(some_displacement(body, rng) for _ in range(3)))
    b = batch(*(rng.standard_normal(body.points.shape) for _ in range(3)))
    alone, physics = (ElasticBody(body, LAWS["Neo-Hookean"]) for _ in range(2))
    physics = physics.to(device)
    sent = u.to(device), b.to(device)
    for found, one in (
        (physics.energy(sent[0]), lambda i: alone.energy(only(u, i))),
        (physics.internal_forces(sent[0]), lambda i: alone.internal_forces(only(u, i))),
        (physics.residual(*sent), lambda i: alone.residual(only(u, i), only(b, i))),
    ):
        assert found.device.type == device
        expected = torch.cat([one(i) for i in range(3)])
        assert (found.cpu() - expected).abs().max() < 1e-12 * expected.abs().max()
    stiffness = alone.stiffness(u[0])
    assert abs(physics.stiffness(sent[0][0]) - stiffness).max() < 1e-12 * abs(stiffness).max()


def test_a_cell_inside_out_shows(rng) -> None:
    body = body_of("tetrahedron")
    turned = -2.0 * body.points * [1.0, 0.0, 0.0]
    physics = ElasticBody(body, LAWS["Neo-Hookean"])
    jacobians = physics.jacobians(batch(np.zeros_like(turned), turned))
    torch.testing.assert_close(jacobians[0], torch.ones_like(jacobians[0]))
    assert bool((jacobians[1] < 0.0).all()) and bool(physics.energy(batch(turned)).isnan().all())


@pytest.mark.parametrize(
    ("law", "weights", "message"),
    [
        (IncompressibleNeoHookean(1500.0), None, "ElasticBody.material: expected a compressible law"),
        (Energy(lambda F, mu: mu, {"mu": 1.0}), None, "ElasticBody.material: expected a compressible law"),
        (NeoHookean(4500.0, 0.45), np.ones(3), r"ElasticBody.weights: expected shape \(12,\), got \(3,\)"),
        (
            NeoHookean(np.ones(3), 0.45),
            None,
            r"ElasticBody.material.young_modulus: expected .* 12 cells, got shape \(3,\)",
        ),
    ],
)
def test_what_is_no_batch_of_equilibria_is_refused(law: Material, weights: np.ndarray | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ElasticBody(body_of("hexahedron"), law, weights)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (torch.zeros(36, 3, dtype=torch.float64), r"expected shape \(s, 36, 3\), got \(36, 3\)"),
        (torch.zeros(2, 35, 3, dtype=torch.float64), r"expected shape \(s, 36, 3\), got \(2, 35, 3\)"),
        (torch.zeros(2, 36, 2, dtype=torch.float64), r"expected shape \(s, 36, 3\), got \(2, 36, 2\)"),
        (torch.zeros(2, 36, 3), r"expected torch\.float64, got torch\.float32"),
        (torch.zeros(2, 36, 3, dtype=torch.complex128), r"expected torch\.float64, got torch\.complex128"),
        (np.zeros((2, 36, 3)), "expected a tensor, got ndarray"),
    ],
)
def test_a_batch_of_the_wrong_shape_or_type_is_refused(field: Tensor, message: str) -> None:
    physics, rest = ElasticBody(body_of("hexahedron"), LAWS["Neo-Hookean"]), torch.zeros(2, 36, 3, dtype=torch.float64)
    for ask in (physics.energy, physics.internal_forces, physics.jacobians):
        with pytest.raises(ValueError, match=rf"ElasticBody\.displacement: {message}"):
            ask(field)
    for ask in (physics.residual, physics.potential):
        with pytest.raises(ValueError, match=rf"ElasticBody\.forces: {message}"):
            ask(rest, field)


def test_the_tangent_of_the_free_unknowns_is_a_part_of_the_whole(rng: np.random.Generator) -> None:
    """In any state, with springs and with another stiffness of them."""
    made = beam((4, 2, 2), (0.4, 0.1, 0.1), "tetrahedron")
    side = made.boundary[np.isclose(made.points[made.boundary][..., 2], made.points[:, 2].max()).all(axis=1)]
    body = Body(made.points, made.cells, made.node_sets, {"side": side})
    elastic = ElasticBody(body, NeoHookean(4500.0, 0.4), springs={"side": Springs(2e4, 1e4)})
    free = np.setdiff1d(np.arange(3 * len(body.points)), (3 * body.fixed[:, None] + np.arange(3)).ravel())
    for each in (elastic, elastic.with_springs({"side": 3.0})):
        for size in (0.0, 1e-3):
            at = torch.from_numpy(size * rng.standard_normal(body.points.shape))
            wanted = each.stiffness(at).toarray()[np.ix_(free, free)]
            found = each.free_stiffness(at).toarray()
            np.testing.assert_allclose(found, wanted, atol=1e-12 * np.abs(wanted).max())
