"""Known loads of a twin from its configuration: a weight that floats, and one that is known but for a factor."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.app.config import parse_config
from softtwin.app.scenario import Scenario, buoyancy
from softtwin.meshes.body import Body
from softtwin.meshes.export import Coordinates
from softtwin.meshes.metrics import nodal_volumes
from softtwin.meshes.shapes import beam, liver_phantom

WEIGHT = np.array([300.0, -500.0, 1962.0])
RAS = Coordinates("mm", "ras")


def scenario(**registration: object) -> Scenario:
    entries = {"model": "reference", "gravity": [0.0, -9.81, 0.0], **registration}
    return Scenario.of(parse_config({"material": {"density": 200.0}, "registration": entries}))


@pytest.fixture(scope="module", params=["phantom", "beam"])
def body(request: pytest.FixtureRequest) -> Body:
    return liver_phantom(0.02) if request.param == "phantom" else beam((5, 2, 3), (0.5, 0.1, 0.2))


def test_surroundings_carry_the_weight_and_turn_nothing(body: Body) -> None:
    """Archimedes: the pressure's net force is the weight's, and passes through the middle of the volume."""
    volumes, carried = nodal_volumes(body), buoyancy(body, WEIGHT)
    both = carried + volumes[:, None] * WEIGHT
    scale = np.linalg.norm(WEIGHT) * volumes.sum()
    np.testing.assert_allclose(both.sum(axis=0), 0.0, atol=1e-9 * scale)
    if body.kind.shape == "tetrahedron":  # a hexahedron's faces are not quite those of two triangles each
        turned = np.cross(body.points, both).sum(axis=0)
        np.testing.assert_allclose(turned, 0.0, atol=1e-9 * scale * body.size)


def test_the_weight_floats_where_the_surface_slides(body: Body) -> None:
    loading = scenario(forces="normal").loading(body, RAS)
    np.testing.assert_allclose(loading.body_force, [0.0, 200.0 * 9.81, 0.0])  # RAS to LPS turns the y axis
    wanted = buoyancy(body, np.array([0.0, 200.0 * 9.81, 0.0]))
    wanted[body.fixed] = 0.0
    np.testing.assert_allclose(loading.forces, wanted)
    assert scenario().loading(body, RAS).forces is None


@pytest.mark.parametrize("forces", ["normal", "unknown"])
def test_an_unknown_weight_is_no_part_of_what_is_known(body: Body, forces: str) -> None:
    unknown = scenario(forces=forces, parameters=["weight=0.4"])
    assert unknown.loading(body, RAS).body_force is None and unknown.loading(body, RAS).forces is None
    inputs = unknown.inputs(body, 2000.0, 0.3, RAS)
    assert inputs is not None
    known = scenario(forces=forces).loading(body, RAS)
    wanted = nodal_volumes(body)[:, None] * known.body_force + (0.0 if known.forces is None else known.forces)
    wanted[body.fixed] = 0.0
    np.testing.assert_allclose(inputs.forces(np.zeros(1)), wanted)
    np.testing.assert_allclose(inputs.forces(np.ones(1)), np.exp(0.4) * wanted)
