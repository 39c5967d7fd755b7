"""Numbers of the registration that are choices: what each means, where it comes from, in one table.

Who changes one runs `benchmarks/guards.py` before and after. Numbers that are not here yet stand at the head of the
file that uses them.
"""

from __future__ import annotations

from dataclasses import dataclass, field


def choice(value: float, unit: str, meaning: str, source: str) -> float:
    """A number with what a reader wants to know of it."""
    found: float = field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source})
    return found


@dataclass(frozen=True)
class Policy:
    """All of them; `dataclasses.fields` tells unit, meaning and source of each."""

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
    shared_size_maximum: float = choice(
        5e-3, "m", "most of it: what is more is another place or another shape", "foreign_patches, raised by 5 mm"
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
    shared_length_maximum: float = choice(
        3.0, "times the median", "most of it: a field over all of the side is a movement", "pose_noise"
    )
    shared_length_minimum: float = choice(
        1.75, "edges of the surface", "least of it: shorter fields are those of the mesh", "liver_engines, remeshed"
    )
    surface_modes: int = choice(  # type: ignore[assignment]
        48,
        "",
        "modes of the observed side in which each component of it is described",
        "misspecified, noise that neighbours share: 128 of one field along normals held 55 % of 90, not 91 %",
    )
    discrepancy_spread: float = choice(
        0.25,
        "",
        "standard deviation of the logarithm of what the model gets wrong over what it was seen to",
        "foreign_patches, raised by 10 mm: with 0.5 three of twelve frames take the patch for the model's error",
    )
    discrepancy_spread_below: float = choice(
        1.0,
        "",
        "the same where it gets less wrong: a state near those that it knows well",
        "misspecified, ensemble, ratio 0.45 to 0.49: with 0.25 the error is 0.25 in place of 0.22 mm",
    )
    discrepancy_minimum: float = choice(
        0.5,
        "times what was seen",
        "least of it",
        "robustness, surrogate (0.3, 0.5, 0.75): clean 0.229, 0.225, 0.238 mm; pose off 0.50, 0.39, 0.39 mm",
    )
    discrepancy_maximum: float = choice(10.0, "times what was seen", "most of it", "misspecified, modulus 50 % off")
    discrepancy_in_margins: float = choice(
        0.3,
        "of its logarithm",
        "part of a scale found below 1 that margins believe: forces explain some of what the model gets wrong",
        "robustness, surrogate: nodes in their margins; 0 holds too many of a clean cloud, 0.5 too few",
    )
    discrepancy_along_normal: float = choice(
        3.0,
        "times the variance of a component",
        "variance of a distance by what the model's patterns leave out: all of it may lie along the normal",
        "robustness, surrogate: clean; errors of a network are largest across the surface that is pulled",
    )
    force_spread: float = choice(
        0.35,
        "",
        "standard deviation of the logarithm of a nodal force's size: with more, forces explain noise",
        "robustness, surrogate: noise 5 mm (0.35, 0.5, 1.0: 0.52, 0.54, 0.64 mm)",
    )
    force_spread_anywhere: float = choice(
        0.7,
        "",
        "the same of a model that errs, where no zone is told: forces gathered at a small place are larger",
        "misspecified, surrogate: as it is; smaller values make it worse",
    )
    force_elsewhere: float = choice(
        0.005,
        "of the size at the place where forces were found",
        "size of forces elsewhere, where no zone is told: large ones at the place would make them free everywhere",
        "robustness, surrogate: no zone, clean; four times as much makes it worse, a fifth of it does not matter",
    )


POLICY = Policy()
