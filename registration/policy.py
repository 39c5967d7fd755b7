"""Numbers of the registration that are choices: what each means, where it comes from, in three tables.

Answers depend on those of `POLICY`: who changes one runs `benchmarks/guards.py` before and after. Those of `ACCURACY`
say how closely something is computed, or how much of it is looked at: with more of it time changes more than answers
do. `benchmarks/policy.py` says of each of these what happens at half and at twice its value. `RIGID` has those of the
search for a pose that nobody gave, which `benchmarks/alignment.py` measures as a whole.
Constants of the literature (Huber's 1.345, the rules of a trust region) stand where they are used, with their source.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields

import numpy as np
from scipy.special import ndtri

_CHANCE = "chance"  # unit of one


def choice(value: float, unit: str, meaning: str, source: str = "") -> float:
    """A number with what a reader wants to know of it.

    Args:
        value: of it.
        unit: of that; empty for none.
        meaning: what it is.
        source: the benchmark's row or the paper that it comes from.
    """
    found: float = field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source})
    return found


def count(value: int, unit: str, meaning: str, source: str = "") -> int:
    """The same of a whole number."""
    found: int = field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source})
    return found


@dataclass(frozen=True)
class Policy:
    """Choices that answers depend on; `dataclasses.fields` tells unit, meaning and source of each."""

    # What is believed of the points' noise, and of what neighbours share of it.
    noise_spread: float = choice(
        1.5, "", "standard deviation of the logarithm of the points' noise", "robustness, noise 0.1 to 5 mm"
    )
    noise_minimum: float = choice(1e-4, "m", "least noise of a point: no camera is better", "robustness: clean")
    shared_size: float = choice(
        2e-6,
        "m",
        "median of the noise that neighbours share, beforehand: none, unless a cloud shows some",
        "a cloud without any keeps it, and loses nothing of its margins by it: calibration, liver",
    )
    shared_size_spread: float = choice(
        3.0,
        "",
        "standard deviation of its logarithm: half a millimetre costs 1.7 in the logarithm of the evidence",
        "misspecified, noise that neighbours share",
    )
    shared_length: float = choice(
        0.15,
        "of the root of the observed area",
        "median of the length over which neighbours share it",
        "misspecified, noise that neighbours share",
    )
    shared_length_spread: float = choice(
        0.5, "", "standard deviation of its logarithm", "misspecified, noise that neighbours share"
    )

    # What is believed of the model's error.
    discrepancy_spread: float = choice(
        0.25,
        "",
        "standard deviation of the logarithm of what the model gets wrong over what it was seen to",
        "foreign_patches, raised by 10 mm: with 0.5 three of twelve frames take the patch for the model's error",
    )
    discrepancy_spread_below: float = choice(
        1.0,
        "",
        "the same where the model gets less wrong than was seen, at a state near those that it knows well",
        "misspecified, ensemble, ratio 0.45 to 0.49: with 0.25 the error is 0.25 in place of 0.22 mm",
    )
    discrepancy_minimum: float = choice(
        0.5,
        "times what was seen",
        "least of it",
        "robustness, surrogate (0.3, 0.5, 0.75): clean 0.229, 0.225, 0.238 mm; pose off 0.50, 0.39, 0.39 mm",
    )
    discrepancy_in_margins: float = choice(
        0.3,
        "of its logarithm",
        "part of a scale found below 1 that margins believe: forces explain some of what the model gets wrong",
        "guards: robustness, surrogate: nodes in their margins; 0 holds too many of a clean cloud; with 0.6 the net "
        "force's region is too small",
    )

    # What is believed of the forces.
    force_size: float = choice(
        0.01, "of Young's modulus times a squared edge", "median of a nodal force's size", "robustness, surrogate"
    )
    force_spread: float = choice(
        0.5,
        "",
        "standard deviation of the logarithm of a nodal force's size: with more, forces explain noise",
        "guards: robustness, surrogate, no zone, noise 1 mm; misspecified, surrogate: as it is",
    )
    force_reach: float = choice(
        0.02,
        "sizes of the body",
        "forces within it are gathered together: with more, their uncertainty is larger than their error",
        "robustness: no zone",
    )
    rounds: int = count(2, "", "reweighting rounds", "policy")

    # From where on a result is doubtful; refused, where that is possible, beyond `excess` times the level.
    unlikely: float = choice(
        2.7e-3,
        _CHANCE,
        "chance of what lies too far from where it was expected: three standard deviations of one number",
        "verdict, right clouds",
    )
    unlikely_score: float = choice(
        1e-5,
        _CHANCE,
        "the same of scores of pose and further terms: forces localised by the cloud that they explain leave more than "
        "chi-square has",
        "verdict, right clouds",
    )
    misfit: float = choice(
        0.025,
        "sizes of the body",
        "most of the points' noise, where three times what was expected is less, and of what neighbours share of it: "
        "what is more is another place or another shape",
        "verdict; foreign_patches, raised by 5 mm",
    )
    misfit_shared: float = choice(
        0.005,
        "sizes of the body",
        "most of what neighbours still share of the distances left, where what was expected is less",
        "verdict",
    )
    movement: float = choice(0.35, "sizes of the body", "largest movement of a node", "largest in liver data: 0.2")
    outliers: float = choice(0.4, "", "largest share of points that may fit nowhere", "robustness: outliers")
    foreign: float = choice(0.2, "", "share of them from which on they may not form a surface", "foreign_patches")
    load: float = choice(1.2, "times the largest that was learned", "largest load of a network", "learning_limits")
    minimum_points: float = choice(30, "points", "fewest of a cloud", "verdict: few points")
    minimum_directions: float = choice(
        2.0, "directions", "fewest of what is unknown that a cloud tells", "verdict: few points"
    )
    line: float = choice(0.02, "of its length", "width of a cloud that is taken for a line", "geometry")
    thin: float = choice(0.05, "of the spread", "thickness of points that form a surface: 0.1 of a space", "outliers")
    linear: float = choice(
        0.03, "radians, strain", "largest turn or stretch of a linear law: half of it is off by", "linear_response"
    )
    excess: float = choice(
        1.5,
        "times what was to be expected",
        "so much above a level no result is of use; so much more than it was seen to be, the model's error explains "
        "nothing; at so much larger distances than in the last frame a cloud is searched for from rest",
        "verdict: another organ, patch of 30 % by 10 mm; liver sequences: frames of changed places of force",
    )
    elsewhere: float = choice(
        0.5,
        "of the distances left",
        "less of them left with forces elsewhere, or with one contact not: forces act otherwise than was said",
        "contact, robustness: no zone",
    )

    @property
    def shared_length_maximum(self) -> float:
        """Longest length of shared noise, in medians: two standard deviations; longer ones are movements."""
        return float(np.exp(2.0 * self.shared_length_spread))

    @property
    def deviations(self) -> float:
        """How many standard deviations of one number are as unlikely."""
        return -float(ndtri(0.5 * self.unlikely))


@dataclass(frozen=True)
class Accuracy:
    """How closely, or how much of it: with more, time changes more than answers do; the table says how much."""

    settled: float = choice(
        0.1, "posterior deviations a coefficient", "the search has ended where so much is left after one more step"
    )
    enough: float = choice(
        0.3,
        "posterior deviations a coefficient",
        "so has one that lowers the objective no further before a longer step",
    )
    slowest: float = choice(
        0.75,
        "of the length of the step before",
        "most that the next step is taken to have: closest points jump, and steps do not shrink for ever",
    )
    handed_on: float = choice(
        1.0,
        "posterior deviations a coefficient",
        "a shorter step ends the search with a first loss; no longer one is last",
    )
    graduation: float = choice(1.0, "of what a step promises to change", "least noise far from the minimum")
    first_step: float = choice(0.05, "sizes of the body", "first limit on the movement of a node in one step")
    iterations: int = count(40, "", "most iterations of Gauss-Newton")
    few_iterations: int = count(8, "", "most for a start, and before noise that neighbours share is thought of")
    kept: float = choice(
        0.2, "of what a step promised", "derivatives are kept, or mended, after a step that missed it by less"
    )
    summed: float = choice(0.02, "of all weights", "points are summed anew where weights have changed by more")
    groups: int = count(6, "", "groups of points by how far the model's error makes them doubtful")
    lengths: int = count(5, "", "lengths of shared noise that are looked at")
    sizes: int = count(40, "", "sizes of it")
    first_modes: int = count(20, "", "of these are asked first")
    worth: float = choice(
        3.0,
        "of the logarithm of the evidence",
        "least gain by noise that neighbours share for which it is sought: strong (Kass and Raftery 1995)",
        "misspecified, noise that neighbours share",
    )
    shared_length_minimum: float = choice(
        1.75, "edges of the surface", "least of it: shorter fields are those of the mesh", "liver_engines, remeshed"
    )
    force_elsewhere: float = choice(
        0.005,
        "of the size at the place where forces were found",
        "size of forces elsewhere, where no zone is told: large ones at the place would make them free everywhere",
        "robustness, surrogate: no zone, clean; four times as much makes it worse, a fifth of it does not matter",
    )
    force_size_maximum: float = choice(
        10.0, "times the size expected", "forces so large decide which directions a cloud may tell"
    )
    surface_modes: int = count(48, "", "modes of the observed surface for each component of shared noise", "policy")
    few_points: int = count(300, "", "points of a cloud that look for the place of the forces", "policy")
    carried: float = choice(0.9, "of its variance", "what modes carry of a model's error beside its patterns")
    points: int = count(1000, "", "larger clouds are thinned to so many points")
    leading: int = count(
        4,
        "",
        "directions of force that a cold start begins with",
        "guards: robustness, surrogate, no zone, noise 1 mm: with six the wrong of two states of one sequence",
    )
    expansion_points: int = count(3, "", "exact states from which a fast model, or the tangent of one, goes on")
    far: float = choice(
        3.0, "times its noise", "so far from the last frame, a cloud may lie nearer to the body at rest"
    )
    glance: int = count(100, "", "points that this is seen from")
    searching: float = choice(0.7, "of the time left for a frame", "that a search from rest may take")
    watched: int = count(300, "", "nodes whose movement limits a step")
    drawn: int = count(64, "", "combinations that stand for directions of force that were left out")
    neighbours: int = count(6, "", "of a point, of which it is seen what they share")
    asked: int = count(250, "", "points whose neighbours are looked at")
    looked_at: int = count(4, "times the points wanted", "points of a large cloud, drawn evenly, that are looked at")
    counted: int = count(1000, "", "of them, among which the density is counted")
    dense_within: float = choice(
        0.05,
        "of the cloud's extent",
        "how far it is counted: far more than noise, so that points in front of the surface count as those on it",
    )
    sparse: float = choice(
        0.5,
        "of the lower quartile of the density",
        "thinner places are favoured the less, outliers least of all",
    )


@dataclass(frozen=True)
class Rigid:
    """The search for a pose that nobody gave: lengths in sizes of the organ, the diagonal of its bounding box."""

    minimum_points: int = count(20, "", "points of a cloud that a pose is sought for")
    samples: int = count(6000, "", "of the surface: 3.5 mm apart on a liver, and the planes in them bridge the gaps")
    neighbours: int = count(12, "", "samples through which each of these planes is laid")
    cloud_points: int = count(160, "", "of the cloud at the end; more change nothing, the organ's deformation rules")
    early_points: int = count(80, "", "of the cloud before that")
    every: int = count(2, "", "one of so many of these is looked at where starts are chosen")
    voxels: int = count(56, "", "along the organ's size, by which it is looked up what is near")
    margin: float = choice(0.2, "sizes of the organ", "how far beyond the organ these reach")
    rotations: int = count(400, "", "of the cloud that are tried, spread evenly")
    patches: int = count(32, "", "of the surface on which the cloud's middle is put")
    starts: int = count(400, "", "best of both that are brought closer")
    refined: int = count(40, "", "best of these that are refined")
    places: int = count(12, "", "of the organ by which two poses are told apart")
    scales: tuple[float, ...] = field(
        default=(0.12, 0.10, 0.08, 0.08, 0.06, 0.06, 0.05, 0.05, 0.04, 0.04),
        metadata={"unit": "sizes of the organ", "meaning": "scales of the robust loss, step by step", "source": ""},
    )
    scale: float = choice(
        0.03, "sizes of the organ", "last of them: a liver moves by 5 to 10 mm at an operation", "alignment"
    )
    last_steps: int = count(8, "", "steps with it")
    sliding: float = choice(0.03, "", "weight of distances along the surface: flat patches do not run away")
    damping: float = choice(1e-5, "of the trace", "of a step")
    distinct: float = choice(
        0.07,
        "sizes of the organ",
        "two poses are two where they place it so far apart: 20 mm on a liver",
        "alignment",
    )
    unique: float = choice(
        1.3, "", "another pose, or a mirror image, must explain the cloud this many times worse", "alignment"
    )
    mirrored: float = choice(
        1.5, "", "a mirror image is named where it explains the cloud this many times better", "alignment"
    )
    inliers: float = choice(
        0.6, "", "share of the points within the last scale, below which nothing matches", "alignment"
    )
    floor: float = choice(1e-3, "", "of a misfit: points 1 mm off a liver, which samples cannot tell from none")


POLICY, ACCURACY, RIGID = Policy(), Accuracy(), Rigid()


@contextmanager
def varied(name: str, factor: float) -> Iterator[None]:
    """A number times a factor, for who looks at what it does; registrars are to be made within.

    Args:
        name: of it, in either table.
        factor: that it is multiplied with; of a chance its logarithm is, of a whole number the result is rounded.
    """
    table = POLICY if name in {each.name for each in fields(POLICY)} else ACCURACY
    before = getattr(table, name)
    changed = type(before)(max(1, round(before * factor))) if isinstance(before, int) else before * factor
    if next(each.metadata["unit"] for each in fields(table) if each.name == name) == _CHANCE:
        changed = before**factor
    object.__setattr__(table, name, changed)
    try:
        yield
    finally:
        object.__setattr__(table, name, before)
