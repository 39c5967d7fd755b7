"""A family of organs: each the same for its number, sound, of its form, and held on a part of its surface."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.family import member
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
