"""Train a network through the reference to tell how stiff a beam is that is seen to sag.

    python examples/train_through_equilibria.py

The network is told where the tip has sunk to under a known load and answers with Young's modulus. It is never shown a
modulus: its answer goes through a finite-element equilibrium, and the loss is how far that is from what was seen. The
gradient comes back through the equilibrium by its adjoint (Odot 2023, section 7.1.4). Needs FEniCSx.
"""

from __future__ import annotations

import numpy as np
import torch

from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.derivatives.layer import EquilibriumLayer
from softtwin.reference.solve.problem import Problem

STEPS, SAMPLES = 120, 5


def main() -> float:
    """Mean relative error of the modulus for beams that the network was not trained on."""
    body = beam((8, 2, 2), (0.40, 0.08, 0.08), "hexahedron")
    tip = torch.tensor(body.node_sets["tip"])
    load = torch.zeros(body.points.shape, dtype=torch.float64)
    load[tip, 2] = -0.05 / len(tip)
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(1, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)).double()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.02)
    rng = np.random.default_rng(0)

    def modulus(sag: torch.Tensor) -> torch.Tensor:
        """Pascals, positive whatever the network says, for how deep the tip has sunk, metres."""
        return 3000.0 * torch.exp(network((torch.log(sag) + 4.0)[None])[0])

    with Problem(body, NeoHookean(3000.0, 0.45)) as problem:
        equilibrium = EquilibriumLayer(problem)

        def sag_of(young: torch.Tensor | float) -> torch.Tensor:
            return -equilibrium(load, young)[tip, 2].mean()

        seen = [sag_of(young).detach() for young in np.geomspace(1500.0, 6000.0, SAMPLES)]
        for step in range(STEPS):
            sag = seen[step % SAMPLES]
            loss = (sag_of(modulus(sag)) / sag - 1.0) ** 2
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        errors = []
        for young in rng.uniform(1800.0, 5000.0, 5):
            with torch.no_grad():
                found = float(modulus(sag_of(young)))
            errors.append(abs(found / young - 1.0))
            print(f"true {young:.0f} Pa, found {found:.0f} Pa: {100 * errors[-1]:.1f} % off")
    return float(np.mean(errors))


if __name__ == "__main__":
    main()
