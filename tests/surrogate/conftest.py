"""A data set with a closed form, so that surrogates are tested where FEniCSx is not.

The energy 1/2 e(u) + gamma/4 e(u)^2 - b u with e(u) = u K u has the equilibrium u = s K^-1 b, where s is the root of
s + gamma s^3 (b K^-1 b) = 1, and the tangent (1 + gamma e) K + 2 gamma K u u K, inverted by Sherman and Morrison.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.metrics import HEXAHEDRON_EDGES
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet, LinearResponse
from softtwin.reference.data.schema import Reason
from softtwin.reference.data.writing import create, write_block
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.umesh import UMesh

Floats = NDArray[np.float64]

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]
MODES, BLOCK, GAMMA = 6, 8, 40.0
COUNTS = {"train": 64, "validation": 16, "test": 16, "calibration": 16}


class ClosedForm:
    """The equilibrium with a closed form on one body; K couples neighbours as springs do, alike in x, y and z."""

    def __init__(self, body: Body) -> None:
        n = len(body.points)
        stiffness = np.zeros((n, n))
        for i, j in np.unique(np.sort(body.cells[:, HEXAHEDRON_EDGES].reshape(-1, 2), axis=1), axis=0):
            stiffness[[i, j], [i, j]] += 1.0
            stiffness[[i, j], [j, i]] -= 1.0
        free = body.free
        inverse = np.zeros((n, n))
        inverse[np.ix_(free, free)] = np.linalg.inv(stiffness[np.ix_(free, free)])
        self.body, self.inverse = body, np.kron(inverse, np.eye(3))
        values, vectors = np.linalg.eigh(stiffness[np.ix_(free, free)])
        self.shapes = np.zeros((MODES, n, 3))
        for k in range(MODES):
            self.shapes[k, free, k % 3] = vectors[:, k // 3]
        self.eigenvalues = values[np.arange(MODES) // 3]

    def solve(self, load: Floats) -> Floats:
        linear = self.inverse @ load.ravel()
        product = GAMMA * load.ravel() @ linear
        roots = np.roots([product, 0.0, 1.0, -1.0]) if product > 1e-14 else np.array([1.0])
        return (float(roots[np.abs(roots.imag) < 1e-9].real[0]) * linear).reshape(-1, 3)

    def adjoint(self, load: Floats, cotangent: Floats) -> Floats:
        displacement = self.solve(load).ravel()
        linear = self.inverse @ load.ravel()
        stretch = displacement @ linear / (linear @ linear)
        energy = stretch**2 * (load.ravel() @ linear)
        factor = 2.0 * GAMMA / (1.0 + 3.0 * GAMMA * energy)
        back = self.inverse @ cotangent.ravel()
        corrected = back - factor * displacement * (displacement @ cotangent.ravel())
        return (corrected / (1.0 + GAMMA * energy)).reshape(-1, 3)


def write_data_set(
    path: Path, body: Body, counts: dict[str, int] = COUNTS, poison: str = "", rejected: str = ""
) -> DataSet:
    """A data set of the closed form; every fifth draw is rejected, and a whole split, or NaN, where asked for."""
    truth = ClosedForm(body)
    loaded = np.setdiff1d(body.boundary_nodes, body.fixed)
    columns = truth.inverse[:, (3 * loaded[:, None] + np.arange(3)).ravel()]
    response = LinearResponse(loaded, columns, np.eye(columns.shape[1]))
    header = {"block": BLOCK, "samples": counts, "plan": {"seed": 0}, "versions": {"closed form": "1"}}
    data = create(path, header, body, response, truth.shapes, truth.eigenvalues)
    for block in range(data.block_count):
        rows = [_draw(truth, loaded, block * BLOCK + i) for i in range(BLOCK)]
        arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        if poison and block * BLOCK in data.split_draws(poison):  # type: ignore[arg-type]
            for name in ("forces", "displacements", "probes", "adjoints"):
                arrays[name] = np.full_like(arrays[name], np.nan)
        if rejected and block * BLOCK in data.split_draws(rejected):  # type: ignore[arg-type]
            arrays["reason"] = np.full_like(arrays["reason"], Reason.UNSTABLE)
        write_block(path, block, arrays)
    return data


def _draw(truth: ClosedForm, loaded: NDArray[np.int64], draw: int) -> dict[str, Any]:
    rng = np.random.default_rng([3, draw])
    load = np.zeros_like(truth.body.points)
    load[loaded] = 0.02 * np.einsum("k,kni->ni", rng.uniform(-1.0, 1.0, MODES), truth.shapes[:, loaded])
    probe = rng.standard_normal(MODES)
    cotangent = np.zeros_like(load)
    nodes = truth.body.boundary_nodes
    cotangent[nodes] = np.einsum("k,kni->ni", probe, truth.shapes[:, nodes])
    return {
        "forces": load[loaded],
        "displacements": truth.solve(load),
        "probes": probe,
        "adjoints": truth.adjoint(load, cotangent)[loaded],
        "energy": 0.0,
        "residual": 0.0,
        "iterations": 1,
        "load_steps": 1,
        "negative_pivots": 0,
        "reason": Reason.UNSTABLE if draw % 5 == 4 else Reason.ACCEPTED,
    }


Maker = Callable[..., DataSet]


@pytest.fixture(scope="session")
def small_beam() -> Body:
    return beam((4, 2, 2), (0.4, 0.2, 0.2))


@pytest.fixture(scope="session")
def closed_form(small_beam: Body) -> ClosedForm:
    return ClosedForm(small_beam)


@pytest.fixture(scope="session")
def data(small_beam: Body, tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return write_data_set(tmp_path_factory.mktemp("closed") / "data.zarr", small_beam)


@pytest.fixture(scope="session")
def write_data() -> Maker:
    """For bodies of a test's own."""
    return write_data_set


@pytest.fixture
def soft(data: DataSet, monkeypatch: pytest.MonkeyPatch) -> DataSet:
    same = DataSet(data.path)
    material = {"material": "neo-hookean", "young_modulus": 20.0, "poisson_ratio": 0.4}
    monkeypatch.setitem(same.header, "plan", {**same.header["plan"], **material})
    return same


@pytest.fixture
def make_data(small_beam: Body, tmp_path: Path) -> Maker:
    def make(**options: Any) -> DataSet:
        return write_data_set(tmp_path / "data.zarr", small_beam, **options)

    return make


@pytest.fixture(scope="session")
def small_plan() -> TrainingPlan:
    return TrainingPlan(Reduced(modes=6, width=32, depth=2), batch=32, epochs=90)


@pytest.fixture(scope="session")
def reduced(data: DataSet, small_plan: TrainingPlan) -> Surrogate:
    return train(data, small_plan)


@pytest.fixture(scope="session")
def perceptron(data: DataSet) -> Surrogate:
    return train(data, TrainingPlan(Perceptron(), batch=32, epochs=30))


@pytest.fixture(scope="session")
def umesh(data: DataSet) -> Surrogate:
    return train(data, TrainingPlan(UMesh(channels=8, levels=2), batch=16, epochs=10))


@pytest.fixture(scope="session")
def transolver(data: DataSet) -> Surrogate:
    return train(data, TrainingPlan(Transolver(width=8, depth=1, heads=2, slices=4), batch=16, epochs=10))


@pytest.fixture(params=["reduced", "perceptron", "umesh", "transolver"])
def surrogate(request: pytest.FixtureRequest) -> Surrogate:
    model: Surrogate = request.getfixturevalue(request.param)
    return model


@pytest.fixture
def forces(data: DataSet) -> Floats:
    """Forces of an unseen sample at all nodes."""
    full = np.zeros_like(data.body.points)
    full[data.response.loaded] = data.samples("test").forces[1]
    return full
