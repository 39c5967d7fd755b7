"""A surrogate that learns while it is used: what it gains, what it refuses, and what its bounds do meanwhile."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.meshes.io import read_body
from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.adaptation import OnlineLearner
from softtwin.surrogate.calibration import calibrate
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.exact_states import ExactStates
from softtwin.surrogate.galerkin import Galerkin
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import load, packed, save, unpacked

pytestmark = pytest.mark.fenicsx
BEYOND = 2.0  # times a load of the test split
Pair = tuple[np.ndarray, np.ndarray]
Way = Callable[..., list[Pair]]


@pytest.fixture(scope="module")
def data(small_quickstart: Path) -> DataSet:
    return DataSet(small_quickstart / "data.zarr")


@pytest.fixture(scope="module")
def network(small_quickstart: Path) -> Surrogate:
    return load(small_quickstart / "twin", read_body(small_quickstart / "twin" / "body.vtu"))


@pytest.fixture(scope="module")
def galerkin(data: DataSet) -> Surrogate:
    bare = train(data, TrainingPlan(Galerkin(modes=10, curved=6, derivatives=10, own=0, cells=100)))
    return calibrate(with_domain(bare, data), data)


@pytest.fixture(params=["network", "galerkin"])
def surrogate(request: pytest.FixtureRequest) -> Surrogate:
    found: Surrogate = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="module")
def way(data: DataSet) -> Way:
    """A load that grows beyond the training and turns a little into another: so many loads, their exact states."""
    a, b = (np.zeros_like(data.body.points) for _ in range(2))
    a[data.response.loaded], b[data.response.loaded] = data.samples("test").forces[:2]

    @cache
    def found(count: int = 30) -> list[Pair]:
        loads = [BEYOND * share * (a + 0.5 * share * b) for share in np.linspace(0.2, 1.0, count)]
        states, state = [], None
        with Problem(data.body, data.material) as problem:
            for load in loads:
                state = problem.solve(load, state, stability=False)
                states.append(state.displacement)
        return list(zip(loads, states, strict=True))

    return found


def error(surrogate: Surrogate, pairs: list[Pair]) -> float:
    return float(np.mean([nodal_distances(surrogate.solve(f).displacement[None], u[None]).mean() for f, u in pairs]))


def test_what_was_learned_helps_with_what_comes(surrogate: Surrogate, way: Way) -> None:
    pairs = way()
    learner = OnlineLearner(surrogate, seconds=1.5)
    assert not learner.is_due
    for forces, state in pairs[:20]:
        learner.observe(forces, state)
        learner.explore()
    assert learner.is_due
    adapted = learner.adapt()
    assert adapted is learner.current and adapted is not surrogate
    assert error(adapted, pairs[20:]) < 0.5 * error(surrogate, pairs[20:])
    entry = adapted.card["adaptation"]
    assert entry["relative_error_after"] < entry["relative_error_before"] and entry["frames"] == 20
    assert adapted.card["domain"]["displacement_m"] > surrogate.card["domain"]["displacement_m"]
    assert adapted.solve(pairs[10][0]).is_inside and not surrogate.solve(pairs[-1][0]).is_inside
    assert np.abs(adapted.solve(np.zeros_like(pairs[0][0])).displacement).max() == 0.0
    json.dumps(packed(adapted)[1], allow_nan=False)


def test_every_third_state_is_never_learned_from(network: Surrogate, way: Way) -> None:
    learner = OnlineLearner(network)
    pairs = way(12)
    kept = [learner.observe(*pair).is_kept_back for pair in pairs]
    assert kept == [False, False, True] * 4
    new = learner._exact.samples(learner._known, 1.0)
    for (_, state), is_kept_back in zip(pairs, kept, strict=True):
        assert is_kept_back != any(np.array_equal(each, state.ravel()) for each in new.displacements)


def test_what_does_no_better_is_not_taken(network: Surrogate, way: Way, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = OnlineLearner(network)
    for pair in way(12):
        learner.observe(*pair)
    monkeypatch.setattr(learner._kind, "adapted", lambda maps, same, new: (maps, same))
    assert learner.adapt() is None and learner.current.network is network.network
    assert not learner.is_due and learner.adaptations == 0


def test_bounds_follow_what_the_tests_say(network: Surrogate, way: Way) -> None:
    """A miss raises them at once by what they missed by and by as much as nine hits lower them: nine in ten hold."""
    learner = OnlineLearner(network)
    missed, widths = [], []
    for forces, state in way(40):
        seen = learner.observe(forces, state)
        missed.append(max(0.0, float(np.log(seen.error["mean"] / seen.bound["mean"]))))
        widths.append(learner.current.card["certificate"]["quantiles"]["mean"][0])
    steps, misses = np.diff(np.log(widths)), np.array(missed[1:])
    assert np.allclose(steps[misses == 0.0], -0.03)
    assert np.allclose(steps[misses > 0.0], 0.27 + misses[misses > 0.0])
    assert 0.8 <= np.mean(misses[9:] == 0.0) <= 1.0


def test_states_ahead_lie_where_the_loads_go(network: Surrogate, way: Way) -> None:
    exact = ExactStates(network)
    assert not exact.explore(network)  # nothing has come yet
    for forces, state in way(10):
        exact.keep(exact.frame(forces, state, network))
    assert all(exact.explore(network) for _ in range(4))
    size = max(np.linalg.norm(each.displacement) for each in exact.frames.learned)
    for each in exact.ahead.learned:
        assert np.linalg.norm(each.displacement) < 2.5 * size
        assert np.abs(each.displacement[network.body.fixed]).max() == 0.0


def test_changes_are_those_of_the_exact_state(network: Surrogate, way: Way) -> None:
    exact = ExactStates(network)
    for forces, state in way(6):
        exact.keep(exact.frame(forces, state, network))
    state = exact.frames.learned[-1]
    for push, change in list(zip(state.pushes, state.changes, strict=True))[:3]:
        small = 1e-2 * push.reshape(-1, 3)
        ahead = exact.frame(state.forces + small, None, network).displacement
        behind = exact.frame(state.forces - small, None, network).displacement
        assert np.allclose(0.5 * (ahead - behind).ravel(), 1e-2 * change, atol=2e-3 * np.abs(1e-2 * change).max())


def test_a_frame_at_rest_teaches_nothing_and_breaks_nothing(network: Surrogate) -> None:
    learner, nothing = OnlineLearner(network), np.zeros(network.body.points.shape)
    for _ in range(4):
        assert learner.observe(nothing, nothing).error["largest"] == 0.0
    assert not learner.explore()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f, u: (f, np.full_like(u, np.nan)), r"OnlineLearner.displacement: expected finite"),
        (lambda f, u: (np.full_like(f, np.inf), u), r"OnlineLearner.forces: expected finite"),
        (lambda f, u: (f[:-1], u[:-1]), r"OnlineLearner.forces: expected shape"),
        (lambda f, u: (f, 1.2 * u), r"times the load out of balance; is it of another organ\?"),
        (lambda f, u: (-f, u), r"times the load out of balance"),
    ],
)
def test_what_is_no_state_of_this_organ_is_refused(network: Surrogate, way: Way, change: Any, said: str) -> None:
    learner = OnlineLearner(network)
    with pytest.raises(ValueError, match=said):
        learner.observe(*change(*way(1)[0]))
    assert learner.frames == 0 and not list(learner._exact)


def test_others_are_refused_before_anything_is_solved(network: Surrogate, data: DataSet) -> None:
    with pytest.raises(ValueError, match=r"learns while it is used \(galerkin, reduced\), got mlp"):
        OnlineLearner(train(data, TrainingPlan(Perceptron(width=8), epochs=1)))
    with pytest.raises(ValueError, match="one tissue, got one that takes several"):
        OnlineLearner(network.with_card(plan={"vary": {"poisson-ratio": [0.4, 0.49]}}))


# ---------------------------------------------------------------------- on its way, and on a full disk


def test_what_is_packed_comes_back(surrogate: Surrogate, way: Way) -> None:
    weights, card = packed(surrogate)
    other = unpacked(weights, card, surrogate.body)
    forces = way(1)[0][0]
    assert np.array_equal(other.solve(forces).displacement, surrogate.solve(forces).displacement)
    assert other.card["certificate"] == surrogate.card["certificate"]


def test_a_full_disk_leaves_what_was_there(network: Surrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(network, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    plain = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if path.name.startswith("surrogate.json"):
            raise OSError(28, "No space left on device")
        return plain(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        save(network.with_card(adaptation={}), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
