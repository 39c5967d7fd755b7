"""The hybrid engine with unknowns and known forces that its network has not learned, on the quickstart's organ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.config import ConfigError
from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.io import read_body
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Problem
from softtwin.registration.pose import Pose
from softtwin.registration.result import Registration
from softtwin.registration.verdict import Verdict

pytestmark = pytest.mark.fenicsx


def pull(folder: Path) -> np.ndarray:
    """The demo's load, (n, 3), newtons."""
    with np.load(folder / "demo" / "reference.npz") as arrays:
        return arrays["true_forces"]


def solved(body: Body, forces: np.ndarray, poisson_ratio: float = 0.45) -> np.ndarray:
    with Problem(body, NeoHookean(5000.0, poisson_ratio)) as problem:
        return problem.solve(forces).displacement


def seen(body: Body, truth: np.ndarray) -> np.ndarray:
    return partial_view(body, truth, CAMERA, POINTS, 5e-4, np.random.default_rng(0), surface="observed")


def score(found: Registration, net: np.ndarray) -> float:
    """Square of the net force's error in deviations: of a normal law, chi-square with three degrees of freedom."""
    missed = found.net_force - net
    return float(missed @ np.linalg.solve(found.net_force_covariance, missed))


def test_a_ratio_and_a_pose_are_found_beside_the_forces(small_quickstart: Path) -> None:
    """The network has learned another ratio and starts off; the reference, which has it as an unknown, ends right."""
    load = pull(small_quickstart)
    body = read_body(small_quickstart / "body.vtu")
    truth = solved(body, load, 0.40)
    true = Pose.identity().moved(np.array([0.02, -0.01, 0.02, 2e-3, -1e-3, 2e-3]), body.points.mean(axis=0))
    with Twin.open(small_quickstart, "hybrid", parameters=("poisson-ratio",)) as twin:
        found = twin.register(true.apply(seen(body, truth)), "", camera=twin.near(Pose.identity()))
        deviation = found.camera_uncertainty.deviation.mean()
    assert found.judgement.verdict is Verdict.ACCEPTED, found.judgement.reasons
    assert found.draft is not None and not found.draft.estimates  # the network knows of no ratio
    (ratio,) = found.estimates
    assert ratio.interval[0] < 0.40 < ratio.interval[1] and ratio.variance_reduction > 0.0
    in_camera = found.pose.apply(body.points + found.displacement) - true.apply(body.points + truth)
    assert np.linalg.norm(in_camera, axis=1).mean() < 2.0 * deviation < 2e-3
    assert score(found, load.sum(axis=0)) < chi2.ppf(0.999, 3)


def test_known_forces_are_told_from_unknown_ones(small_quickstart: Path, tmp_path: Path) -> None:
    """The network is asked under both: without them the same cloud's forces are those of both together."""
    body = read_body(small_quickstart / "body.vtu")
    free = np.setdiff1d(np.unique(body.surfaces["observed"]), body.fixed)
    low = free[body.points[free, 2] < np.quantile(body.points[free, 2], 0.15)]
    known, load = np.zeros_like(body.points), pull(small_quickstart)
    known[low] = np.array([0.1, -0.2, -0.2]) / len(low)
    np.save(tmp_path / "known.npy", known)
    cloud = seen(body, solved(body, known + load))
    found = {}
    for path in (str(tmp_path / "known.npy"), ""):
        with Twin.open(small_quickstart, "hybrid", known_forces=path, pose="fixed") as twin:
            found[path] = twin.register(cloud, "")
            assert twin.bounded(found[path]) is None or not path  # no bound of a network that is asked otherwise
    told, silent = found.values()
    assert told.judgement.verdict is Verdict.ACCEPTED, told.judgement.reasons
    for result in (told, told.draft):
        assert score(result, load.sum(axis=0)) < chi2.ppf(0.999, 3)
    apart = np.linalg.norm(silent.net_force - np.array([(known + load).sum(axis=0), load.sum(axis=0)]), axis=1)
    assert apart[0] < 0.5 * apart[1]


def test_known_forces_inside_are_none_of_the_networks(small_quickstart: Path, tmp_path: Path) -> None:
    body = read_body(small_quickstart / "body.vtu")
    inside = np.zeros_like(body.points)
    inside[np.setdiff1d(np.arange(len(body.points)), body.boundary_nodes)[0], 2] = 0.1
    np.save(tmp_path / "known.npy", inside)
    with (
        pytest.raises(ConfigError, match=r"registration\.known_forces: .*loaded in training.*reference engine"),
        Twin.open(small_quickstart, "hybrid", known_forces=str(tmp_path / "known.npy")),
    ):
        raise AssertionError("not opened")
