"""Find how stiff the tumour of a phantom has to be, to be strained half as much as a soft one.

    python examples/design_a_phantom.py [FILE.png]

Design the other way round (Odot 2023, section 8.2): the wanted deformation is given, the tissue is sought. A tool pulls
at the front of the liver phantom; how much the tumour is strained is a function of its stiffness, whose derivative
comes with each equilibrium. Newton's method on that takes a handful of equilibria, where a table of stiffnesses would
take one for each entry. A picture shows both. Equilibria are torch's: no FEniCSx is needed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from softtwin.meshes.shapes import liver_phantom
from softtwin.meshes.signed import cells_inside
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import NeoHookean
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.equilibria_model import EquilibriaModel, EquilibriaState

TISSUE, RATIO, PULL = 3000.0, 0.45, np.array([0.15, -0.6, 0.3])  # pascals; newtons in all
WANTED, CLOSE, MOST = 0.5, 1e-4, 12  # of the strain of a tumour as soft as the rest; of that; equilibria


class Phantom:
    """The liver phantom under its pull, with a tumour of any stiffness."""

    def __init__(self) -> None:
        self.body = liver_phantom(0.012)
        self.inside = np.isin(np.arange(len(self.body.cells)), cells_inside(self.body, "tumour"))
        self.model = EquilibriaModel(Equilibria(self.body, NeoHookean(self.moduli(TISSUE), RATIO)))
        front = np.setdiff1d(np.unique(self.body.surfaces["observed"]), self.body.fixed)
        middle = self.body.points[self.body.cells[self.inside]].mean(axis=(0, 1))
        near = front[np.argsort(np.linalg.norm(self.body.points[front] - middle, axis=1))[:12]]
        self.forces = np.zeros_like(self.body.points)
        self.forces[near] = PULL / len(near)
        self.count = 0

    def moduli(self, tumour: float) -> np.ndarray:
        """Young's modulus of each cell, pascals."""
        return np.where(self.inside, tumour, TISSUE)

    def gradient(self, displacement: np.ndarray) -> np.ndarray:
        """Mean displacement gradient of the tumour's cells, (3, 3), for nodal displacements, (n, 3), metres."""
        cells = self.body.cells[self.inside]
        edges = self.body.points[cells[:, 1:]] - self.body.points[cells[:, :1]]
        moved = displacement[cells[:, 1:]] - displacement[cells[:, :1]]
        mean: np.ndarray = np.linalg.solve(edges, moved).mean(axis=0).T
        return mean

    def strain(self, displacement: np.ndarray) -> float:
        """Norm of the tumour's mean Green-Lagrange strain: turns do not count."""
        F = np.eye(3) + self.gradient(displacement)
        return float(np.linalg.norm(0.5 * (F.T @ F - np.eye(3))))

    def state(self, tumour: float, near: EquilibriaState | None = None) -> EquilibriaState:
        """The equilibrium with a tumour of that stiffness, pascals."""
        self.count += 1
        return self.model.solve(self.forces, near, Inputs(parameters={"young_modulus": self.moduli(tumour)}))

    def slope(self, state: EquilibriaState, tumour: float) -> float:
        """Derivative of the strain by the logarithm of the tumour's stiffness."""
        change = Change(parameters={"young_modulus": tumour * self.inside})
        F, rate = (
            np.eye(3) + self.gradient(state.displacement),
            self.gradient(state.jvp_inputs([change]).reshape(-1, 3)),
        )
        E = 0.5 * (F.T @ F - np.eye(3))
        return float((E * (F.T @ rate)).sum() / np.linalg.norm(E))


def main(picture: Path | None = None) -> tuple[float, float]:
    """The stiffness that was found, pascals, and the strain there, relative to that of a tumour as soft as the rest."""
    phantom = Phantom()
    tumour, state = TISSUE, phantom.state(TISSUE)
    first = found = phantom.strain(state.displacement)
    way = [(tumour, 1.0)]
    while abs(found - WANTED * first) > CLOSE * abs(first) and phantom.count < MOST:
        tumour *= float(np.exp(np.clip((WANTED * first - found) / phantom.slope(state, tumour), -1.0, 1.0)))
        state = phantom.state(tumour, state)
        found = phantom.strain(state.displacement)
        way.append((tumour, found / first))
        print(f"{tumour:7.0f} Pa: strained {100 * found / first:.2f} % as much as tissue")
    print(f"found with {phantom.count} equilibria: {tumour / TISSUE:.2f} times as stiff as the rest")
    if picture is not None:
        draw(phantom, first, way, picture)
    return tumour, found / first


def draw(phantom: Phantom, first: float, way: list[tuple[float, float]], picture: Path) -> None:
    """The strain over the stiffness, with the steps that found it."""
    stiffness = np.geomspace(0.5 * TISSUE, 1.3 * max(tumour for tumour, _ in way), 9)
    curve = [phantom.strain(phantom.state(float(each)).displacement) / first for each in stiffness]
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.semilogx(1e-3 * stiffness, curve, color="0.6", label="nine equilibria")
    axes.plot(*(np.transpose(way) * [[1e-3], [1.0]]), "o-", label="Newton's steps")
    axes.axhline(WANTED, color="k", linewidth=0.8, linestyle=":")
    ticks = [each for each in (1, 2, 3, 5, 10, 20, 30, 50) if stiffness[0] < 1e3 * each < stiffness[-1]]
    axes.set_xticks(ticks, [str(each) for each in ticks])
    axes.minorticks_off()
    axes.set(xlabel="Young's modulus of the tumour, kPa", ylabel="strain of the tumour, relative")
    axes.legend(frameon=False)
    figure.savefig(picture, dpi=150)
    print(f"picture: {picture}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
