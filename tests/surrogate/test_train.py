"""Training: it learns, it goes on where it stopped, it reads no held-out sample, it refuses foreign checkpoints."""

from __future__ import annotations

import csv
import importlib
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.reference.data.writing import drop_block
from softtwin.surrogate import training_module as training
from softtwin.surrogate.architecture import Architecture
from softtwin.surrogate.checkpoint import CHECKPOINT, VERSION, CheckpointError
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.physics import Physics
from softtwin.surrogate.plan import TrainingPlan, chosen_device
from softtwin.surrogate.precision import without_tf32
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.registry import TRAINED
from softtwin.surrogate.train import train
from softtwin.surrogate.training_module import Diverged, TrainingModule, fit, rate_factor
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.umesh import UMesh

from .conftest import DEVICES


@pytest.fixture(autouse=True)
def few_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds cost a checkpoint each; eight are enough to stop between."""
    monkeypatch.setattr(training, "ROUNDS", 8)


@pytest.fixture
def short(small_plan: TrainingPlan) -> TrainingPlan:
    return replace(small_plan, epochs=2)


class Ticking:
    """A clock of the test's own: every look at it takes as long as the test says."""

    def __init__(self, *ticks: float) -> None:
        self.now, self.ticks, self.looks = 100.0, ticks, 0

    def __call__(self) -> float:
        self.now += self.ticks[min(self.looks, len(self.ticks) - 1)]
        self.looks += 1
        return self.now


def _weights(surrogate: Surrogate) -> dict[str, np.ndarray]:
    return {
        name: np.asarray(tensor)
        for name, tensor in [*surrogate.network.state_dict().items(), *surrogate.encoder_decoder.arrays().items()]
    }


def _same(a: Surrogate, b: Surrogate) -> bool:
    one, other = _weights(a), _weights(b)
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def _stop_in_round(monkeypatch: pytest.MonkeyPatch, number: int, act: Any) -> None:
    original = TrainingModule.on_train_epoch_start

    def stopping(self: TrainingModule) -> None:
        original(self)
        if self.current_epoch == number:
            act()

    monkeypatch.setattr(TrainingModule, "on_train_epoch_start", stopping)


@pytest.mark.parametrize(
    "architecture",
    [Reduced(width=32, symmetries=False), Perceptron(), UMesh(channels=32, levels=1), Transolver()],
    ids=["reduced", "mlp", "umesh", "transolver"],
)
def test_four_samples_are_learnt_by_heart(data: DataSet, tmp_path: Path, architecture: Architecture) -> None:
    plan = TrainingPlan(architecture, samples=4, epochs=240)
    four = data.samples("train", 4)
    torch.manual_seed(0)
    objective = architecture.objective(data, four, four)
    training_module = TrainingModule(objective, plan, "")
    start = objective.error()
    fit(training_module, tmp_path / CHECKPOINT, False)
    assert training_module.best_error < 0.02 * start


def test_the_reduced_network_beats_the_linear_response_on_unseen_samples(reduced: Surrogate, data: DataSet) -> None:
    samples = data.samples("test")
    linear = data.response.apply(samples.forces) - samples.displacements
    linear_error = np.linalg.norm(linear, axis=(1, 2)) / np.linalg.norm(samples.displacements, axis=(1, 2))
    assert evaluate(reduced, data).relative_error.median < 0.1 * np.median(linear_error)


def test_the_same_plan_gives_the_same_weights(data: DataSet, short: TrainingPlan) -> None:
    state = torch.get_rng_state()
    first = train(data, short)
    assert torch.equal(torch.get_rng_state(), state)  # the caller's chance is left alone
    torch.manual_seed(99)
    assert _same(first, train(data, short))
    assert not _same(first, train(data, replace(short, seed=1)))


@pytest.mark.parametrize(
    ("architecture", "epochs"),
    [(Perceptron(16), 8), (Reduced(modes=6, width=16, depth=2, sobolev=0.3), 2)],
    ids=["mlp", "reduced, with gradients"],
)
@pytest.mark.slow
def test_two_processes_learn_what_one_learns(
    data: DataSet, tmp_path: Path, capfd, architecture: Architecture, epochs: int
) -> None:
    """Two gloo processes share each batch; the mean of their gradients is that of the batch.

    Of a batch of 8 the first two are learned from by their gradients, too: the first of each process's four.
    """
    plan = TrainingPlan(architecture, epochs=epochs, batch=8)
    one, two = train(data, plan), train(data, replace(plan, processes=2), tmp_path)
    assert two.card["training"]["steps"] == one.card["training"]["steps"]
    assert two.card["training"]["validation_error"] == pytest.approx(one.card["training"]["validation_error"], rel=1e-3)
    for name, weights in _weights(one).items():
        # Muon multiplies in bfloat16 where a processor can, which rounds to 2^-8
        assert np.allclose(_weights(two)[name], weights, rtol=0.02, atol=2**-8 * np.abs(weights).max(initial=0.0))
    said = capfd.readouterr().err
    assert not any(word in said.lower() for word in ("warn", "distributed", "deprecated"))
    assert _same(two, train(data, replace(plan, processes=2), tmp_path))  # finished: nothing is trained again


CLOCK = """
import torch

class Counted:
    looks = 0.0

    def __call__(self):
        self.looks += 1.0
        ranked = torch.distributed.is_initialized() and torch.distributed.get_rank() > 0
        return self.looks * (10.0 if ranked else 0.01)
"""


@pytest.mark.slow
def test_the_clock_of_the_first_process_ends_all(
    data: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that goes on by a hundredth with each look; a second process's own would end at once."""
    (tmp_path / "counted_clock.py").write_text(CLOCK)  # a module, for processes that do not know the tests
    monkeypatch.syspath_prepend(tmp_path)
    made = importlib.import_module("counted_clock").Counted
    plan = TrainingPlan(Reduced(modes=8, width=16), seconds=1.5)
    one, two = (train(data, replace(plan, processes=each), clock=made()) for each in (1, 2))
    assert two.card["training"]["steps"] == one.card["training"]["steps"] > 40


@pytest.mark.parametrize("physics", [None, Physics(energy=1e-3)], ids=["data", "data and energy"])
@pytest.mark.parametrize("device", DEVICES)
def test_a_short_training_on_any_device_learns_and_says_where(soft: DataSet, device: Any, physics: Any) -> None:
    plan = TrainingPlan(Reduced(modes=6, width=32, depth=2), batch=32, epochs=10, physics=physics, device=device)
    surrogate = train(soft, plan)
    assert surrogate.card["training"]["device"] == device
    assert all(weights.dtype == torch.float64 and weights.is_cpu for weights in surrogate.network.parameters())
    samples = soft.samples("test")
    linear = soft.response.apply(samples.forces) - samples.displacements
    missed = np.linalg.norm(linear, axis=(1, 2)) / np.linalg.norm(samples.displacements, axis=(1, 2))
    assert evaluate(surrogate, soft).relative_error.median < 0.5 * np.median(missed)


def test_mixed_precision_learns_too(data: DataSet) -> None:
    plan = TrainingPlan(Perceptron(64), epochs=100)
    single, mixed = (train(data, replace(plan, precision=each)) for each in ("single", "mixed"))
    errors = [each.card["training"]["validation_error"] for each in (single, mixed)]
    assert errors[0] != errors[1] and errors[1] < 1.5 * errors[0]
    assert all(weights.dtype == np.float64 for weights in _weights(mixed).values() if weights.dtype.kind == "f")


@pytest.mark.parametrize(("precision", "allowed"), [("single", False), ("mixed", True)])
def test_single_precision_is_without_tf32(
    data: DataSet, short: TrainingPlan, monkeypatch: pytest.MonkeyPatch, precision: Any, allowed: bool
) -> None:
    seen, step = set(), TrainingModule.training_step

    def looking(training_module: TrainingModule, batch: Any, number: int) -> Any:
        seen.add((torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32))
        return step(training_module, batch, number)

    monkeypatch.setattr(TrainingModule, "training_step", looking)
    with without_tf32(False):  # it brings back what was
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
        train(data, replace(short, precision=precision))
        assert seen == {(allowed, allowed)}
        assert torch.backends.cuda.matmul.allow_tf32 and torch.backends.cudnn.allow_tf32


@pytest.mark.parametrize(("precision", "allowed"), [("single", True), ("mixed", False)])
def test_bfloat16_on_a_processor_is_without_onednn(
    data: DataSet, short: TrainingPlan, monkeypatch: pytest.MonkeyPatch, precision: Any, allowed: bool
) -> None:
    seen, step = set(), TrainingModule.training_step

    def looking(training_module: TrainingModule, batch: Any, number: int) -> Any:
        seen.add(torch.backends.mkldnn.enabled)
        return step(training_module, batch, number)

    monkeypatch.setattr(TrainingModule, "training_step", looking)
    assert torch.backends.mkldnn.enabled
    train(data, replace(short, precision=precision, device="cpu"))
    assert seen == {allowed}
    assert torch.backends.mkldnn.enabled


STOPPED: dict[str, Architecture | None] = {
    "reduced": None,
    "mlp": Perceptron(16, "tanh"),
    "umesh": UMesh(channels=2, levels=1),
    "transolver": Transolver(width=8, depth=1, heads=2, slices=4),
}


def test_every_trained_architecture_is_stopped_here() -> None:
    assert set(STOPPED) == set(TRAINED)


@pytest.mark.parametrize(("kind", "budget"), [("reduced", "seconds"), *((kind, "epochs") for kind in STOPPED)])
def test_training_goes_on_as_if_never_stopped(
    data: DataSet, short: TrainingPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, budget: str
) -> None:
    short = replace(short, architecture=STOPPED[kind] or short.architecture)
    if budget == "seconds":
        short = replace(short, epochs=None, seconds=8.0)
    elif kind != "reduced":
        short = replace(short, epochs=4)  # at least a step in each of the eight rounds, without images
    whole = train(data, short, tmp_path / "whole", Ticking(0.125))

    def crash() -> None:
        raise RuntimeError("power cut")

    with monkeypatch.context() as patch:
        _stop_in_round(patch, 5, crash)
        with pytest.raises(RuntimeError, match="power cut"):
            train(data, short, tmp_path / "cut", Ticking(0.125))
    resumed = train(data, short, tmp_path / "cut", Ticking(0.125))
    assert _same(whole, resumed)
    assert resumed.card["training"]["steps"] == whole.card["training"]["steps"]


@pytest.mark.parametrize("budget", [{"epochs": 2}, {"epochs": None, "seconds": 2.0}])
def test_a_finished_training_is_not_repeated(
    data: DataSet, small_plan: TrainingPlan, tmp_path: Path, budget: dict[str, Any]
) -> None:
    short = replace(small_plan, **budget)
    first = train(data, short, tmp_path, Ticking(0.0625))
    stamp = (tmp_path / CHECKPOINT).stat().st_mtime_ns
    assert _same(first, train(data, short, tmp_path))
    assert (tmp_path / CHECKPOINT).stat().st_mtime_ns == stamp


def test_ctrl_c_is_a_keyboard_interrupt_and_leaves_a_whole_checkpoint(
    data: DataSet, short: TrainingPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handler = signal.default_int_handler
    before = signal.signal(signal.SIGINT, handler)  # a shell's background job starts with Ctrl-C ignored
    try:
        with monkeypatch.context() as patch:
            _stop_in_round(patch, 3, lambda: os.kill(os.getpid(), signal.SIGINT))
            with pytest.raises(KeyboardInterrupt):
                train(data, short, tmp_path)
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert _same(train(data, short, tmp_path), train(data, short))


def test_a_polite_kill_ends_the_program_and_leaves_a_whole_checkpoint(
    data: DataSet, short: TrainingPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        _stop_in_round(patch, 3, lambda: os.kill(os.getpid(), signal.SIGTERM))
        with pytest.raises(SystemExit):
            train(data, short, tmp_path)
    assert _same(train(data, short, tmp_path), train(data, short))


@pytest.mark.parametrize(
    ("ticks", "latest", "fewest", "most"),
    [((0.25,), 10.5, 8, 40), ((0.25, 0.25, 0.25, 0.25, 4.0), 18.0, 3, 6), ((100.0,), 300.0, 1, 1)],
    ids=["steady", "busier and busier", "one step is too long"],
)
def test_training_ends_with_the_step_under_way_when_the_time_is_over(
    data: DataSet, small_plan: TrainingPlan, ticks: tuple[float, ...], latest: float, fewest: int, most: int
) -> None:
    """Where the machine becomes busy fewer steps are made; the step under way and the look after it are the last."""
    told = train(data, replace(small_plan, epochs=None, seconds=10.0), clock=Ticking(*ticks)).card["training"]
    assert 10.0 <= told["seconds"] <= latest
    assert fewest <= told["steps"] <= most


def test_the_learning_rate_follows_the_budget_that_was_used() -> None:
    steps = [rate_factor(step, step / 1000) for step in range(1001)]
    assert max(steps) == pytest.approx(1.0, abs=0.1) and steps[0] == 1 / 200 and steps[-1] < 1e-12
    assert rate_factor(1, 0.5) == pytest.approx(0.5)  # a slow machine is past the warm-up in the middle of its time


@pytest.mark.parametrize("split", ["test", "calibration"])
def test_held_out_samples_are_never_read(data: DataSet, make_data: Any, short: TrainingPlan, split: Any) -> None:
    poisoned = make_data(poison=split)
    held = poisoned.samples(split).displacements
    assert len(held) and np.isnan(held).all()
    assert _same(train(poisoned, short), train(data, short))


@pytest.mark.parametrize("split", ["train", "validation"])
def test_poisoned_data_are_noticed(make_data: Any, short: TrainingPlan, split: str) -> None:
    """What makes the test above mean something: NaN that is read does not pass unseen."""
    with pytest.raises(ValueError, match=rf"expected finite numbers in the {split} split .* got \d+ of \d+ samples"):
        train(make_data(poison=split), short)


@pytest.mark.parametrize("split", ["train", "validation"])
def test_a_split_without_accepted_samples_is_refused(make_data: Any, short: TrainingPlan, split: str) -> None:
    empty = make_data(rejected=split)
    with pytest.raises(ValueError, match=rf"train\.data: expected accepted samples in the {split} split"):
        train(empty, short)


def test_an_incomplete_data_set_is_refused(make_data: Any, short: TrainingPlan) -> None:
    data = make_data()
    drop_block(data.path, 1)
    with pytest.raises(DataSetError, match=r"block 1 .* was never finished"):
        train(data, short)


def test_divergence_says_what_to_try(data: DataSet, short: TrainingPlan) -> None:
    with pytest.raises(Diverged, match=r"is (nan|inf) after \d+ steps .*lower TrainingPlan\.learning_rate"):
        train(data, replace(short, learning_rate=1e30))


# ------------------------------------------------------------------ checkpoints that do not fit


def test_a_truncated_checkpoint_is_refused(data: DataSet, short: TrainingPlan, tmp_path: Path) -> None:
    train(data, short, tmp_path)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(CheckpointError, match="truncated"):
        train(data, short, tmp_path)


def test_a_checkpoint_of_another_plan_is_refused(data: DataSet, short: TrainingPlan, tmp_path: Path) -> None:
    train(data, short, tmp_path)
    with pytest.raises(CheckpointError, match=r"another plan \(differs in width, seed\)"):
        train(data, replace(short, architecture=Reduced(modes=6, width=16, depth=2), seed=3), tmp_path)


def test_a_checkpoint_of_another_architecture_is_refused(data: DataSet, short: TrainingPlan, tmp_path: Path) -> None:
    train(data, short, tmp_path)
    with pytest.raises(CheckpointError, match=r"another plan \(differs in architecture, "):
        train(data, replace(short, architecture=Perceptron()), tmp_path)


def test_a_checkpoint_goes_on_whose_weights_have_their_earlier_name(
    data: DataSet, short: TrainingPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The objective was called lesson."""
    with monkeypatch.context() as patch:
        _stop_in_round(patch, 3, lambda: os.kill(os.getpid(), signal.SIGTERM))
        with pytest.raises(SystemExit):
            train(data, short, tmp_path)
    checkpoint = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    weights = checkpoint["state_dict"]
    assert weights and all(name.startswith("objective.") for name in weights)
    checkpoint["state_dict"] = {name.replace("objective.", "lesson.", 1): value for name, value in weights.items()}
    torch.save(checkpoint, tmp_path / CHECKPOINT)
    assert _same(train(data, short, tmp_path), train(data, short))


@pytest.mark.parametrize("version", [1, VERSION + 1])
def test_a_checkpoint_of_another_version_is_refused(
    data: DataSet, short: TrainingPlan, tmp_path: Path, version: int
) -> None:
    train(data, short, tmp_path)
    checkpoint = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    checkpoint["course"]["version"] = version
    torch.save(checkpoint, tmp_path / CHECKPOINT)
    with pytest.raises(CheckpointError, match="another version"):
        train(data, short, tmp_path)


def test_a_checkpoint_of_another_data_set_is_refused(
    data: DataSet, make_data: Any, short: TrainingPlan, tmp_path: Path
) -> None:
    train(data, short, tmp_path / "run")
    other = make_data(counts={"train": 56, "validation": 16, "test": 16})
    with pytest.raises(CheckpointError, match="another data set"):
        train(other, short, tmp_path / "run")


def test_a_checkpoint_cannot_run_code(data: DataSet, short: TrainingPlan, tmp_path: Path) -> None:
    torch.save({"course": os.getcwd}, tmp_path / CHECKPOINT)
    with pytest.raises(CheckpointError, match="UnpicklingError"):
        train(data, short, tmp_path)


# ------------------------------------------------------------------ plans


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epochs": 0}, "epochs: expected at least 1"),
        ({"seconds": -1.0}, "seconds: expected a positive number"),
        ({"learning_rate": float("nan")}, "learning_rate: expected a positive number"),
        ({"batch": -1}, "batch: expected at least 1, got -1"),
    ],
)
def test_plans_out_of_range_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrainingPlan(**change)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (lambda: Reduced(modes=0), r"Reduced\.modes: expected at least 1, got 0"),
        (lambda: Reduced(sobolev=-0.1), r"Reduced\.sobolev: expected a number not below 0"),
        (lambda: Perceptron(width=0), r"Perceptron\.width: expected at least 1, got 0"),
        (lambda: Perceptron(activation="swish"), r"Perceptron\.activation: expected one of relu, .*, got 'swish'"),
        (lambda: Transolver(heads=0), r"Transolver\.heads: expected at least 1, got 0"),
        (lambda: Transolver(width=65), r"Transolver\.width: expected a multiple of 4 heads, got 65"),
    ],
)
def test_settings_of_a_network_out_of_range_are_refused(settings: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        settings()


@pytest.mark.slow
def test_training_that_gets_no_better_ends_early(
    data: DataSet, small_plan: TrainingPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten times the rate that is good for it: the error soon stays above its least. Each round leaves a line."""
    monkeypatch.setattr(training, "ROUNDS", 40)
    plan = replace(small_plan, epochs=80, learning_rate=0.05)
    whole = train(data, plan)
    short = train(data, replace(plan, patience=3), tmp_path)
    assert short.card["training"]["steps"] < whole.card["training"]["steps"]
    (log,) = (tmp_path / "logs").glob("*/metrics.csv")
    assert len(list(log.parent.glob("events.out.tfevents.*"))) == 1
    with log.open() as file:
        lines = list(csv.DictReader(file))
    errors = [float(line["validation_error"]) for line in lines]
    assert int(lines[-1]["step"]) == short.card["training"]["steps"]
    assert min(errors) == short.card["training"]["validation_error"]
    assert len(errors) - 1 - int(np.argmin(errors)) == 3
    assert all(float(line["loss"]) > 0.0 for line in lines)


@pytest.mark.parametrize("device", ["auto", "cuda"])
def test_more_processes_than_gpus_are_refused(
    data: DataSet, short: TrainingPlan, monkeypatch: pytest.MonkeyPatch, device: Any
) -> None:
    """Before anything is trained; on the CPU there may be as many as one likes."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    plan = replace(short, processes=2, device=device)
    with pytest.raises(ValueError, match=r"TrainingPlan\.processes: expected at most one for each of 1 GPUs, got 2"):
        train(data, plan)
    assert chosen_device(replace(plan, device="cpu")) == "cpu"


@pytest.mark.parametrize(("setting", "value"), [("patience", 0), ("device", "tpu")])
def test_wrong_settings_of_training_are_named(setting: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"TrainingPlan\.{setting}: expected"):
        TrainingPlan(**{setting: value})


def test_what_is_only_evaluated_waits_for_no_trainer() -> None:
    """Lightning takes seconds to import: only what trains step by step does, in a process of its own here."""
    script = "import sys, softtwin.surrogate.train, softtwin.surrogate.evaluate; print('lightning' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=True)
    assert told.stdout.split() == ["False"]
