"""What a cloud does not tell: unknowns that do the same to what is seen are told together and not apart, and named."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.registration.parameters.identifiability import uninformed
from softtwin.registration.parameters.inputs import InputBlocks
from softtwin.registration.parameters.poisson_ratio import PoissonRatio
from softtwin.registration.parameters.young_modulus import YoungModulus
from softtwin.registration.registrar import prepare
from softtwin.registration.result import Registration
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, cloud_on

MODULUS, PULL = 4000.0, 0.15  # pascals; metres that the tip moves where both halves have that modulus


@dataclass(frozen=True, eq=False)
class TwoSprings:
    """A state of two springs in a row under a known pull: the tip moves by both compliances, in known parts."""

    shape: np.ndarray
    cells: tuple[np.ndarray, np.ndarray]
    parts: tuple[float, float]
    moduli: np.ndarray
    negative_pivots: int | None = None
    extrapolation_ratio: float | None = None

    @property
    def displacement(self) -> np.ndarray:
        stretch = sum(part * MODULUS / self.moduli[own[0]] for part, own in zip(self.parts, self.cells, strict=True))
        return PULL * stretch * self.shape[:, None] * np.array([0.0, 0.0, -1.0])

    def jvp(self, changes: ArrayLike) -> np.ndarray:
        return np.zeros_like(np.asarray(changes))

    def jvp_inputs(self, changes: list[Change]) -> np.ndarray:
        found = np.zeros((self.shape.size * 3, len(changes)))
        for place, change in enumerate(changes):
            slopes = change.parameters["young_modulus"]
            softer = sum(
                -part * MODULUS * slopes[own[0]] / self.moduli[own[0]] ** 2
                for part, own in zip(self.parts, self.cells, strict=True)
            )
            found[:, place] = (PULL * softer * self.shape[:, None] * np.array([0.0, 0.0, -1.0])).ravel()
        return found


class SpringModel(Cantilever):
    """Both halves as springs, of which the shape of the whole shows the sum alone."""

    def __init__(self, body: Body, parts: tuple[float, float]) -> None:
        super().__init__(body)
        self.parts = parts

    def solve(self, forces: ArrayLike, near: Any = None, inputs: Inputs | None = None) -> TwoSprings:
        assert inputs is not None
        moduli = np.broadcast_to(inputs.parameters["young_modulus"], (len(self.body.cells),))
        return TwoSprings(self._shape, halves(self.body), self.parts, moduli)


def halves(body: Body) -> tuple[np.ndarray, np.ndarray]:
    far = body.points[body.cells].mean(axis=1)[:, 0] > 0.4
    return np.flatnonzero(~far), np.flatnonzero(far)


def registered(body: Body, parts: tuple[float, float], unknowns: tuple, rng: np.random.Generator) -> Registration:
    model = SpringModel(body, parts)
    input_blocks = InputBlocks(body, {"young_modulus": np.full(len(body.cells), MODULUS)}, unknowns)
    registrar = prepare(model, None, body.surfaces["observed"], force_scale=1.0, inputs=input_blocks)
    truth = model.solve(0.0, None, input_blocks.inputs(np.full(input_blocks.size, 0.1))).displacement
    return registrar.register(cloud_on(body, truth, 600, rng, 5e-4))


def test_a_collinear_pair_is_named_and_neither_of_them_alone(body: Body, rng: np.random.Generator) -> None:
    near, far = halves(body)
    found = registered(body, (0.5, 0.5), (YoungModulus(0.5, near, "root"), YoungModulus(0.5, far, "tumour")), rng)
    assert found.judgement.verdict is Verdict.DOUBTFUL
    (reason,) = found.judgement.reasons
    assert "does not tell Young's modulus of" in reason and " against Young's modulus of " in reason
    assert "root" in reason and "tumour" in reason
    part = found.problem.input_part
    values = np.linalg.eigvalsh(found.posterior.covariance[part, part])
    assert values[0] < 0.01 and values[1] > 0.99  # the sum is told, the difference is not


def test_a_tumour_against_the_rest(body: Body, rng: np.random.Generator) -> None:
    """The whole body's modulus is that of the rest where a region has its own: their names say so."""
    _, far = halves(body)
    found = registered(body, (0.5, 0.5), (YoungModulus(0.5), YoungModulus(1.0, far, "tumour")), rng)
    (reason,) = found.judgement.reasons
    said = "the cloud does not tell Young's modulus of the rest against Young's modulus of tumour under this load: "
    assert reason.startswith(said)


def test_one_that_is_not_seen_at_all_is_named_alone(body: Body, rng: np.random.Generator) -> None:
    near, far = halves(body)
    found = registered(body, (1.0, 0.0), (YoungModulus(0.5, near, "root"), YoungModulus(0.5, far, "tumour")), rng)
    (reason,) = found.judgement.reasons
    assert reason.startswith("the cloud does not tell Young's modulus of tumour under this load: what is given")


def test_a_pair_that_is_told_is_accepted(body: Body) -> None:
    input_blocks = InputBlocks(body, {"young_modulus": MODULUS, "poisson_ratio": 0.4}, (YoungModulus(), PoissonRatio()))
    names = ["E", "nu"]
    assert uninformed(input_blocks.shares, names, np.diag([0.1, 0.3]), 0.5) == ([], [])
    assert uninformed(input_blocks.shares, names, np.full((2, 2), np.nan), 0.5) == ([], [])
    assert uninformed(input_blocks.shares, names, np.eye(2), 0.5) == (
        names,
        [],
    )  # of what is told not at all, no combination


@pytest.mark.parametrize(
    ("direction", "words"), [((1.0, -1.0), "E against nu"), ((1.0, 2.0), "nu with E"), ((-2.0, 1.0), "E against nu")]
)
def test_a_direction_is_said_by_its_larger_share(body: Body, direction: tuple[float, float], words: str) -> None:
    input_blocks = InputBlocks(body, {"young_modulus": MODULUS, "poisson_ratio": 0.4}, (YoungModulus(), PoissonRatio()))
    along = np.array(direction) / np.linalg.norm(direction)
    covariance = 0.01 * np.eye(2) + 0.98 * np.outer(along, along)
    assert uninformed(input_blocks.shares, ["E", "nu"], covariance, 0.5) == ([], [words])
