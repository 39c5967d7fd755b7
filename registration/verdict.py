"""Whether a registration can be used: a verdict, and the checks that it is made of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri


class Verdict(Enum):
    """What a result may be used for."""

    ACCEPTED = "accepted"
    DOUBTFUL = "doubtful"
    REFUSED = "refused"


class Code(Enum):
    """What a check looks at; the value is its name in records."""

    CONVERGENCE = "convergence"
    POINT_COUNT = "point_count"
    CLOUD_SHAPE = "cloud_shape"
    INFORMATION = "information"
    MISFIT = "misfit"
    SPATIAL_CORRELATION = "spatial_correlation"
    OUTLIERS = "outliers"
    FOREIGN_SURFACE = "foreign_surface"
    MOVEMENT = "movement"
    LINEAR_LAW = "linear_law"
    LOAD = "load"
    STABILITY = "stability"
    DISCREPANCY_SCALE = "discrepancy_scale"
    POSE = "pose"
    EXACT_POSE = "exact_pose"
    SCALE = "scale"
    PARAMETER = "parameter"
    IDENTIFIABILITY = "identifiability"
    LANDMARKS = "landmarks"
    NORMALS = "normals"
    FORCES_ELSEWHERE = "forces_elsewhere"
    CONTACT = "contact"
    TRACKING = "tracking"
    RESIDUAL_TERM = "residual_term"


@dataclass(frozen=True)
class Check:
    """One look at a result: what was found, and from where on that is too much.

    Args:
        code: what is looked at.
        verdict: what the result may be used for by this check alone.
        statistic: what was found.
        level: the result is doubtful where the statistic is beyond it; None where the statistic alone does not decide.
        unit: of both; none for numbers and shares.
        is_minimum: the level is the least that is enough, and not the most.
        law: what the statistic is distributed like where the model is right; empty where that is not known.
        p_value: chance under that law of a statistic as far out; None where it is not known.
        subject: which of several it is about, an unknown or a landmark.
        reason: what is wrong and what to do, in a sentence; empty where nothing is.
        refusal_level: beyond it the result is of no use; None where it is doubtful at worst.
    """

    code: Code
    verdict: Verdict
    statistic: float
    level: float | None
    unit: str = ""
    is_minimum: bool = False
    law: str = ""
    p_value: float | None = None
    subject: str = ""
    reason: str = ""
    refusal_level: float | None = None

    @property
    def is_passed(self) -> bool:
        """Whether nothing is wrong."""
        return self.verdict is Verdict.ACCEPTED

    def figures(self) -> dict[str, Any]:
        """All of it in words and numbers, for a record; what is empty is left out."""
        entries = asdict(self) | {"code": self.code.value, "verdict": self.verdict.value}
        return {
            name: value for name, value in entries.items() if value is not None and value != "" and value is not False
        }


@dataclass(frozen=True)
class Judgement:
    """A verdict with its reasons.

    Args:
        verdict: the worst of what was found.
        reasons: one sentence each, the gravest first, but for those of checks that were added later; none where it
            is accepted.
        checks: all that were made, passed ones too; none where nothing was registered.
    """

    verdict: Verdict
    reasons: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()

    @classmethod
    def of(cls, checks: tuple[Check, ...], first: Code | None = None) -> Judgement:
        """The worst of some checks.

        Args:
            checks: in the order in which their reasons are given, where they are as grave.
            first: of which the reason comes first, however grave: whatever else is wrong may come of it.
        """
        failed = [check for check in checks if not check.is_passed]
        if not failed:
            return cls(Verdict.ACCEPTED, (), checks)
        failed.sort(key=lambda check: check.verdict is not Verdict.REFUSED)
        worst = failed[0].verdict
        failed.sort(key=lambda check: check.code is not first)
        return cls(worst, tuple(check.reason for check in failed), checks)

    def with_check(self, check: Check) -> Judgement:
        """The same with a check more, whose reason comes last; what is refused stays so."""
        reasons = self.reasons if check.is_passed else (*self.reasons, check.reason)
        order = list(Verdict)
        worst = max(self.verdict, check.verdict, key=order.index)
        return Judgement(worst, reasons, (*self.checks, check))

    @property
    def is_usable(self) -> bool:
        """True unless it is refused."""
        return self.verdict is not Verdict.REFUSED


def checked(
    code: Code,
    statistic: float,
    level: float,
    reason: str,
    *,
    refused: float | None = None,
    unit: str = "",
    is_minimum: bool = False,
    law: tuple[str, float] | None = None,
    subject: str = "",
) -> Check:
    """A check that is passed up to a level.

    Args:
        code: what is looked at.
        statistic: what was found.
        level: what is beyond is doubtful.
        reason: that is given then.
        refused: level beyond which the result is of no use; None for none.
        unit: of both.
        is_minimum: the level is the least that is enough: what is below it is beyond.
        law: what the statistic is distributed like where the model is right, and the chance of one as far out.
        subject: which of several it is about.
    """
    sign = -1.0 if is_minimum else 1.0
    verdict = Verdict.ACCEPTED
    if not sign * statistic <= sign * level:
        verdict = Verdict.REFUSED if refused is not None and sign * statistic > sign * refused else Verdict.DOUBTFUL
    reason = "" if verdict is Verdict.ACCEPTED else reason
    name, chance = law or ("", None)
    beyond = None if refused is None else float(refused)
    return Check(code, verdict, float(statistic), float(level), unit, is_minimum, name, chance, subject, reason, beyond)


def largest_normal(value: float, count: int) -> tuple[str, float]:
    """The chance of so large a deviation, the largest of several by their standard normal law."""
    chance = of_several(2.0 * float(ndtr(-value)), count)
    return f"largest of {count} standard normal deviations" if count > 1 else "standard normal", chance


def of_several(chance: float, count: int) -> float:
    """The chance that the largest of so many is as far out, where one is with a chance."""
    return 1.0 if chance >= 1.0 else float(-np.expm1(count * np.log1p(-chance)))


def one_of_several(chance: float, count: int) -> float:
    """The chance of one, where the largest of so many is as far out with a chance: the inverse of `of_several`."""
    return float(-np.expm1(np.log1p(-chance) / count))


def normal_level(chance: float, count: int = 1) -> float:
    """Deviations beyond which the largest of several standard normal numbers, of either sign, lies with a chance."""
    return float(-ndtri(0.5 * one_of_several(chance, count)))
