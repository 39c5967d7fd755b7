"""A verdict is the worst of its checks: each says what it found, its level, and its chance where a law is known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from softtwin.meshes.body import Body
from softtwin.registration.checks import _log_normal
from softtwin.registration.expectations import Expectations
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar
from softtwin.registration.result import Registration
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Check, Code, Judgement, Verdict, checked, largest_normal

from .conftest import Cantilever, cloud_on, tip_forces

GUIDE = (Path(__file__).parents[2] / "docs" / "registration.md").read_text()


@pytest.fixture(scope="module")
def found(body: Body) -> Registration:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    registrar = Registrar(Cantilever(body, learned=2.0), SurfaceDistance(body, body.surfaces["observed"]), forces)
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    return registrar.register(cloud_on(body, truth, 400, np.random.default_rng(3), 1e-3))


def by_code(judgement: Judgement) -> dict[Code, Check]:
    return {check.code: check for check in judgement.checks}


def test_an_accepted_result_shows_what_it_passed(found: Registration) -> None:
    checks = by_code(found.judgement)
    wanted = {Code.CONVERGENCE, Code.MISFIT, Code.SPATIAL_CORRELATION, Code.INFORMATION, Code.MOVEMENT, Code.LOAD}
    assert wanted <= checks.keys() and all(check.is_passed and not check.reason for check in checks.values())
    assert checks[Code.POINT_COUNT].statistic == 400 and checks[Code.POINT_COUNT].is_minimum
    assert checks[Code.MISFIT].statistic == pytest.approx(1e-3, rel=0.2)
    moved = np.linalg.norm(found.state.displacement, axis=1).max()
    assert checks[Code.MOVEMENT].statistic == pytest.approx(moved)
    assert checks[Code.CONVERGENCE].statistic < 0.2


@pytest.mark.parametrize(
    ("statistic", "is_minimum", "verdict"),
    [
        (1.0, False, Verdict.ACCEPTED),
        (1.1, False, Verdict.DOUBTFUL),
        (2.1, False, Verdict.REFUSED),
        (np.nan, False, Verdict.DOUBTFUL),
        (1.0, True, Verdict.ACCEPTED),
        (0.9, True, Verdict.DOUBTFUL),
    ],
)
def test_levels(statistic: float, is_minimum: bool, verdict: Verdict) -> None:
    made = checked(Code.LOAD, statistic, 1.0, "too much", refused=None if is_minimum else 2.0, is_minimum=is_minimum)
    assert made.verdict is verdict and made.reason == ("" if verdict is Verdict.ACCEPTED else "too much")


def test_the_worst_decides_and_the_gravest_reason_comes_first() -> None:
    passed = Check(Code.LOAD, Verdict.ACCEPTED, 0.5, 1.2)
    slow = Check(Code.CONVERGENCE, Verdict.DOUBTFUL, 1.0, None, reason="slow")
    far = Check(Code.MISFIT, Verdict.REFUSED, 1.0, 0.1, reason="far")
    bent = Check(Code.LINEAR_LAW, Verdict.DOUBTFUL, 0.1, 0.03, reason="bent")
    judged = Judgement.of((slow, passed, bent, far))
    assert judged.verdict is Verdict.REFUSED and judged.reasons == ("far", "slow", "bent")
    assert judged.checks == (slow, passed, bent, far)
    assert Judgement.of((bent, far, slow), first=Code.CONVERGENCE).reasons == ("slow", "far", "bent")
    assert Judgement.of((passed,)) == Judgement(Verdict.ACCEPTED, (), (passed,))


def test_a_check_more_makes_nothing_better() -> None:
    passed = Check(Code.LOAD, Verdict.ACCEPTED, 0.5, 1.2)
    bent = Check(Code.LINEAR_LAW, Verdict.DOUBTFUL, 0.1, 0.03, reason="bent")
    accepted, refused = Judgement(Verdict.ACCEPTED), Judgement(Verdict.REFUSED, ("far",))
    assert accepted.with_check(bent) == Judgement(Verdict.DOUBTFUL, ("bent",), (bent,))
    assert refused.with_check(bent) == Judgement(Verdict.REFUSED, ("far", "bent"), (bent,))
    assert refused.with_check(passed) == Judgement(Verdict.REFUSED, ("far",), (passed,))


def test_figures_leave_out_what_is_empty() -> None:
    plain = Check(Code.LOAD, Verdict.ACCEPTED, 0.0, 1.2)
    assert plain.figures() == {"code": "load", "verdict": "accepted", "statistic": 0.0, "level": 1.2}
    full = replace(plain, unit="m", is_minimum=True, law="normal", p_value=0.0, subject="tip", reason="why")
    assert full.figures().keys() == {
        "code", "verdict", "statistic", "level", "unit", "is_minimum", "law", "p_value", "subject", "reason"
    }  # fmt: skip


def test_chances_are_those_of_draws(rng: np.random.Generator) -> None:
    draws = np.abs(rng.standard_normal((200_000, 6))).max(axis=1)
    for value in (1.0, 2.0, 3.0):
        share = float((draws > value).mean())
        assert largest_normal(value, 6)[1] == pytest.approx(share, abs=4.0 * np.sqrt(share / len(draws)))
    prior = LogNormalPrior(1e-3, 0.5)
    law = _log_normal(2e-3, prior)
    assert law is not None and law[1] == pytest.approx(norm.sf(np.log(2.0) / 0.5))
    assert _log_normal(2e-3, LogNormalPrior(1e-3, 0.0)) is None


def test_the_guide_names_every_check() -> None:
    table = GUIDE[GUIDE.index("|check|looks at|") : GUIDE.index("An accepted frame can still be wrong")]
    assert set(re.findall(r"^\|`(\w+)`", table, flags=re.M)) == {code.value for code in Code}


def test_expectations_that_were_given_stay_with_a_pose(body: Body, found: Registration) -> None:
    strict = Expectations(noise=1e-3, systematic=1e-3, movement=0.01)
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    observed = SurfaceDistance(body, body.surfaces["observed"])
    made = Registrar(Cantilever(body, learned=2.0), observed, forces, expectations=strict)
    camera = PosePrior(Pose.identity(), body.points.mean(axis=0), 0.1, 0.01)
    assert made.with_pose(camera).setup.expectations is strict
    usual = Registrar(made.model, observed, forces)
    assert usual.with_pose(camera).setup.expectations == usual.setup.expectations
