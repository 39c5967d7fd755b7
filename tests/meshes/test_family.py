"""A family of organs: each the same for its number, sound, of its form, and held on a part of its surface."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.family import blend, member
from softtwin.meshes.metrics import mesh_quality


def test_members_are_sound_and_of_many_forms() -> None:
    found = [member(number) for number in range(24)]
    assert {each.form for each in found} == {"round", "slender", "flat", "box"}
    for each in found:
        body = each.body
        quality = mesh_quality(body)
        assert quality.min_radius_ratio >= 0.049 and quality.min_scaled_jacobian > 0.0
        assert 250 <= len(body.points) <= 4000
        assert 0.04 <= len(body.fixed) / len(body.boundary_nodes) <= 0.26
        assert np.isin(body.fixed, body.boundary_nodes).all() and len(body.surfaces["observed"]) > 10
        assert 0.40 <= each.poisson_ratio <= 0.47 and 2e3 <= each.young_modulus <= 1e4
        extents = np.sort(np.ptp(body.points, axis=0))
        assert extents[0] > 0.03 and extents[2] < 0.35
        if each.form == "slender":
            assert extents[2] > 1.5 * extents[1] or extents[2] > 1.5 * extents[0]


def test_a_number_is_an_organ() -> None:
    one, again, other = member(5), member(5), member(6)
    assert np.array_equal(one.body.points, again.body.points) and np.array_equal(one.body.fixed, again.body.fixed)
    assert one.poisson_ratio == again.poisson_ratio != other.poisson_ratio
    assert not np.array_equal(member(5, seed=1).body.points, one.body.points)
    few, many = len(member(5, nodes=200).body.points), len(member(5, nodes=2000).body.points)
    assert few < 500 and 1500 < many < 3500


def test_deformations_are_no_boxes() -> None:
    """The surface of a round one is curved: a box of its extents has a third more volume or so."""
    for number in range(24):
        found = member(number)
        share = found.body.volume / float(np.prod(np.ptp(found.body.points, axis=0)))
        assert share < 0.95
        if found.form == "round":
            assert share < 0.75


def test_what_is_no_member_is_refused() -> None:
    with pytest.raises(ValueError, match=r"member\.number: expected 0 or more, got -1"):
        member(-1)
    with pytest.raises(ValueError, match=r"member\.nodes: expected at least 100, got 20"):
        member(1, nodes=20)


def test_tumours_are_stiffer_balls_of_cells() -> None:
    found = [member(number) for number in range(24)]
    assert {len(each.tumours) for each in found} == {0, 1, 2}
    for each in found:
        moduli, middles = each.young_moduli, each.body.points[each.body.cells].mean(axis=1)
        inside = np.zeros(len(moduli), dtype=bool)
        for tumour in each.tumours:
            inside[tumour.cells] = True
            assert len(tumour.cells) and 2.0 <= tumour.stiffness <= 10.0 and tumour.radius <= 0.02
            off = np.linalg.norm(middles - tumour.centre, axis=1)
            assert off[tumour.cells].max() <= tumour.radius < np.delete(off, tumour.cells).min()
        np.testing.assert_allclose(moduli[~inside], each.young_modulus)
        assert (moduli[inside] >= 1.99 * each.young_modulus).all()


def test_blends_lie_between_given_surfaces() -> None:
    """Sound, each the same for its number, and as large as one would expect between the two."""
    pytest.importorskip("gmsh", reason="gmsh is absent")
    pytest.importorskip("pyacvd", reason="pyacvd is absent")
    organs = [outside(member(number).body) for number in (0, 1, 2)]
    volumes = [each.volume for each in organs]
    for number in range(4):
        found = blend(number, organs, nodes=500)
        quality = mesh_quality(found.body)
        assert found.form == "blend" and quality.min_scaled_jacobian > 0.0
        assert 300 <= len(found.body.points) <= 900
        assert 0.6 * min(volumes) < found.body.volume < 1.4 * max(volumes)
        assert 0.04 <= len(found.body.fixed) / len(found.body.boundary_nodes) <= 0.26
    again = blend(3, organs, nodes=500)
    assert np.array_equal(again.body.points, found.body.points) and again.young_modulus == found.young_modulus


def outside(body: Body) -> Surface:
    vertices, local = np.unique(body.boundary, return_inverse=True)
    return Surface(body.points[vertices], local.reshape(-1, 3))


def test_what_is_no_blend_is_refused() -> None:
    one = outside(member(0).body)
    with pytest.raises(ValueError, match=r"blend\.surfaces: expected at least two, got 1"):
        blend(0, [one])
    with pytest.raises(ValueError, match=r"blend\.number: expected 0 or more, got -2"):
        blend(-2, [one, one])
