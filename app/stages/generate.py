"""The data set of a configuration: equilibria under the drawn loads."""

from __future__ import annotations

from contextlib import nullcontext

from softtwin.meshes.files import read_body
from softtwin.reference.dataset import DataSet
from softtwin.reference.loads import LoadPlan

from ..config import Config, ConfigError
from ..workspace import Workspace, timed


def load_plan(config: Config) -> LoadPlan:
    """How loads are drawn, from the configuration."""
    loads = config.loads
    return LoadPlan(
        kind=loads.kind,
        modes=loads.modes,
        zones=loads.zones,
        patches=loads.patches,
        radius=loads.radius,
        displacement=loads.displacement,
        amplitude=loads.amplitude or None,
    )


def generate_stage(space: Workspace, redo: tuple[int, ...] = ()) -> DataSet | None:
    """Solve the equilibria of the data set; collective where mpirun started it. Returns None on ranks other than 0.

    Raises:
        ConfigError: there is no body yet.
        DataSetError: the folder holds a data set of another configuration.
    """
    from softtwin.reference.dataset import drop_block  # FEniCSx is needed by this stage alone
    from softtwin.reference.equilibrium import NewtonOptions
    from softtwin.reference.fenicsx import MPI
    from softtwin.reference.generate import Plan, generate

    if not space.body.exists():
        raise ConfigError(f"generate: expected the body in {space.body}, found none; run `softtwin mesh` first.")
    samples, material = space.config.samples, space.config.material
    plan = Plan(
        material=material.law,
        young_modulus=material.young_modulus,
        poisson_ratio=material.poisson_ratio,
        loads=load_plan(space.config),
        samples={"train": samples.train, "validation": samples.validation, "test": samples.test},
        block=samples.block,
        path=samples.path,
        seed=samples.seed,
        newton=NewtonOptions(**space.config.solver.model_dump()),
    )
    if MPI.COMM_WORLD.rank == 0:
        for block in redo:
            drop_block(space.data, block)
    with timed(space, "generate") if MPI.COMM_WORLD.rank == 0 else nullcontext():
        return generate(space.data, read_body(space.body), plan)
