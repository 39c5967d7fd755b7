"""The Galerkin model: derivatives by jets, modal derivatives, cubature, equilibria in a span, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.shapes import beam
from softtwin.meshes.signed import cells_inside
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import MATERIALS, MooneyRivlin, NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.springs import Ligament, Springs
from softtwin.surrogate.algebra import TorchAlgebra
from softtwin.surrogate.cubature import sparse_weights
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.export import export
from softtwin.surrogate.fast import FastSurrogate
from softtwin.surrogate.galerkin import Galerkin, slopes_of, support_of, typical_loads
from softtwin.surrogate.jets import JetAlgebra
from softtwin.surrogate.modal_derivatives import FactoredTangent, leading_modes, modal_derivatives, without
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.physics import Physics
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.reduced_equilibria import GalerkinNetwork, _Search
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import load, save

from .test_equilibria import some_loads
from .test_residual import LAWS, body_of


@pytest.fixture(scope="module")
def bar() -> Body:
    return beam((6, 2, 2), (1.0, 0.25, 0.25))


# ---------------------------------------------------------------------- jets


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("name", [*MATERIALS, "mooney-rivlin"])
def test_jets_are_what_autograd_makes_of_a_law(name: str, count: int, rng: np.random.Generator) -> None:
    law = MooneyRivlin(600.0, 200.0, 2e4) if name == "mooney-rivlin" else MATERIALS[name](4500.0, 0.45)
    stiffness = rng.uniform(0.5, 2.0, count)  # another in each point
    parameters = SimpleNamespace(**{n: torch.from_numpy(stiffness**0.1 * v) for n, v in law.parameters.items()})
    F = torch.eye(3, dtype=torch.float64) + torch.from_numpy(0.15 * rng.standard_normal((count, 3, 3)))

    def density(at: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = law.energy(at, None, parameters, TorchAlgebra(at)).sum()
        return found

    algebra = JetAlgebra(2)
    found = law.energy(algebra.variable(F), None, parameters, algebra)
    first = torch.func.grad(density)(F).reshape(count, 9)
    second = torch.func.hessian(density)(F).reshape(count, 9, count, 9)
    second = torch.stack([second[point, :, point] for point in range(count)])
    torch.testing.assert_close(found.value.sum(), density(F), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found.first, first, rtol=1e-10, atol=1e-10 * float(first.abs().max()))
    torch.testing.assert_close(
        found.second.expand(count, 9, 9), second, rtol=1e-10, atol=1e-10 * float(second.abs().max())
    )
    once = JetAlgebra(1)
    assert law.energy(once.variable(F), None, parameters, once).second is None
    plain = SimpleNamespace(**{n: values.numpy() for n, values in vars(parameters).items()})
    of_numpy = law.energy(algebra.variable(F.numpy()), None, plain, algebra)
    for mine, theirs in ((of_numpy.value, found.value), (of_numpy.first, found.first), (of_numpy.second, found.second)):
        assert isinstance(mine, np.ndarray)
        np.testing.assert_allclose(mine, theirs.numpy(), rtol=1e-10, atol=1e-10 * float(theirs.abs().max()))


@pytest.mark.parametrize("law", LAWS)
def test_moduli_are_those_of_autograd(law: str, bar: Body, rng: np.random.Generator) -> None:
    elastic = ElasticBody(bar, LAWS[law])
    F = elastic.deformation_gradients(torch.from_numpy(0.01 * rng.standard_normal((2, len(bar.points), 3))))
    wanted = elastic._moduli_by_autograd(F)
    torch.testing.assert_close(elastic.moduli(F), wanted, rtol=1e-9, atol=1e-9 * float(wanted.abs().max()))


@pytest.mark.parametrize("law", LAWS)
def test_moduli_have_the_precision_of_the_body(law: str, bar: Body, rng: np.random.Generator) -> None:
    exact = ElasticBody(bar, LAWS[law])
    at = torch.from_numpy(0.01 * rng.standard_normal((1, len(bar.points), 3)))
    wanted = exact.cell_stiffnesses(at)
    found = ElasticBody(bar, LAWS[law]).to(torch.float32).cell_stiffnesses(at.float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), wanted, rtol=0.0, atol=1e-4 * float(wanted.abs().max()))


# ---------------------------------------------------------------------- modes and cells


def test_modal_derivatives_are_the_second_order_of_equilibria(bar: Body, rng: np.random.Generator) -> None:
    material = NeoHookean(4500.0, 0.45)
    elastic, solver = ElasticBody(bar, material), Equilibria(bar, material)
    tangent = FactoredTangent(elastic)
    loads = some_loads(bar, 2, 1.0, rng)
    linear = tangent.inverse(loads.reshape(2, -1).T.numpy())
    own, mixed, other = modal_derivatives(tangent, linear)  # (0, 0), (0, 1), (1, 1)
    missed = []
    for size in (0.4, 0.2, 0.1):
        a, b = size, -0.5 * size
        exact = solver.solve((a * loads[0] + b * loads[1])[None]).displacement.numpy().ravel()
        expansion = linear @ [a, b] + a * a * own + a * b * mixed + b * b * other
        missed.append(np.linalg.norm(exact - expansion) / np.linalg.norm(exact))
    assert np.log2(np.divide(missed[:-1], missed[1:])).min() > 1.8  # relative: the third order is what is missing
    assert missed[-1] < 1e-3


def test_modes_are_orthonormal_and_lead(rng: np.random.Generator) -> None:
    fields = (
        rng.standard_normal((12, 4)) @ np.diag([5.0, 2.0, 1.0, 1e-9]) @ np.linalg.qr(rng.standard_normal((30, 4)))[0].T
    )
    modes = leading_modes(fields, 8)
    assert modes.shape == (30, 3)  # what rounding has made is none
    np.testing.assert_allclose(modes.T @ modes, np.eye(3), atol=1e-12)
    assert np.abs(without(fields, modes)).max() < 1e-6


def test_cells_carry_what_all_carry(rng: np.random.Generator) -> None:
    """Few columns with weights that are not negative make the sum of 400; more are taken where more is asked."""
    shares = rng.uniform(0.2, 1.0, (30, 400)) * rng.standard_normal((30, 1))
    last = np.inf
    for tolerance in (0.1, 0.03, 1e-6):
        cells, weights, missing = sparse_weights(shares, tolerance, 400)
        assert missing <= tolerance and missing < last and (weights > 0.0).all() and len(cells) <= 60
        rebuilt = shares[:, cells] @ weights
        assert np.linalg.norm(rebuilt - shares.sum(axis=1)) == pytest.approx(
            missing * np.linalg.norm(shares.sum(axis=1)), abs=1e-9
        )
        last = missing
    assert len(sparse_weights(shares, 1e-6, 8)[0]) <= 8 + 4
    assert sparse_weights(shares, 1e-15, 400)[2] < 1e-9  # as far as rounding lets it, and then it ends
    none, weights, missing = sparse_weights(np.zeros((5, 10)), 0.01, 10)
    assert len(none) == len(weights) == 0 and missing == 0.0


# ---------------------------------------------------------------------- equilibria in a span


def whole_span(body: Body, law: str, springs: dict[str, Springs] | None = None) -> GalerkinNetwork:
    """All displacements of a body, all of its cells: the equilibria themselves."""
    elastic = ElasticBody(body, LAWS[law], springs=springs or {})
    free = np.flatnonzero(np.repeat(elastic.free[:, 0].numpy() > 0.0, 3))
    basis = np.eye(body.points.size)[:, free]
    names = elastic.material.parameters
    parameters = {name: getattr(elastic, f"parameter_{name}").reshape(-1) for name in names}
    kind = next(name for name, each in MATERIALS.items() if type(LAWS[law]) is each)
    cells = torch.arange(len(elastic.volumes)).repeat_interleave(elastic.volumes.shape[1])
    weights = elastic.volumes.reshape(-1)
    return GalerkinNetwork(
        kind, parameters, slopes_of(elastic, basis), weights, support_of(elastic, basis), cells, len(body.cells)
    )


KNOWN = [law for law in LAWS if type(LAWS[law]) in MATERIALS.values()]


@pytest.mark.parametrize("law", KNOWN)
def test_in_the_whole_span_states_are_equilibria(law: str, bar: Body, rng: np.random.Generator) -> None:
    loads = some_loads(bar, 2, 12.0, rng)
    exact = Equilibria(bar, LAWS[law]).solve(loads).displacement.numpy()
    free = np.setdiff1d(np.arange(len(bar.points)), bar.fixed)
    network = whole_span(bar, law)
    linear = torch.linalg.solve(network.at_rest, loads[:, free].reshape(2, -1).T).T
    values = network(loads[:, free].reshape(2, -1))
    found = (linear + values).reshape(2, -1, 3).numpy()
    np.testing.assert_allclose(found, exact[:, free], rtol=0.0, atol=1e-7 * np.abs(exact).max())
    assert np.abs(exact).max() > 0.05


def test_springs_hold_it_as_they_hold_the_body(rng: np.random.Generator) -> None:
    body = body_of("tetrahedron", 1)
    face = body.boundary[(body.points[body.boundary][:, :, 0] > body.points[:, 0].max() - 1e-9).all(axis=1)]
    body = replace(body, surfaces={**body.surfaces, "end": face})
    springs = {"end": Springs(3e4, 1e4)}
    loads = some_loads(body, 1, 8.0, rng)
    exact = Equilibria(body, LAWS["Neo-Hookean"], springs=springs).solve(loads).displacement[0].numpy()
    without_them = Equilibria(body, LAWS["Neo-Hookean"]).solve(loads).displacement[0].numpy()
    network = whole_span(body, "Neo-Hookean", springs)
    free = np.setdiff1d(np.arange(len(body.points)), body.fixed)
    state = network.linearised(loads[0, free].flatten())
    np.testing.assert_allclose(state.q.numpy(), exact[free].ravel(), rtol=0.0, atol=1e-7 * np.abs(exact).max())
    assert np.abs(exact - without_them).max() > 0.1 * np.abs(exact).max()


def test_springs_may_be_stiffer_or_softer(rng: np.random.Generator) -> None:
    """States are those of the body on such springs; derivatives by the factor are those of differences."""
    body = body_of("tetrahedron", 1)
    face = body.boundary[(body.points[body.boundary][:, :, 0] > body.points[:, 0].max() - 1e-9).all(axis=1)]
    body = replace(body, surfaces={**body.surfaces, "end": face})
    loads = some_loads(body, 1, 8.0, rng)
    network = whole_span(body, "Neo-Hookean", {"end": Springs(3e4, 1e4)})
    free = np.setdiff1d(np.arange(len(body.points)), body.fixed)
    load = loads[0, free].flatten()
    for factor in (0.0, 0.4, 3.0):
        other = {"end": Springs(3e4 * factor, 1e4 * factor)} if factor else {}
        exact = Equilibria(body, LAWS["Neo-Hookean"], springs=other).solve(loads)
        found = network.with_springs({"end": factor}).linearised(load).q.numpy()
        truth = exact.displacement[0].numpy()[free].ravel()
        np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-7 * np.abs(truth).max())
    at = network.with_springs({"end": 0.7}).linearised(load)
    ends = [network.with_springs({"end": 0.7 + sign * 1e-4}).linearised(load, at).q for sign in (1.0, -1.0)]
    difference = (ends[0] - ends[1]) / 2e-4
    pushed = at.jvp_parameters({}, {"end": 1.0})
    torch.testing.assert_close(pushed, difference, rtol=0.0, atol=1e-5 * float(difference.abs().max()))
    assert float(pushed.abs().max()) > 1e-3
    again = GalerkinNetwork.from_state_dict(network.state_dict())
    assert again.springs == ("end",)
    torch.testing.assert_close(again.with_springs({"end": 0.7}).linearised(load).q, at.q)
    former = dict(network.state_dict())
    former["support"] = network.support
    assert bool((GalerkinNetwork.from_state_dict(former).support == network.support).all())
    for wrong, words in (({"side": 2.0}, r"expected names among \['end'\], got 'side'"), ({"end": -1.0}, "at least 0")):
        with pytest.raises(ValueError, match=words):
            network.with_springs(wrong)


def test_derivatives_pass_the_taylor_test_and_are_symmetric(bar: Body, rng: np.random.Generator) -> None:
    network = whole_span(bar, "Neo-Hookean")
    load = some_loads(bar, 1, 12.0, rng)[0, np.setdiff1d(np.arange(len(bar.points)), bar.fixed)].flatten()
    way = 0.2 * load.norm() * torch.nn.functional.normalize(torch.from_numpy(rng.standard_normal(len(load))), dim=0)
    state = network.linearised(load)
    rate = state.jvp(way[:, None])[:, 0]
    missed = [float((network.linearised(load + h * way).values - state.values - h * rate).norm()) for h in (0.5, 0.25)]
    assert np.log2(missed[0] / missed[1]) > 1.8
    other = torch.from_numpy(rng.standard_normal(len(load)))
    assert float(other @ rate) == pytest.approx(float(state.vjp(other) @ way), rel=1e-9)


def test_a_state_nearby_changes_the_way_and_not_the_end(bar: Body, rng: np.random.Generator) -> None:
    network = whole_span(bar, "Neo-Hookean")
    free = np.setdiff1d(np.arange(len(bar.points)), bar.fixed)
    load, far = (each[free].flatten() for each in some_loads(bar, 2, 12.0, rng))
    cold = network.linearised(load).values
    for near in (network.linearised(0.9 * load), network.linearised(far), network.linearised(0.0 * load)):
        torch.testing.assert_close(network.linearised(load, near).values, cold, rtol=0.0, atol=1e-8)
    rounded = network.rounded().linearised(load).values
    assert 0.0 < float((rounded - cold).abs().max()) < 1e-5 * float(cold.abs().max())


def test_from_rest_it_begins_where_the_second_order_leads(bar: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same states, by fewer tangents."""
    network, made = whole_span(bar, "Neo-Hookean"), []
    free = np.setdiff1d(np.arange(len(bar.points)), bar.fixed)
    stiffness = GalerkinNetwork.stiffness
    monkeypatch.setattr(GalerkinNetwork, "stiffness", lambda *given: made.append(1) or stiffness(*given))
    found = {}
    for name, expanded in (("second", _Search._expanded), ("none", lambda self, factor: iter(()))):
        monkeypatch.setattr(_Search, "_expanded", expanded)
        made.clear()
        loads = some_loads(bar, 4, 8.0, np.random.default_rng(3))
        found[name] = torch.stack([network.linearised(load[free].flatten()).values for load in loads]), len(made)
    torch.testing.assert_close(found["second"][0], found["none"][0], rtol=0.0, atol=1e-8)
    assert found["second"][1] < found["none"][1]


def test_at_rest_nothing_is_corrected(bar: Body) -> None:
    network = whole_span(bar, "Neo-Hookean")
    state = network.linearised(torch.zeros(len(network.at_rest), dtype=torch.float64))
    assert float(state.values.abs().max()) == 0.0
    assert float(state.jvp(torch.eye(len(network.at_rest), dtype=torch.float64)).abs().max()) < 1e-12


def test_a_bar_that_is_pressed_buckles() -> None:
    """Straight it is balanced, too, but gives way: that is no state, and has no derivative."""
    straight = beam((10, 1, 1), (1.0, 0.1, 0.1), "hexahedron")
    network = whole_span(straight, "Neo-Hookean")
    free, tip = np.setdiff1d(np.arange(len(straight.points)), straight.fixed), straight.node_sets["tip"].copy()
    found = []
    for push in (0.1, 0.2, 0.3):  # newtons; the second is near where it gives way, and may not be found
        load = torch.zeros(len(straight.points), 3, dtype=torch.float64)
        load[tip, 0] = -push / len(tip)
        try:
            state = network.linearised(load[free].flatten())
        except NotConverged:
            continue
        found.append(push)
        stiffness = torch.from_numpy(network.stiffness(state.q.numpy()))
        assert float(torch.linalg.eigvalsh(stiffness).min()) > 0.0
        assert (float(state.q.reshape(-1, 3)[:, 1:].abs().max()) > 0.1) == (push > 0.15)
        unit = torch.eye(len(stiffness), dtype=torch.float64)
        inverse = state.jvp(unit) + torch.linalg.inv(network.at_rest)
        torch.testing.assert_close(stiffness @ inverse, unit, rtol=0.0, atol=1e-5)
    assert found[0] == 0.1 and found[-1] == 0.3


def test_what_has_no_equilibrium_says_so(bar: Body) -> None:
    network = whole_span(bar, "Saint Venant-Kirchhoff" if "Saint Venant-Kirchhoff" in KNOWN else KNOWN[1])
    free = np.setdiff1d(np.arange(len(bar.points)), bar.fixed)
    crushing = torch.zeros(len(bar.points), 3, dtype=torch.float64)
    crushing[:, 0] = -1e5
    with pytest.raises(NotConverged, match="try a smaller one"):
        network.linearised(crushing[free].flatten())


# ---------------------------------------------------------------------- as an architecture


PLAN_SAMPLES = {"train": 24, "validation": 4, "test": 12}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DataSet]:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    from softtwin.reference.generate import Plan, generate

    body = beam((10, 3, 3), (0.6, 0.15, 0.15))
    plan = Plan(loads=LoadPlan(modes=6, displacement=0.15), samples=PLAN_SAMPLES, block=4)
    made = generate(tmp_path_factory.mktemp("galerkin") / "data.zarr", body, plan)
    assert made is not None
    yield made


SMALL = Galerkin(modes=12, curved=8, derivatives=20, own=8, cells=120)


@pytest.mark.fenicsx
def test_it_learns_nothing_and_is_near(data: DataSet) -> None:
    """Of equilibria that bend a beam by its length's quarter, with and without some of its own to extend its basis."""
    with_own = evaluate(train(data, TrainingPlan(SMALL)), data).relative_error
    alone = evaluate(train(data, TrainingPlan(replace(SMALL, own=0))), data).relative_error
    samples = data.samples("test")
    linear = data.response.apply(samples.forces) - samples.displacements
    missed = np.linalg.norm(linear, axis=(1, 2)) / np.linalg.norm(samples.displacements, axis=(1, 2))
    assert alone.median < 0.2 * np.median(missed) and alone.median < 0.02
    assert with_own.median < 0.01 and with_own.p95 < 0.04
    more = replace(SMALL, modes=16, curved=12, derivatives=60, own=24, cells=10_000, tolerance=1e-6)
    assert evaluate(train(data, TrainingPlan(more)), data).relative_error.median < 0.5 * with_own.median


@pytest.mark.fenicsx
def test_it_is_saved_and_read_as_it_was(data: DataSet, tmp_path) -> None:
    made, again = (train(data, TrainingPlan(SMALL)) for _ in range(2))
    save(made, tmp_path / "twin")
    read = load(tmp_path / "twin", data.body)
    forces = np.zeros_like(data.body.points)
    forces[data.response.loaded] = data.samples("test").forces[0]
    for other in (again, read):
        assert np.array_equal(other.solve(forces).displacement, made.solve(forces).displacement)
    assert read.card["architecture"] == "galerkin" and read.card["training"]["steps"] == 0
    near = made.propose(forces)
    np.testing.assert_allclose(near, made.solve(forces).displacement, atol=1e-6 * np.abs(near).max())
    for as_graph in (lambda: export(made, tmp_path / "graphs"), lambda: FastSurrogate(made, "cpu")):
        with pytest.raises(ValueError, match="got galerkin, which searches for equilibria and is no graph"):
            as_graph()
    assert not (tmp_path / "graphs").exists()


@pytest.mark.fenicsx
def test_typical_loads_are_as_large_as_those_of_the_training(data: DataSet) -> None:
    loads = typical_loads(data, data.samples("train"))
    peaks = np.linalg.norm(data.response.apply(loads), axis=2).max(axis=1)
    known = np.linalg.norm(data.response.apply(data.samples("train").forces), axis=2).max()
    assert np.isfinite(loads).all() and peaks.max() <= known * (1.0 + 1e-9) and peaks.max() > 0.8 * known


@pytest.mark.fenicsx
def test_what_it_cannot_do_is_refused(data: DataSet, tmp_path) -> None:
    with pytest.raises(ValueError, match="galerkin, which has no loss"):
        train(data, TrainingPlan(SMALL, physics=Physics(energy=0.1)))
    from softtwin.reference.generate import Plan, generate

    cord = Ligament(np.array([0.6, 0.15, 0.15]), np.array([0.7, 0.2, 0.2]), 20.0)
    plan = Plan(loads=LoadPlan(modes=4, displacement=0.05), samples={"train": 2, "validation": 2, "test": 2}, block=2)
    held = generate(tmp_path / "held.zarr", data.body, replace(plan, springs={"cord": cord}))
    assert held is not None
    with pytest.raises(ValueError, match=r"ligaments \['cord'\]"):
        train(held, TrainingPlan(SMALL))


def test_settings_out_of_range_are_refused() -> None:
    for wrong in ({"modes": 0}, {"derivatives": -1}, {"tolerance": 0.0}, {"cells": 1.5}, {"own": 2.5}):
        with pytest.raises(ValueError, match=rf"Galerkin.{next(iter(wrong))}"):
            Galerkin(**wrong)
    plane = Body(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([[0, 1, 2]]), {"fixed": np.array([0, 1])})
    with pytest.raises(ValueError, match="a body in space"):
        Galerkin().check(plane)


# ---------------------------------------------------------------------- with another tissue


def _ball(points: np.ndarray, radius: float) -> Surface:
    """An octahedron around the middle of a body."""
    middle = points.mean(axis=0)
    corners = middle + radius * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [(i, j, k) for i in (0, 3) for j in (1, 4) for k in (2, 5)]
    turned = [face if np.linalg.det(corners[list(face)] - middle) > 0 else face[::-1] for face in faces]
    return Surface(corners, np.array(turned))


@pytest.fixture(scope="module")
def varied(data: DataSet, tmp_path_factory: pytest.TempPathFactory) -> tuple[DataSet, Surrogate]:
    from softtwin.reference.generate import Plan, generate

    body = replace(data.body, inner={"lump": _ball(data.body.points, 0.09)})
    plan = Plan(loads=LoadPlan(modes=6, displacement=0.15), samples=PLAN_SAMPLES, block=4)
    made = generate(tmp_path_factory.mktemp("varied") / "data.zarr", body, plan)
    assert made is not None
    return made, train(made, TrainingPlan(replace(SMALL, vary=VARY)))


VARY = {"poisson-ratio": (0.38, 0.48), "young-modulus@lump": (5e3, 4e4)}


def _tissue(data: DataSet, ratio: float, modulus: float) -> dict[str, Any]:
    moduli = np.full(len(data.body.cells), 5e3)
    moduli[cells_inside(data.body, "lump")] = modulus
    return {"poisson_ratio": ratio, "young_modulus": moduli}


@pytest.mark.fenicsx
def test_states_are_those_of_another_tissue(varied: tuple[DataSet, Surrogate]) -> None:
    data, surrogate = varied
    missed, unlike = [], []
    for number, (ratio, modulus) in enumerate(((0.39, 3e4), (0.475, 3e4), (0.47, 6e3))):
        tissue = _tissue(data, ratio, modulus)
        forces = np.zeros_like(data.body.points)
        forces[data.response.loaded] = data.samples("test").forces[number]
        exact = Equilibria(data.body, NeoHookean(tissue["young_modulus"], ratio)).solve(forces[None])
        truth = exact.displacement[0].numpy()
        found = surrogate.solve(forces, inputs=Inputs(parameters=tissue)).displacement
        missed.append(np.linalg.norm(found - truth) / np.linalg.norm(truth))
        unlike.append(np.linalg.norm(surrogate.solve(forces).displacement - truth) / np.linalg.norm(truth))
    assert max(missed) < 0.03 and np.median(missed) < 0.015
    assert np.median(unlike) > 3.0 * np.median(missed)


@pytest.mark.fenicsx
def test_its_derivatives_by_the_tissue_are_those_of_differences(varied: tuple[DataSet, Surrogate]) -> None:
    data, surrogate = varied
    forces = np.zeros_like(data.body.points)
    forces[data.response.loaded] = data.samples("test").forces[0]
    at = _tissue(data, 0.44, 2e4)
    inside = np.isin(np.arange(len(data.body.cells)), cells_inside(data.body, "lump"))
    changes = [Change(parameters={"poisson_ratio": 1e-3}), Change(parameters={"young_modulus": 200.0 * inside})]
    changes.append(Change(forces=0.01 * forces, parameters={"poisson_ratio": 5e-4}))
    state = surrogate.solve(forces, inputs=Inputs(parameters=at))
    for change, pushed in zip(changes, state.jvp_inputs(changes).T, strict=True):
        ends = []
        for sign in (1.0, -1.0):
            values = {
                name: np.asarray(v) + sign * np.asarray(change.parameters.get(name, 0.0)) for name, v in at.items()
            }
            load = forces if change.forces is None else forces + sign * np.asarray(change.forces)
            ends.append(surrogate.solve(load, inputs=Inputs(parameters=values)).displacement.ravel())
        difference = 0.5 * (ends[0] - ends[1])
        np.testing.assert_allclose(pushed, difference, rtol=0.0, atol=2e-3 * np.abs(difference).max())
        assert np.abs(difference).max() > 1e-6


@pytest.mark.fenicsx
def test_a_stiffer_organ_under_larger_loads_moves_alike(varied: tuple[DataSet, Surrogate]) -> None:
    data, surrogate = varied
    known = with_domain(surrogate, data)
    forces = np.zeros_like(data.body.points)
    forces[data.response.loaded] = data.samples("test").forces[1]
    own = known.solve(forces)
    stiffer = known.solve(3.0 * forces, inputs=Inputs(parameters={"young_modulus": 15e3}))
    np.testing.assert_allclose(stiffer.displacement, own.displacement, rtol=0.0, atol=1e-9)
    assert stiffer.distance == pytest.approx(own.distance)
    change = Change(forces=0.3 * forces, parameters={"young_modulus": 1500.0})
    assert np.abs(stiffer.jvp_inputs([change])).max() < 1e-9 * np.abs(own.displacement).max() + 1e-12
    np.testing.assert_allclose(stiffer.vjp(own.displacement), own.vjp(own.displacement) / 3.0, rtol=0.0, atol=1e-9)


@pytest.mark.fenicsx
def test_how_far_out_a_tissue_lies_is_said(varied: tuple[DataSet, Surrogate]) -> None:
    data, surrogate = varied
    known = with_domain(surrogate, data)
    forces = np.zeros_like(data.body.points)
    inside = known.solve(forces, inputs=Inputs(parameters=_tissue(data, 0.47, 2e4))).extrapolation_ratio
    beyond = known.solve(forces, inputs=Inputs(parameters=_tissue(data, 0.495, 2e4))).extrapolation_ratio
    assert inside is not None and beyond is not None and inside <= 1.0 < beyond
    stiff = known.solve(forces, inputs=Inputs(parameters=_tissue(data, 0.45, 6e4))).extrapolation_ratio
    assert stiff is not None and stiff > 1.0


@pytest.mark.fenicsx
def test_a_tissue_that_it_cannot_be_is_refused(varied: tuple[DataSet, Surrogate], data: DataSet) -> None:
    _, surrogate = varied
    forces = np.zeros_like(surrogate.body.points)
    with pytest.raises(ValueError, match=r"parameters among \['poisson_ratio', 'young_modulus'\]"):
        surrogate.solve(forces, inputs=Inputs(parameters={"c1": 3.0}))
    for wrong_tissue, words in (
        ({"poisson_ratio": 0.6}, "expected a number in"),
        ({"young_modulus": np.full(len(surrogate.body.cells) + 7, 5e3)}, "one for each of the"),
        ({"young_modulus": -5e3}, "expected a positive number"),
        ({"poisson_ratio": np.nan}, "expected a number in"),
    ):
        with pytest.raises(ValueError, match=words):
            surrogate.solve(forces, inputs=Inputs(parameters=wrong_tissue))
    with pytest.raises(ValueError, match="finite"):
        surrogate.solve(forces, inputs=Inputs(forces=np.full_like(forces, np.nan)))
    with pytest.raises(ValueError, match=r"expected names among \[\], got 'end'"):
        surrogate.solve(forces, inputs=Inputs(springs={"end": 2.0}))
    with pytest.raises(ValueError, match=r"expected names among \[\], got 'end'"):
        surrogate.solve(forces).jvp_inputs([Change(springs={"end": 2.0})])
    with pytest.raises(ValueError, match="got displacements"):
        surrogate.solve(forces, inputs=Inputs(displacement={"end": np.zeros((1, 3))}))
    with pytest.raises(ValueError, match="got displacements"):
        surrogate.solve(forces).jvp_inputs([Change(displacement=forces)])
    network = train(data, TrainingPlan(Reduced(modes=4, width=8, depth=1), epochs=1))
    assert not network.takes_inputs and surrogate.takes_inputs
    with pytest.raises(ValueError, match="the galerkin architecture takes them"):
        network.solve(forces, inputs=Inputs(parameters={"poisson_ratio": 0.4}))
    with pytest.raises(ValueError, match="expected the springs that it has learned"):
        network.solve(forces, inputs=Inputs(springs={"end": 2.0}))
    with pytest.raises(ValueError, match="the one tissue that is known"):
        network.solve(forces).jvp_inputs([Change(parameters={"poisson_ratio": 0.01})])
    with pytest.raises(ValueError, match="expected an inner surface"):
        Galerkin(vary={"young-modulus@tumor": (1e3, 1e4)}).check(surrogate.body)
    with pytest.raises(ValueError, match="take more cells, or a smaller tolerance"):
        train(data, TrainingPlan(replace(SMALL, cells=1)))
    for wrong, words in (
        ({"density": (1.0, 2.0)}, "expected poisson-ratio, young-modulus, young"),
        ({"poisson-ratio@lump": (0.4, 0.45)}, "expected poisson-ratio, young-modulus, young"),
        ({"springs": (0.5, 2.0)}, r"springs@SURFACE, got 'springs'"),
        ({"springs@bed": (1.5, 2.0)}, r"a range of springs@bed that holds 1, .* got \[1\.5, 2\.0\]"),
        ({"poisson-ratio": (0.48, 0.4)}, "two growing positive numbers"),
        ({"poisson-ratio": (0.4, 0.6)}, "below 0.5"),
    ):
        with pytest.raises(ValueError, match=words):
            Galerkin(vary=wrong)
    with pytest.raises(ValueError, match=r"holds what the tissue has, 0\.45 to 0\.45"):
        train(data, TrainingPlan(replace(SMALL, vary={"poisson-ratio": (0.3, 0.4)})))
    with pytest.raises(ValueError, match="expected an inner surface"):
        train(data, TrainingPlan(replace(SMALL, vary={"young-modulus@nothing": (1e3, 1e4)})))
    with pytest.raises(ValueError, match=r"expected springs@ one of \[\], got 'springs@bed'"):
        train(data, TrainingPlan(replace(SMALL, vary={"springs@bed": (0.5, 2.0)})))
