"""The organ before gravity: forward and back on every kind of body, load, support; the fixed point; no such shape."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.grid import gridded
from softtwin.meshes.shapes import beam, liver_phantom
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import IncompressibleNeoHookean, Material, MooneyRivlin, NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.problem import Problem, Springs
from softtwin.reference.unloaded import moved_body, unloaded

WEIGHT = 1060.0 * 9.81  # N/m^3
SIZE = (0.3, 0.1, 0.1)
NEAR = 1e-8  # metres


def bar(cell: Literal["hexahedron", "tetrahedron"], quadratic: bool = False) -> Body:
    """A bar along x, with the surface of its end and of one side."""
    made = beam((5, 2, 2), SIZE, cell)
    made = made.quadratic() if quadratic else made
    x = made.points[made.boundary]
    surfaces = {
        "end": made.boundary[np.isclose(x[..., 0], SIZE[0]).all(axis=1)],
        "side": made.boundary[np.isclose(x[..., 2], made.points[:, 2].min()).all(axis=1)],
    }
    return Body(made.points, made.cells, made.node_sets, surfaces)


def back_again(body: Body, material: Material, load: Loading, **how: object) -> None:
    """What a load does to a body is taken for its scan: the body is found, and hangs as it did."""
    with Problem(body, material, **how) as problem:  # type: ignore[arg-type]
        loaded = problem.solve(load)
    assert np.linalg.norm(loaded.displacement, axis=1).max() > 0.02 * body.size, "expected a load that does something"
    scanned = moved_body(body, loaded.displacement)
    found = unloaded(scanned, material, load, **how)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.body.points, body.points, atol=NEAR)
    np.testing.assert_allclose(found.displacement, loaded.displacement, atol=NEAR)
    assert found.gap == 0.0
    assert found.residual < 1e-5
    assert found.negative_pivots == loaded.negative_pivots


@pytest.mark.parametrize(
    ("cell", "quadratic"), [("tetrahedron", False), ("hexahedron", False), ("tetrahedron", True), ("hexahedron", True)]
)
def test_weight_is_taken_off_whatever_the_cells(cell: Literal["hexahedron", "tetrahedron"], quadratic: bool) -> None:
    weight = np.array([0.0, 0.3 * WEIGHT, -0.2 * WEIGHT])
    back_again(bar(cell, quadratic), NeoHookean(2e5, 0.45), Loading(body_force=weight), quadrature=4)


@pytest.mark.parametrize("material", [MooneyRivlin(3e4, 1e4, 5e5), IncompressibleNeoHookean.from_elastic(2e5)])
def test_and_whatever_the_law(material: Material) -> None:
    """A mixed one, whose pressure is an unknown, too."""
    back_again(
        bar("tetrahedron", quadratic=True), material, Loading(body_force=[0.0, 0.0, -0.3 * WEIGHT]), quadrature=4
    )


@pytest.mark.parametrize(
    "load",
    [
        Loading(pressure={"side": 500.0}),
        Loading(traction={"end": [100.0, 0.0, -150.0]}),
        Loading(displacement={"tip": [0.02, 0.01, -0.03]}),
        Loading(body_force=[0.0, 0.0, -1000.0], pressure={"boundary": 700.0}, traction={"end": [0.0, 200.0, 0.0]}),
    ],
    ids=["pressure", "traction", "moved", "several"],
)
def test_and_whatever_acts(load: Loading) -> None:
    held = {"fixed": "xyz", **dict.fromkeys(load.displacement, "xyz")}
    back_again(bar("tetrahedron"), NeoHookean(2e4, 0.4), load, held=held)


def test_nodal_forces_are_taken_off() -> None:
    body = bar("hexahedron")
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"], 2] = 0.1
    back_again(body, NeoHookean(2e4, 0.4), Loading(forces=forces))


@pytest.mark.parametrize("springs", [Springs(2e4, 1e4), Springs(normal=4e4)], ids=["both ways", "normal"])
def test_springs_are_slack_on_the_unloaded_body(springs: Springs) -> None:
    load = Loading(body_force=[0.0, 0.0, -3000.0], traction={"end": [200.0, 0.0, 0.0]})
    back_again(bar("tetrahedron"), NeoHookean(1e4, 0.4), load, springs={"side": springs})


def test_a_section_in_plane_strain() -> None:
    x, y = np.meshgrid(np.linspace(0.0, 0.3, 9), np.linspace(0.0, 0.1, 4), indexing="ij")
    numbers = np.arange(36).reshape(9, 4)
    cells = np.stack([numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]], axis=-1).reshape(-1, 4)
    body = Body(np.column_stack([x.ravel(), y.ravel()]), cells, {"fixed": numbers[0]})
    back_again(body, NeoHookean(2e5, 0.4), Loading(body_force=[0.0, -0.5 * WEIGHT]))


def test_what_the_organ_carries_goes_back_with_it() -> None:
    """Vessels inside, and the skin of a sparse grid."""
    phantom = liver_phantom()
    inner = Surface(0.2 * phantom.points + 0.8 * phantom.points.mean(axis=0), phantom.boundary)
    body = gridded(phantom.with_inner(vessel=inner), 0.02)
    material, load = NeoHookean(2e4, 0.4), Loading(body_force=[0.0, 0.0, -0.5 * WEIGHT])
    back_again(body, material, load)
    with Problem(body, material) as problem:
        scanned = moved_body(body, problem.solve(load).displacement)
    found = unloaded(scanned, material, load).body
    assert found.skin is not None and body.skin is not None and scanned.skin is not None
    np.testing.assert_allclose(found.skin.points, body.skin.points, atol=1e-6)
    np.testing.assert_allclose(found.inner["vessel"].points, inner.points, atol=1e-6)
    assert np.abs(scanned.inner["vessel"].points - inner.points).max() > 1e-3


def test_the_fixed_point_finds_the_same_body() -> None:
    body, material = bar("tetrahedron"), NeoHookean(2e5, 0.45)
    load = Loading(body_force=[0.0, 0.0, -0.3 * WEIGHT])
    newton = unloaded(body, material, load)
    other = unloaded(body, material, load, method="fixed point")
    assert np.linalg.norm(newton.displacement, axis=1).max() > 5e-3
    assert 0.0 < other.gap < 1e-6
    np.testing.assert_allclose(other.body.points, newton.body.points, atol=1e-6)


@pytest.mark.parametrize("method", ["newton", pytest.param("fixed point", marks=pytest.mark.slow)])
def test_where_there_is_no_such_body_it_is_said(method: Literal["newton", "fixed point"]) -> None:
    """A slender bar that is straight under its weight would have to be coiled without it."""
    body, load = beam((12, 2, 2), (1.0, 0.1, 0.1), "tetrahedron"), Loading(body_force=[0.0, 0.0, -WEIGHT])
    with pytest.raises(NotConverged, match=r"no stress-free shape .* one for \d+\.\d % of the load") as refused:
        unloaded(body, NeoHookean(3000.0, 0.45), load, method=method)
    assert 0.0 <= refused.value.load_factor < 1.0


def test_another_method_is_refused() -> None:
    with pytest.raises(ValueError, match=r"unloaded\.method: expected one of .* got 'picard'"):
        unloaded(bar("tetrahedron"), NeoHookean(1e4, 0.4), Loading(), method="picard")  # type: ignore[arg-type]


def test_no_load_changes_nothing() -> None:
    body = bar("tetrahedron")
    found = unloaded(body, NeoHookean(1e4, 0.4), Loading())
    np.testing.assert_array_equal(found.body.points, body.points)
