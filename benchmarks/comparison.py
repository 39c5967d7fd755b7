"""Two records of the same cases, side by side: which figure is worse by more than chance.

A case has the same name, the same truth and the same noise in both records, so most of what differs between cases
drops out of the difference that one case makes. That is why everything here is paired:

- Means (errors, seconds): the mean of the differences, new less old. Frames of a sequence and draws of one frame have
  much in common; they are one `group`, and the standard error is of groups (the cluster-robust sandwich), with
  Student's t of so many groups less one.
- Coverage: of each case the share of nodes that lie within the margin, a number in [0, 1] and not a count of
  independent trials: nodes of one case are right or wrong together. Its distance from the nominal level is linearised
  in the cases and has the same standard error.
- Yes or no (accepted and wrong, a right answer): McNemar's exact test of the cases that changed, a binomial of one
  half. It takes nothing from the many cases that are as before, and holds for two changed cases as for fifty.

Only cases that were answered (accepted or doubtful) in both records count for errors and coverage; that fewer are
answered is a figure of its own, so that nothing is gained by refusing what is hard. Where fewer than half of the cases
pair (another count, other truths since the twin is another), both records are held to be independent samples: Welch's
standard error, Fisher's exact test.

Worse is what is beyond chance at LEVEL, one-sided, and large enough to matter (`NEGLIGIBLE`, `NEGLIGIBLE_COVERAGE`): a
paired difference may be certain and of no account. One figure has no level: a single case more that is accepted and
wrong is worse. It is the mistake that harms, the cases are the same, and a false alarm costs a look at one named case.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binom, chi2, fisher_exact, t

Floats = NDArray[np.float64]
LEVEL = 0.01  # chance of an alarm where nothing has changed: two in two hundred figures
NEGLIGIBLE = 0.01  # of the old mean
NEGLIGIBLE_COVERAGE = 0.005  # half a point of a hundred
SAME_TRUTH = 0.01  # relative: the truth's displacement may differ by what the reference's tolerance makes of it
ANSWERED = ("accepted", "doubtful")
REGIONS = {share: float(chi2.ppf(share, 3)) for share in (0.9, 0.95)}  # squared radius of the net force's
HALF = 0.5  # of the nodes beyond their 95 % margin: what was said of the doubt misleads

# ---------------------------------------------------------------------- a case


@dataclass(frozen=True)
class Case:
    """One registration of a cloud whose truth is known.

    Args:
        name: of the case within its row; the same in every record.
        group: cases that have their truth, or much of it, in common.
        verdict: accepted, doubtful, refused, or failed where there is no state.
        wrong: whether to accept it is a mistake: the error is beyond the row's limit, or there is no right answer.
        moved_mm: mean displacement of the truth; tells whether two cases of one name are the same.
        error_mm: mean error of the nodes.
        inner_mm: mean error of vessels and tumour.
        force_off: error of the net force as a share of it.
        force_z2: squared error of the net force in the metric of its covariance: chi-square, three components.
        nodes: share of nodes that lie within their margin, by its level.
        inner: the same of the points of inner structures.
        seconds: wall time.
    """

    name: str
    group: str
    verdict: str
    wrong: bool = False
    moved_mm: float | None = None
    error_mm: float | None = None
    inner_mm: float | None = None
    force_off: float | None = None
    force_z2: float | None = None
    nodes: Mapping[str, float] = field(default_factory=dict)
    inner: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None

    @property
    def is_answered(self) -> bool:
        """Whether the result may be used at all."""
        return self.verdict in ANSWERED

    @property
    def is_accepted(self) -> bool:
        """Whether the result may be used without a doubt."""
        return self.verdict == "accepted"

    def as_entry(self) -> dict[str, Any]:
        """As a record has it: what is known alone, numbers to five digits."""
        return {name: _short(value) for name, value in asdict(self).items() if value not in (None, {}, False)}


def _short(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _short(each) for name, each in value.items()}
    return float(f"{value:.5g}") if isinstance(value, float) else value


# ---------------------------------------------------------------------- statistics


@dataclass(frozen=True)
class Estimate:
    """A mean with its standard error.

    Args:
        value: the mean.
        error: its standard error; infinite where one group does not tell it.
        freedom: groups less one.
    """

    value: float
    error: float
    freedom: int

    def is_above(self, least: float) -> bool:
        """Whether it is more than chance makes of nothing, and more than what matters."""
        if self.freedom < 1:
            return False
        return self.value > max(least, float(t.ppf(1.0 - LEVEL, self.freedom)) * self.error)

    def __neg__(self) -> Estimate:
        return Estimate(-self.value, self.error, self.freedom)


def mean_of(values: ArrayLike, groups: Sequence[Hashable]) -> Estimate:
    """Mean of values some of which belong together."""
    numbers = np.asarray(values, dtype=np.float64)
    mean = float(numbers.mean())
    places = {group: place for place, group in enumerate(dict.fromkeys(groups))}
    sums = np.bincount([places[group] for group in groups], weights=numbers - mean)
    count = len(places)
    if count < 2:
        return Estimate(mean, np.inf, 0)
    return Estimate(mean, float(np.sqrt(count / (count - 1.0) * (sums**2).sum())) / len(numbers), count - 1)


def apart(old: Estimate, new: Estimate) -> Estimate:
    """New less old, of samples that have nothing to do with each other."""
    return Estimate(new.value - old.value, float(np.hypot(old.error, new.error)), min(old.freedom, new.freedom))


def chance_of_more(more: int, fewer: int) -> float:
    """McNemar's exact test: chance that as many or more of the changed cases changed this way."""
    return float(binom.sf(more - 1, more + fewer, 0.5))


# ---------------------------------------------------------------------- pairs


@dataclass(frozen=True)
class Both:
    """The cases of a row in two records.

    Args:
        old: of the one.
        new: of the other.
        pairs: of both, where name and truth are the same.
    """

    old: tuple[Case, ...]
    new: tuple[Case, ...]
    pairs: tuple[tuple[Case, Case], ...]

    @property
    def is_paired(self) -> bool:
        """Whether differences of cases stand for the row."""
        return 2 * len(self.pairs) >= max(len(self.old), len(self.new))

    def kept(self, is_kept: Callable[[Case], bool]) -> Both:
        """What is kept of both; of a pair both have to be."""
        old, new = (tuple(filter(is_kept, each)) for each in (self.old, self.new))
        return Both(old, new, tuple(pair for pair in self.pairs if all(map(is_kept, pair))))


def paired(old: Sequence[Case], new: Sequence[Case]) -> Both:
    """Cases of the same name and the same truth, in the order of the new ones."""
    known = {case.name: case for case in old}
    pairs = [(known[case.name], case) for case in new if case.name in known]
    return Both(tuple(old), tuple(new), tuple(pair for pair in pairs if is_same(*pair)))


def is_same(one: Case, other: Case) -> bool:
    """Whether two cases of one name have the same truth."""
    if one.moved_mm is None or other.moved_mm is None:
        return one.moved_mm is other.moved_mm
    return bool(np.isclose(one.moved_mm, other.moved_mm, rtol=SAME_TRUTH, atol=1e-6))


# ---------------------------------------------------------------------- figures


@dataclass(frozen=True)
class Finding:
    """One figure in two records.

    Args:
        figure: its name.
        old: as it was.
        new: as it is.
        change: in words, with its sampling error.
        word: `same`, `better` or `worse`.
        is_guarded: whether worse is a failure.
        names: of cases that tell why, where there are such.
    """

    figure: str
    old: str
    new: str
    change: str
    word: str
    is_guarded: bool = True
    names: tuple[str, ...] = ()

    @property
    def fails(self) -> bool:
        """Whether it speaks against the new record."""
        return self.is_guarded and self.word == "worse"


@dataclass(frozen=True)
class Mean:
    """A mean over answered cases that had better be small.

    Args:
        name: of the figure.
        unit: as printed.
        value: of a case; None where it is not known.
        is_guarded: whether worse is a failure.
        factor: to the unit.
    """

    name: str
    unit: str
    value: Callable[[Case], float | None]
    is_guarded: bool = True
    factor: float = 1.0

    def compared(self, both: Both) -> Finding | None:
        """The figure in both records; None where no case of one has it."""
        both = both.kept(lambda case: case.is_answered and self.value(case) is not None)
        if not both.old or not both.new:
            return None
        old, new = (mean_of([self.value(c) for c in cases], groups(cases)) for cases in (both.old, both.new))
        change = apart(old, new)
        if both.is_paired:
            differences = [self.value(n) - self.value(o) for o, n in both.pairs]  # type: ignore[operator]
            change = mean_of(differences, groups(n for _, n in both.pairs))
        word = judged(change, NEGLIGIBLE * abs(old.value))
        return Finding(self.name, *self.printed(old, new, change), word, self.is_guarded)

    def shown(self, cases: Sequence[Case]) -> str:
        """The figure of one record."""
        cases = [case for case in cases if case.is_answered and self.value(case) is not None]
        return told(mean_of([self.value(case) for case in cases], groups(cases)), self.factor) if cases else "-"

    def printed(self, *estimates: Estimate) -> list[str]:
        """Each with its standard error."""
        return [f"{told(each, self.factor)} {self.unit}" for each in estimates]


@dataclass(frozen=True)
class Coverage:
    """A share over answered cases that had better be as large as was said.

    Args:
        name: of the figure.
        nominal: what was said.
        value: of a case, in [0, 1]; None where it is not known.
        unit: as printed.
    """

    name: str
    nominal: float
    value: Callable[[Case], float | None]
    unit: str = "%"

    def compared(self, both: Both) -> Finding | None:
        """The figure in both records; None where no case of one has it."""
        both = both.kept(lambda case: case.is_answered and self.value(case) is not None)
        if not both.old or not both.new:
            return None
        old, new = (mean_of(self.values(cases), groups(cases)) for cases in (both.old, both.new))
        change = self.farther(both, old, new)
        says = f"{told(change, 100.0)} points farther from {self.nominal:.0%}"
        word = judged(change, NEGLIGIBLE_COVERAGE)
        return Finding(self.name, f"{told(old, 100.0)} %", f"{told(new, 100.0)} %", says, word)

    def shown(self, cases: Sequence[Case]) -> str:
        """The figure of one record."""
        return Mean(self.name, self.unit, self.value, factor=100.0).shown(cases)

    def farther(self, both: Both, old: Estimate, new: Estimate) -> Estimate:
        """By how much the new share is farther from what was said than the old one."""
        if not both.is_paired:
            distance = abs(new.value - self.nominal) - abs(old.value - self.nominal)
            return Estimate(distance, apart(old, new).error, apart(old, new).freedom)
        was, now = (self.values([pair[place] for pair in both.pairs]) for place in (0, 1))
        distance = abs(now.mean() - self.nominal) - abs(was.mean() - self.nominal)
        # To first order a share's distance from the level changes as the share does, with the sign of its side.
        moves = [np.sign(share.mean() - self.nominal) * (share - share.mean()) for share in (was, now)]
        spread = mean_of(moves[1] - moves[0], groups(n for _, n in both.pairs))
        return Estimate(float(distance), spread.error, spread.freedom)

    def values(self, cases: Sequence[Case]) -> Floats:
        """Of each case."""
        return np.array([self.value(case) for case in cases], dtype=np.float64)


@dataclass(frozen=True)
class Count:
    """How many cases are so.

    Args:
        name: of the figure.
        is_so: of a case.
        is_good: whether more had better be so.
        level: chance of an alarm where nothing has changed; 1: any change to the worse is one.
        is_guarded: whether worse is a failure.
        unit: as printed.
    """

    name: str
    is_so: Callable[[Case], bool]
    is_good: bool = False
    level: float = LEVEL
    is_guarded: bool = True
    unit: str = ""

    def compared(self, both: Both) -> Finding | None:
        """The figure in both records."""
        old, new = (sum(map(self.is_so, cases)) for cases in (both.old, both.new))
        texts = self.shown(both.old), self.shown(both.new)
        begun = tuple(n.name for o, n in both.pairs if self.is_so(n) and not self.is_so(o))
        ended = tuple(n.name for o, n in both.pairs if self.is_so(o) and not self.is_so(n))
        more, fewer = len(begun), len(ended)
        up, down = chance_of_more(more, fewer), chance_of_more(fewer, more)
        if not both.is_paired:
            table = [[new, len(both.new) - new], [old, len(both.old) - old]]
            more, fewer = new * len(both.old), old * len(both.new)
            up, down = (float(fisher_exact(table, alternative=way)[1]) for way in ("greater", "less"))
        rises, falls = more > fewer and up <= self.level, fewer > more and down <= self.level
        worse, better = (falls, rises) if self.is_good else (rises, falls)
        chance = min(up, down)
        says = f"+{len(begun)} -{len(ended)}, p {chance:.2g}" if both.is_paired else f"not paired, p {chance:.2g}"
        word = "worse" if worse else "better" if better else "same"
        names = (ended if self.is_good else begun) if worse else ()
        return Finding(self.name, *texts, says, word, self.is_guarded, names)

    def shown(self, cases: Sequence[Case]) -> str:
        """The figure of one record."""
        return f"{sum(map(self.is_so, cases))} of {len(cases)}"


Figure = Mean | Coverage | Count


def groups(cases: Iterable[Case]) -> list[str]:
    """Of each case."""
    return [case.group for case in cases]


def judged(change: Estimate, least: float) -> str:
    """Whether a change for the larger is one for the worse, for the better, or none."""
    return "worse" if change.is_above(least) else "better" if (-change).is_above(least) else "same"


def told(estimate: Estimate, factor: float = 1.0) -> str:
    """A mean with its standard error."""
    return f"{factor * estimate.value:.4g} +- {factor * estimate.error:.2g}"


def within(case: Case, share: float) -> float | None:
    """Whether the net force lies in its region, 1 or 0."""
    return None if case.force_z2 is None else float(case.force_z2 <= REGIONS[share])


FIGURES: tuple[Figure, ...] = (
    Mean("error", "mm", lambda case: case.error_mm),
    Mean("inner error", "mm", lambda case: case.inner_mm),
    Mean("net force off", "%", lambda case: case.force_off, factor=100.0),
    *(Coverage(f"nodes in {s} margin", float(s), lambda case, s=s: case.nodes.get(s)) for s in ("0.9", "0.95")),  # type: ignore[misc]
    *(Coverage(f"inner in {s} margin", float(s), lambda case, s=s: case.inner.get(s)) for s in ("0.9", "0.95")),  # type: ignore[misc]
    *(Coverage(f"net force in {s} region", s, lambda case, s=s: within(case, s)) for s in (0.9, 0.95)),  # type: ignore[misc]
    Count("accepted and wrong", lambda case: case.is_accepted and case.wrong, level=1.0),
    Count("accepted, most nodes beyond", lambda case: case.is_accepted and case.nodes.get("0.95", 1.0) < HALF),
    Count("right answers", lambda case: case.is_answered and not case.wrong, is_good=True),
    Count("accepted", lambda case: case.is_accepted, is_good=True, is_guarded=False),
    Mean("seconds", "s", lambda case: case.seconds, is_guarded=False),
)

# ---------------------------------------------------------------------- rows


@dataclass(frozen=True)
class RowFinding:
    """One row in two records.

    Args:
        row: its name.
        said: of the row as a whole: that it is missing, that few of its cases pair.
        findings: of its figures.
        is_missing: whether the new record lacks it.
    """

    row: str
    said: str
    findings: tuple[Finding, ...] = ()
    is_missing: bool = False

    @property
    def fails(self) -> bool:
        """Whether it speaks against the new record."""
        return self.is_missing or any(finding.fails for finding in self.findings)

    @property
    def verdict(self) -> str:
        """In one line."""
        if self.is_missing:
            return "MISSING"
        worse = ", ".join(finding.figure for finding in self.findings if finding.fails)
        better = ", ".join(each.figure for each in self.findings if each.word == "better" and each.is_guarded)
        told = "; ".join(filter(None, (f"WORSE: {worse}" if worse else "", f"better: {better}" if better else "")))
        return told or "holds"


def cases_of(row: Mapping[str, Any]) -> tuple[Case, ...]:
    """The cases of a recorded row; none of one that is not guarded."""
    return tuple(Case(**entry) for entry in row.get("cases", ()))


def compared_row(name: str, old: Mapping[str, Any] | None, new: Mapping[str, Any] | None) -> RowFinding:
    """One row of both records; where a record lacks it that is said, and where the new one does it fails."""
    if new is None:
        return RowFinding(name, "the new record lacks this row", is_missing=True)
    if old is None:
        return RowFinding(name, "the old record lacks this row")
    both = paired(cases_of(old), cases_of(new))
    if not both.old or not both.new:
        return RowFinding(name, "the new record has no case" if both.old else "not guarded", is_missing=bool(both.old))
    said = [f"{len(both.pairs)} of {len(both.old)} and {len(both.new)} cases pair"]
    said += [] if both.is_paired else ["TAKEN AS INDEPENDENT SAMPLES"]
    said += [] if old.get("twin") == new.get("twin") else ["another twin"]
    findings = (figure.compared(both) for figure in FIGURES)
    return RowFinding(name, "; ".join(said), tuple(finding for finding in findings if finding is not None))


def compared(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[RowFinding]:
    """All rows of two records, those of the old one first."""
    return [compared_row(name, old.get(name), new.get(name)) for name in dict.fromkeys((*old, *new))]
