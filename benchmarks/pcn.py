"""Laplace's posterior of a surrogate registration against a chain: preconditioned Crank-Nicolson (CUQIpy), ten frames.

    softtwin quickstart --output FOLDER
    pip install -e '.[benchmark]'
    python benchmarks/pcn.py FOLDER [--frames 10] [--length 20000] [--about laplace]

Fresh states of the quickstart's organ and clouds of 1,000 points as in margins.py, no zone told, from rest. The chain
has all coefficients, of forces, model error and noise that neighbours share, whitened by their prior, and the
likelihood that the registration ended with: its robust loss, with the hyperparameters that were found. Laplace's law is
taken at the same ones, so that the two differ by what is not linear alone (the doubt of the hyperparameters, which the
product adds, is in neither). pCN proposes from the prior (--about prior: Cotter et al. 2013), whose
steps are as short as the sharpest direction asks; about Laplace's law (Rudolf and Sprungk 2018) it has the same target,
and a state tells far more.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import FOLDER, Benchmark, Given, Setting, run
from margins import truths_of
from numpy.typing import NDArray

from softtwin.app.quickstart import CAMERA, NOISE, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import partial_view
from softtwin.registration.evaluation import Evaluation
from softtwin.registration.loss import Loss, Tukey
from softtwin.registration.parameters.discrepancy import ModelError
from softtwin.registration.problem import Problem
from softtwin.registration.result import Registration

Floats = NDArray[np.float64]
KEPT = 2000  # states of the chain whose quantities are looked at
WARM = 0.25  # part of the length before that, in which the step is tuned
QUANTITIES = ("net force", "mean displacement")


@dataclass(frozen=True, eq=False)
class Law:
    """What is known of the coefficients after a cloud, at hyperparameters that are held.

    The cloud has no normals, there are no landmarks, and the pose is known.

    Args:
        problem: what was registered.
        evaluation: where the solver ended.
        scale: standard deviation of each coefficient beforehand, (k,).
        noise: of a point's own that was found, metres: by it distances to round places are expected to be off.
        deviations: of the points, (p,), metres.
        loss: of each.
    """

    problem: Problem
    evaluation: Evaluation
    scale: Floats
    noise: float
    deviations: Floats
    loss: Loss

    @classmethod
    def of(cls, found: Registration, loss: Loss | None = None) -> Law:
        """At the hyperparameters of a registration's end."""
        local = found.local
        assert local is not None  # it was registered
        scale = 1.0 / np.sqrt(local.precision)
        return cls(found.problem, found.evaluation, scale, local.point_noise, local.deviations, loss or Tukey())

    def log_likelihood(self, whitened: Floats) -> float:
        """Of coefficients over their scales beforehand, (k,), up to a constant."""
        scaled = self.problem.residuals(self._trial(whitened), self.noise) / self.deviations
        return -float(self.loss.value(scaled).sum())

    def _trial(self, whitened: Floats) -> Evaluation:
        return self.problem.evaluation(self.scale * whitened, self.evaluation)

    @property
    def mode(self) -> Floats:
        """Where the solver ended, whitened, (k,)."""
        return self.evaluation.coefficients / self.scale

    def covariance(self) -> Floats:
        """Laplace's, whitened, (k, k), with the weights that the product's has."""
        scaled = self.problem.residuals(self.evaluation, self.noise) / self.deviations
        trusted = np.sqrt(self.loss.weight(scaled)) / self.deviations
        slopes = trusted[:, None] * self.problem.jacobian(self.evaluation) * self.scale
        return np.linalg.inv(slopes.T @ slopes + np.eye(len(self.scale)))

    def quantities(self, whitened: Floats) -> Floats:
        """Net force, newtons, and the nodes' mean displacement, metres, (6,)."""
        problem, found = self.problem, self.scale * whitened
        forces = found[problem.force_part]
        moved = problem.model.solve(forces).full.displacement
        if problem.error is not None:
            moved = moved + problem.error.field(found[problem.part(ModelError)])
        return np.concatenate([problem.forces.net_basis @ forces, moved.mean(axis=0)])

    def slopes(self) -> Floats:
        """Their derivative by the whitened coefficients at the mode, (6, k)."""
        problem = self.problem
        pushed = self.evaluation.state.full.jvp(problem.forces.basis)
        mean = np.zeros((3, problem.size))  # what the patterns leave out, and noise, move no node
        mean[:, problem.force_part] = pushed.reshape(-1, 3, pushed.shape[1]).mean(axis=0)
        if problem.error is not None:
            modes = problem.error.amplitude * problem.error.modes
            mean[:, problem.part(ModelError)] = modes.reshape(-1, 3, modes.shape[1]).mean(axis=0)
        return np.vstack([problem.net_forces(self.evaluation), mean]) * self.scale


@dataclass(frozen=True, eq=False)
class Chain:
    """What a chain has gone through.

    Args:
        states: whitened coefficients, (s, k).
        acceptance: share of proposals that were taken.
        seconds: wall time.
    """

    states: Floats
    acceptance: float
    seconds: float


def walked(
    log_likelihood: Callable[[Floats], float],
    middle: Floats,
    root: Floats,
    length: int,
    scale: float,
    seed: int = 0,
    start: Floats | None = None,
) -> Chain:
    """CUQIpy's pCN about a normal law, for a likelihood times the unit normal law.

    Args:
        log_likelihood: of the target over the unit normal law of whitened coefficients, (k,).
        middle: of the law that proposals are made from, (k,).
        root: of its covariance, (k, k).
        length: states after those in which the step is tuned.
        scale: step to begin with, in (0, 1].
        seed: of the chain.
        start: in deviations of the law, (k,); its middle if not given.
    """
    from cuqi.distribution import Gaussian, Posterior
    from cuqi.likelihood import UserDefinedLikelihood
    from cuqi.sampler import PCN

    def against_the_law(v: Floats) -> float:
        x = middle + root @ v
        return log_likelihood(x) - 0.5 * float(x @ x) + 0.5 * float(v @ v)

    np.random.seed(seed)  # noqa: NPY002  CUQIpy draws from it
    count = len(middle)
    prior = Gaussian(np.zeros(count), np.ones(count), name="v")
    likelihood = UserDefinedLikelihood(dim=count, logpdf_func=lambda v: against_the_law(np.asarray(v)), name="y")
    begun = time.perf_counter()
    sampler = PCN(Posterior(likelihood, prior), scale=scale, initial_point=np.zeros(count) if start is None else start)
    sampler.warmup(max(10, round(WARM * length)))
    before = len(sampler._samples)
    sampler.sample(length)
    seconds = time.perf_counter() - begun
    states = np.array(sampler._samples[before:])
    moved = np.abs(np.diff(states, axis=0)).max(axis=1) > 0.0
    return Chain(middle + states @ root.T, float(moved.mean()), seconds)


def effective(values: Floats) -> float:
    """How many independent values tell a mean as well as a chain's, (s,): Geyer's initial positive sequence (1992)."""
    count, off = len(values), values - values.mean()
    square = float(off @ off)
    if square == 0.0:
        return 1.0
    padded = np.fft.rfft(off, 2 * count)
    correlation = np.fft.irfft(padded * padded.conj())[:count] / square
    pairs = correlation[: 2 * (count // 2)].reshape(-1, 2).sum(axis=1)
    last = int(np.argmax(pairs <= 0.0)) if (pairs <= 0.0).any() else len(pairs)
    return float(count / max(2.0 * pairs[:last].sum() - 1.0, 1.0 / count))


def compared(law: Law, length: int, about: str, scale: float, seed: int) -> dict[str, Any]:
    """Means and deviations by Laplace and by the chain, in SI units, and how much the chain tells."""
    covariance, middle, root = law.covariance(), np.zeros_like(law.scale), np.eye(len(law.scale))
    if about == "laplace":
        middle, root = law.mode, np.linalg.cholesky(covariance)
    start = np.linalg.solve(root, law.mode - middle)  # both chains begin where the solver has ended
    chain = walked(law.log_likelihood, middle, root, length, scale, seed, start)
    few = chain.states[:: max(1, length // KEPT)]
    sampled = np.array([law.quantities(state) for state in few])
    slopes = law.slopes()
    laplace = law.quantities(law.mode), np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    found: dict[str, Any] = {
        "unknowns": len(law.scale),
        "acceptance": chain.acceptance,
        "effective": min(effective(column) for column in sampled.T),
        "seconds": chain.seconds,
    }
    for name, part in zip(QUANTITIES, (slice(0, 3), slice(3, 6)), strict=True):
        mean, deviation = sampled.mean(axis=0)[part], sampled.std(axis=0)[part]
        found[name] = {
            "laplace": {"mean": laplace[0][part], "deviation": laplace[1][part]},
            "chain": {"mean": mean, "deviation": deviation},
            "apart": float(np.abs((mean - laplace[0][part]) / deviation).max()),  # in the chain's deviations
            "ratio": float(np.exp(np.abs(np.log(laplace[1][part] / deviation)).max())),  # of deviations, the worst
        }
    return found


def frame(twin: Twin, truth: Floats, seed: int) -> Registration:
    """One of the frames, registered by the surrogate."""
    rng = np.random.default_rng(seed)
    return twin.register(partial_view(twin.body, truth, CAMERA, POINTS, NOISE, rng, surface="observed"), "")


def work(row: str, given: Given) -> dict[str, Any]:
    number = int(row.split()[1].rstrip(","))
    twin = given.opened(opened, given.folder)
    _, truth = given.once(truths_of, given.folder, given.frames)[number]
    result = frame(twin, truth, number)
    found = compared(Law.of(result), given.length, given.about, given.scale, number)
    return {"verdict": result.judgement.verdict.value, **found}


def opened(folder: Path) -> Twin:
    """The surrogate of a quickstart, its pose known."""
    return Twin.open(folder, "surrogate", pose="fixed")


BENCHMARK = Benchmark(
    name="pcn",
    title="Laplace's posterior of a surrogate registration against a chain (preconditioned Crank-Nicolson)",
    about=("registration", "surrogate"),
    work=work,
    rows=lambda given: [f"frame {n}, about {given.about}, {given.length} states" for n in range(given.frames)],
    columns=(
        Column("unknowns", "", "{unknowns}"),
        Column("acceptance", "", "{acceptance:.2f}"),
        Column("effective states", "", "{effective:.0f}"),
        *(
            Column(
                f"{name}: means apart, in deviations; ratio of deviations",
                "",
                f"{{{name}.apart:.2f}}; {{{name}.ratio:.2f}}",
            )
            for name in QUANTITIES
        ),
        Column("time", "s", "{seconds:.0f}"),
    ),
    settings={
        "folder": FOLDER,
        "frames": Setting(10, "registered", picks=True),
        "length": Setting(20_000, "of each chain, after its step is tuned"),
        "about": Setting("laplace", "what proposals are made from", choices=("laplace", "prior")),
        "scale": Setting(0.2, "step of the chain to begin with, in (0, 1]"),
    },
    small={"frames": 1, "length": 100},
)


if __name__ == "__main__":
    run(BENCHMARK)
