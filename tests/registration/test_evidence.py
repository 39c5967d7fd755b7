"""Hyperparameters by the evidence: equal to the dense normal law, exact derivatives, right on drawn data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from softtwin.registration.evidence import Evidence, Hyperprior, LinearProblem, _descended
from softtwin.registration.hyperparameters import LogNormalPrior

POINTS, FORCES, PATTERNS = 300, 8, 6
NOISES = LogNormalPrior(0.5, 1.0), LogNormalPrior(1.0, 1.0), LogNormalPrior(0.1, 2.0)


def noise_variances(eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two groups, the second with more of the third scale."""
    return np.array([2.0 * eta[0], 2.0 * eta[0] + eta[2]]), np.array([[2.0, 2.0], [0.0, 0.0], [0.0, 1.0]])


def prior_variances(eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    logs = np.concatenate([np.full(FORCES, 2.0 * eta[1]), np.full(PATTERNS, 2.0 * eta[2])])
    slopes = np.zeros((3, FORCES + PATTERNS))
    slopes[1, :FORCES], slopes[2, FORCES:] = 2.0, 2.0
    return logs, slopes


class Drawn:
    """A linear problem of two groups, with its parts."""

    def __init__(self, rng: np.random.Generator, truth: np.ndarray, has_known: bool = False) -> None:
        self.rows = rng.standard_normal((POINTS, FORCES + PATTERNS))
        self.weights = rng.uniform(0.5, 1.0, POINTS)
        self.groups = [np.arange(100), np.arange(100, POINTS)]
        noise = np.empty(POINTS)
        for group, log in zip(self.groups, noise_variances(truth)[0], strict=True):
            noise[group] = np.exp(0.5 * log)
        self.unknown = np.exp(0.5 * prior_variances(truth)[0]) * rng.standard_normal(FORCES + PATTERNS)
        own = noise / np.sqrt(self.weights) * rng.standard_normal(POINTS)
        self.data = self.rows @ self.unknown + own
        beside = rng.standard_normal((4, FORCES + PATTERNS))
        self.beside = (beside, beside @ self.unknown + rng.standard_normal(4)) if has_known else None

    @property
    def problem(self) -> LinearProblem:
        weighted = self.weights * self.data
        return LinearProblem(
            np.stack([self.rows[g].T @ (self.weights[g, None] * self.rows[g]) for g in self.groups]),
            np.stack([weighted[g] @ self.rows[g] for g in self.groups]),
            np.array([weighted[g] @ self.data[g] for g in self.groups]),
            np.array([float(len(g)) for g in self.groups]),
            np.zeros(2),
            None if self.beside is None else (self.beside[0].T @ self.beside[0], self.beside[0].T @ self.beside[1]),
        )

    @property
    def evidence(self) -> Evidence:
        return Evidence(self.problem, noise_variances, prior_variances, Hyperprior.of(NOISES))

    def dense(self, eta: np.ndarray) -> float:
        """Minus the logarithm of the normal law of all data, and of what is believed, but for a constant."""
        variances = np.empty(POINTS)
        for group, log in zip(self.groups, noise_variances(eta)[0], strict=True):
            variances[group] = np.exp(log) / self.weights[group]
        rows, data = self.rows, self.data
        if self.beside is not None:
            rows, data = np.concatenate([rows, self.beside[0]]), np.concatenate([data, self.beside[1]])
            variances = np.concatenate([variances, np.ones(4)])
        covariance = np.diag(variances) + rows * np.exp(prior_variances(eta)[0]) @ rows.T
        off = (eta - np.log([0.5, 1.0, 0.1])) / [1.0, 1.0, 2.0]
        return 0.5 * float(np.linalg.slogdet(covariance)[1] + data @ np.linalg.solve(covariance, data) + off @ off)


@pytest.mark.parametrize("has_known", [False, True])
def test_it_is_the_dense_normal_law(rng: np.random.Generator, has_known: bool) -> None:
    drawn = Drawn(rng, np.log([0.3, 2.0, 0.2]), has_known)
    first, second = np.log([0.3, 1.5, 0.1]), np.log([0.5, 0.8, 0.4])
    found = drawn.evidence.value(first)[0] - drawn.evidence.value(second)[0]
    assert found == pytest.approx(drawn.dense(first) - drawn.dense(second), rel=1e-9)


@pytest.mark.parametrize("has_known", [False, True])
def test_its_gradient_is_exact(rng: np.random.Generator, has_known: bool) -> None:
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2]), has_known).evidence
    eta, step = np.log([0.4, 1.5, 0.2]), 1e-5
    slopes = [(evidence.value(eta + d)[0] - evidence.value(eta - d)[0]) / (2.0 * step) for d in step * np.eye(3)]
    np.testing.assert_allclose(evidence.value(eta)[1], slopes, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("has_known", [False, True])
def test_its_curvature_is_exact(rng: np.random.Generator, has_known: bool) -> None:
    """Beside differences of the gradient."""
    evidence, eta = Drawn(rng, np.log([0.3, 2.0, 0.2]), has_known).evidence, np.log([0.2, 2.5, 0.4])
    steps = 1e-5 * np.eye(3)
    slopes = [evidence.value(eta + step)[1] - evidence.value(eta - step)[1] for step in steps]
    np.testing.assert_allclose(evidence.curvature(eta, np.arange(3)), np.array(slopes) / 2e-5, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("factor", [0.1, 10.0, 100.0])
def test_one_search_reaches_a_noise_that_is_far_off(rng: np.random.Generator, factor: float) -> None:
    """Many points tell their noise to a few per cent: in steps of so little it would take hundreds of them."""
    truth = np.log([0.3, 2.0, 0.5])
    evidence = Drawn(rng, truth).evidence
    near, far = evidence.maximum([truth]), evidence.maximum([truth + np.array([np.log(factor), 0.0, 0.0])])
    deviations = np.sqrt(np.diag(evidence.covariance(near)))
    assert np.abs((far - near) / deviations).max() < 0.2


def test_scales_that_data_were_drawn_with_are_found_within_their_doubt() -> None:
    truth, off = np.log([0.3, 2.0, 0.5]), []
    for seed in range(60):
        evidence = Drawn(np.random.default_rng(seed), truth).evidence
        found = evidence.maximum([np.log([1.0, 1.0, 0.1])])
        deviations = np.sqrt(np.diag(evidence.covariance(found)))
        assert np.abs(evidence.value(found)[1] * deviations).max() < 0.2  # of them, to the maximum
        off.append((found - truth) / deviations)
    scores = np.array(off)
    assert np.abs(scores.mean(axis=0)).max() < 0.45  # standard errors of 0.13, and the prior's pull
    assert ((scores**2).mean(axis=0) > 0.5).all() and ((scores**2).mean(axis=0) < 1.9).all()


def test_the_better_of_two_descents_counts(rng: np.random.Generator) -> None:
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2])).evidence
    starts = [np.log([3.0, 1e-3, 1e-3]), np.log([0.3, 2.0, 0.2])]
    both, values = evidence.maximum(starts), [evidence.value(evidence.maximum([start]))[0] for start in starts]
    assert evidence.value(both)[0] == pytest.approx(min(values), abs=0.01)


def test_scales_that_are_known_stay_and_bounds_hold(rng: np.random.Generator) -> None:
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2])).evidence
    priors = (LogNormalPrior(0.7, 0.0), LogNormalPrior(1.0, 1.0, maximum=0.5), NOISES[2])
    held = replace(evidence, hyperprior=Hyperprior.of(priors))
    found = held.maximum([np.log([1.0, 1.0, 0.1])])
    assert np.exp(found[:2]) == pytest.approx([0.7, 0.5])
    covariance = held.covariance(found)
    assert not covariance[:2].any() and covariance[2, 2] > 0.0  # at its bound a scale is taken as known
    raised = replace(held, hyperprior=evidence.hyperprior.with_minimum(0, np.log(0.9)))
    assert np.exp(raised.maximum([found])[0]) == pytest.approx(0.9)
    none = replace(evidence, hyperprior=Hyperprior.of([LogNormalPrior(0.7, 0.0)] * 3))
    assert np.exp(none.maximum([found])) == pytest.approx([0.7, 0.7, 0.7])
    assert not none.covariance(found).any()


def test_tails_that_weights_have_cut_off_count_as_noise(rng: np.random.Generator) -> None:
    drawn = Drawn(rng, np.log([0.3, 2.0, 0.2]))
    evidence = drawn.evidence
    plain = evidence.maximum([np.log([1.0, 1.0, 0.1])])
    squares = np.exp(noise_variances(plain)[0]) * evidence.problem.count
    with_tail = replace(evidence, problem=replace(evidence.problem, tail=0.21 * squares))
    grown = with_tail.maximum([plain])
    squared = np.exp(noise_variances(grown)[0] - noise_variances(plain)[0])
    assert squared == pytest.approx([1.21, 1.21], abs=0.05)


def test_unknowns_of_no_size_are_none(rng: np.random.Generator) -> None:
    """A variance of 1e-24 beforehand is no division by zero."""
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2])).evidence
    value, gradient = evidence.value(np.log([0.3, 2.0, 1e-12]))
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_a_scale_may_be_freer_below_its_median(rng: np.random.Generator) -> None:
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2])).evidence
    free = replace(NOISES[1], spread=0.25, spread_below=1.0)
    held = replace(evidence, hyperprior=Hyperprior.of([NOISES[0], free, NOISES[2]]))
    for factor, spread in ((2.0, 0.25), (0.5, 1.0)):
        eta, step = np.log([0.5, factor, 0.1]), 1e-5 * np.eye(3)[1]
        cost, gradient = held.hyperprior.cost(eta)
        assert cost == pytest.approx(0.5 * (np.log(factor) / spread) ** 2)
        slope = (held.hyperprior.cost(eta + step)[0] - held.hyperprior.cost(eta - step)[0]) / 2e-5
        assert gradient[1] == pytest.approx(slope, rel=1e-6)


def test_priors_say_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="spread_below: expected a positive number, got 0"):
        LogNormalPrior(1.0, 1.0, spread_below=0.0)
    with pytest.raises(ValueError, match="positive median"):
        LogNormalPrior(0.0, 1.0)
    with pytest.raises(ValueError, match="maximum: expected a positive number, got 0"):
        LogNormalPrior(1.0, 1.0, maximum=0.0)
    assert LogNormalPrior(1.0, 1.0).with_minimum(2.0).minimum == 2.0


def test_an_evidence_that_is_nowhere_finite_is_no_maximum(rng: np.random.Generator) -> None:
    """The start is not given back as if it were one."""
    drawn = Drawn(rng, np.log([0.3, 2.0, 0.2]))
    broken = replace(drawn.problem, information=-1e6 * drawn.problem.information)
    with pytest.raises(ArithmeticError, match="finite at none of the starts"):
        replace(drawn.evidence, problem=broken).maximum([np.log([0.3, 2.0, 0.2])])


def test_no_doubt_is_wider_than_what_was_believed(rng: np.random.Generator) -> None:
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2])).evidence
    found = evidence.covariance(evidence.maximum([np.log([0.3, 2.0, 0.2])]))
    assert (np.diag(found) <= np.square(evidence.hyperprior.spread) + 1e-12).all() and (np.diag(found) > 0.0).all()


@pytest.mark.parametrize("number", range(12))
def test_the_descent_ends_where_a_librarys_does(number: int) -> None:
    """Within bounds that hold some, on costs that bend differently from place to place."""
    rng = np.random.default_rng(number)
    size = int(rng.integers(1, 6))
    root, middle = rng.standard_normal((size, size)), 3.0 * rng.standard_normal(size)
    bend = 0.3 * np.eye(size) + root @ root.T / size

    def cost(place: np.ndarray) -> tuple[float, np.ndarray]:
        off = place - middle
        value = 0.5 * off @ bend @ off + np.cosh(0.3 * off).sum()
        return float(value), bend @ off + 0.3 * np.sinh(0.3 * off)

    low, high = -rng.uniform(0.0, 4.0, size), rng.uniform(0.0, 4.0, size)
    value, place = _descended(cost, cost(np.zeros(size)), low, high, np.full(size, 3.0))
    bounds = list(zip(low, high, strict=True))
    wanted = minimize(cost, np.zeros(size), jac=True, method="L-BFGS-B", bounds=bounds, options={"gtol": 1e-9})
    assert (place >= low).all() and (place <= high).all() and value == cost(place)[0]
    assert value <= wanted.fun + 0.05  # a slope of a tenth is left at most


def test_a_descent_steps_back_from_where_there_is_no_cost() -> None:
    def cost(place: np.ndarray) -> tuple[float, np.ndarray]:
        x = float(place[0])
        return (np.inf, np.zeros(1)) if x >= 1.0 else (float(-np.log(1.0 - x) - 3.0 * x), np.array([1 / (1 - x) - 3]))

    value, place = _descended(cost, cost(np.zeros(1)), np.array([-9.0]), np.array([9.0]), np.array([3.0]))
    assert place[0] == pytest.approx(2.0 / 3.0, abs=0.02) and np.isfinite(value)


def test_of_a_result_that_is_kept_one_law_is_kept(rng) -> None:
    evidence = Drawn(rng, np.log([0.3, 2.0, 0.2])).evidence
    found = evidence.maximum([np.log([1.0, 1.0, 1.0])])
    assert list(evidence._known) == [found.tobytes()]
    law = evidence.conditional(found)
    assert law is not None
    np.testing.assert_allclose(law.inverse @ evidence.scaled(found), np.eye(len(law.root)), atol=1e-9)
    change = rng.standard_normal(len(law.root))
    np.testing.assert_allclose(law.square(change), change @ np.linalg.solve(law.covariance, change), rtol=1e-9)


def test_below_its_median_a_scale_is_as_uncertain_as_was_believed_there() -> None:
    """Of data that tell nothing: above the median by the spread there, below it by that below."""
    nothing = LinearProblem(np.zeros((1, 2, 2)), np.zeros((1, 2)), np.zeros(1), np.zeros(1), np.zeros(1), None)
    believed = Hyperprior.of([LogNormalPrior(1.0, 0.25, spread_below=1.0)])

    def unmoved(eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(1), np.zeros((1, 1))

    def unit(eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(2), np.zeros((1, 2))

    evidence = Evidence(nothing, unmoved, unit, believed)
    for place, spread in ((0.1, 0.25), (-0.1, 1.0)):
        np.testing.assert_allclose(evidence.covariance(np.array([place])), [[spread**2]], rtol=1e-6)
