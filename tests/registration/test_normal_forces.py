"""Forces along the surface's normal alone, a weight known but for a factor: what holds by itself, what is found."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.metrics import nodal_volumes
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import LinearElastic
from softtwin.registration.options import expected_force, options_for
from softtwin.registration.parameters import nodal_forces as nodal_forces_module
from softtwin.registration.parameters.inputs import InputBlocks
from softtwin.registration.parameters.nodal_forces import nodal_forces, normal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.parameters.weight import Weight
from softtwin.registration.policy import ACCURACY
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar, prepare
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.equilibria_model import EquilibriaModel

Floats = NDArray[np.float64]
MODULUS, NOISE = 3000.0, 3e-4


@pytest.fixture(scope="module")
def block() -> Body:
    """A block that is held at one end, seen from all sides."""
    return beam((6, 4, 4), (0.3, 0.2, 0.2), "tetrahedron")


@pytest.fixture(scope="module")
def model(block: Body) -> EquilibriaModel:
    return EquilibriaModel(Equilibria(block, LinearElastic(MODULUS, 0.3)))


def area_vectors(body: Body) -> Floats:
    """A third of the area of the triangles about each node, outward, (n, 3)."""
    corners = body.points[body.boundary]
    found = np.zeros_like(body.points)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 6.0
    np.add.at(found, body.boundary.ravel(), np.repeat(areas, 3, axis=0))
    return found


def whole_cloud(body: Body, displacement: Floats, rng: np.random.Generator, count: int = 800) -> Floats:
    chosen = body.boundary[rng.integers(len(body.boundary), size=count)]
    points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), size=count), (body.points + displacement)[chosen])
    return points + NOISE * rng.standard_normal(points.shape)


def everywhere(model: EquilibriaModel, along: bool = True) -> Registrar:
    """Forces all over the surface, along its normal or in any direction."""
    return prepare(
        model,
        model.body.boundary_nodes,
        force_scale=expected_force(model.body, MODULUS),
        smoothness=0.05,
        options=options_for(model, True),
        along_normals=along,
    )


def test_each_nodes_force_is_along_its_normal(block: Body) -> None:
    forces = normal_forces(block, block.boundary_nodes, smoothness=0.05)
    normals = area_vectors(block)[forces.nodes]
    patterns = forces.patterns.reshape(len(forces.nodes), 3, -1)
    across = np.cross(patterns, normals[:, :, None], axisa=1, axisb=1)
    assert np.abs(across).max() < 1e-12 * np.abs(patterns).max()
    sizes = np.linalg.norm(patterns[:, :, 0], axis=1) / np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(sizes, sizes[0], rtol=1e-12)  # the first is one pressure all over
    assert not np.intersect1d(forces.nodes, block.fixed).size


def test_pressures_by_facing_are_of_one_size_whatever_faces_where(rng: np.random.Generator) -> None:
    normals = rng.standard_normal((50, 3))
    found = nodal_forces_module._by_facing(normals)
    np.testing.assert_allclose(np.square(found).sum(axis=1), 1.0)
    turned = nodal_forces_module._by_facing(normals @ np.linalg.qr(rng.standard_normal((3, 3)))[0])
    np.testing.assert_allclose(turned @ turned.T, found @ found.T, atol=1e-12)  # no axis is another than the others
    assert np.isfinite(nodal_forces_module._by_facing(np.zeros((1, 3)))).all()  # a node on which nothing can press


def test_what_differs_by_where_the_surface_faces_goes_on_unseen(
    block: Body, model: EquilibriaModel, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pressed more along one axis than along the others, seen from one side: the far side is found by that alone."""
    areas = area_vectors(block)
    facing = np.square(areas[:, 1]) / np.maximum(np.square(areas).sum(axis=1), 1e-300)
    is_free = ~np.isin(np.arange(len(block.points)), block.fixed)
    truth = model.solve(-((300.0 + 900.0 * facing) * is_free)[:, None] * areas).displacement
    cloud = whole_cloud(block, truth, rng, 2000)
    cloud = cloud[cloud[:, 1] > 0.1]
    hidden = block.points[:, 1] < 0.06
    errors = {}
    by_facing = nodal_forces_module._by_facing
    for part in (1.0, 1e-5):
        monkeypatch.setattr(nodal_forces_module, "_by_facing", lambda normals, part=part: part * by_facing(normals))
        registrar = everywhere(model)
        errors[part] = np.linalg.norm(registrar.register(cloud).displacement - truth, axis=1)[hidden].mean()
    known, unknown = errors.values()
    assert known < 0.5 * unknown and known < 0.15 * np.linalg.norm(truth[hidden], axis=1).mean()


@pytest.mark.parametrize("made", [normal_forces, nodal_forces])
def test_what_cannot_carry_force_is_refused_by_name(made, block: Body) -> None:
    with pytest.raises(ValueError, match=rf"{made.__name__}.nodes: expected nodes on the free boundary"):
        made(block, block.fixed)
    with pytest.raises(ValueError, match=rf"{made.__name__}.smoothness: expected a length of 0 m or more, got -1"):
        made(block, block.boundary_nodes, smoothness=-1.0)


def test_a_pressure_is_found_inside_too(block: Body, model: EquilibriaModel, rng: np.random.Generator) -> None:
    """A body pressed together from all sides, and a dent: forces of any direction slide along the surface, it does not.

    The error inside is that of places that no point of the cloud shows.
    """
    middle = block.points - [0.2, 0.2, 0.1]
    pressure = 900.0 + 400.0 * np.exp(-np.square(middle).sum(axis=1) / (2.0 * 0.06**2))
    is_free = ~np.isin(np.arange(len(block.points)), block.fixed)
    truth = model.solve(-(pressure * is_free)[:, None] * area_vectors(block)).displacement
    cloud = whole_cloud(block, truth, rng)
    assert np.linalg.norm(truth, axis=1).max() > 0.02
    errors = {}
    for along in (True, False):
        registrar = everywhere(model, along)
        found = registrar.register(cloud)
        errors[along] = np.linalg.norm(found.displacement - truth, axis=1)
        if along:
            inside = np.setdiff1d(np.arange(len(block.points)), block.boundary_nodes)
            assert errors[True][inside].mean() < 1e-3
            margins = found.camera_uncertainty.margin(confidence=0.95)
            assert np.mean((errors[True] < margins)[is_free]) > 0.9
    assert errors[True].mean() < 0.5 * errors[False].mean()


def test_a_pressures_size_is_known_and_its_search_begins_with_all_of_it(model: EquilibriaModel) -> None:
    """Unknown pose or not: what presses the body as a whole is not bounded, so that a few directions go far astray."""
    registrar = everywhere(model)
    posed = registrar.with_pose(PosePrior(Pose.identity(), model.body.points.mean(axis=0)))
    for made in (registrar, posed):
        assert made.setup.forces.scale.spread == 0.0
        assert made.options.localisation.leading >= made.setup.forces.size > ACCURACY.leading
        assert made.options.localisation.rounds == 0
    assert everywhere(model, along=False).setup.forces.scale.spread > 0.0


def test_points_anywhere_do_not_lead_a_pressures_search_astray(block: Body, model: EquilibriaModel) -> None:
    """About the edges of a body that has shrunk by far, a fifth of wrong points are more than its own."""
    is_free = ~np.isin(np.arange(len(block.points)), block.fixed)
    truth = model.solve(-2000.0 * is_free[:, None] * area_vectors(block)).displacement
    rng = np.random.default_rng(0)
    cloud, registrar = whole_cloud(block, truth, rng, 1000), everywhere(model)
    wrong, low, high = rng.choice(len(cloud), 200, replace=False), cloud.min(axis=0), cloud.max(axis=0)
    clean, reach = np.delete(cloud, wrong, axis=0), 0.2 * (high - low)
    cloud[wrong] = rng.uniform(low - reach, high + reach, (200, 3))
    found, wanted = registrar.register(cloud), registrar.register(clean)
    errors = [np.linalg.norm(each.displacement - truth, axis=1).mean() for each in (found, wanted)]
    assert errors[0] < 2.0 * errors[1]
    assert 0.15 < found.outliers < 0.25  # they count as what they are, though the search began without them


def test_a_weight_is_found_by_its_factor(block: Body, model: EquilibriaModel, rng: np.random.Generator) -> None:
    """Where nothing else acts, the factor is told to a few parts in a hundred, whatever was expected."""
    weight = nodal_volumes(block)[:, None] * np.array([0.0, 0.0, -2000.0])
    weight[block.fixed] = 0.0
    cloud = whole_cloud(block, model.solve(1.8 * weight).displacement, rng)
    inputs = InputBlocks(block, {"young_modulus": MODULUS, "poisson_ratio": 0.3}, (Weight(0.7, forces=weight),))
    registrar = prepare(model, None, force_scale=1.0, options=options_for(model, True), inputs=inputs)
    found = registrar.register(cloud)
    (known,) = found.estimates
    assert known.name == "weight" and known.value == pytest.approx(1.8, rel=0.03)
    assert known.interval[0] < 1.8 < known.interval[1]
    assert known.variance_reduction > 0.9
