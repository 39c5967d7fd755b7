"""The configuration file of a twin: TOML, checked, with every default and its meaning written out on demand."""

from __future__ import annotations

import reprlib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tomlkit
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError, model_validator

from softtwin.meshes.attachment import parse_file
from softtwin.meshes.files import SEGMENTATIONS, Axes

from .unknowns import WORDS as UNKNOWNS
from .unknowns import Unknown

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


_SURFACES = (".stl", ".ply", ".obj", ".vtp", *SEGMENTATIONS)


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names every wrong entry, what was expected and what came."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# What says where something is: `meshes/attachment.py` reads it.
_WHERE = (
    "near:STRUCTURE:5mm, touching:LABEL:5mm, ball:X,Y,Z:R, box:X,Y,Z:X,Y,Z, halfspace:X,Y,Z:NX,NY,NZ or "
    "seen-from:X,Y,Z (a unit behind a number, else unit), or several with ' + ' between"
)


class BodySection(_Section):
    """Where the body comes from. A file with another unit or axes has them behind its name (veins.ply:mm:ras)."""

    source: str = Field(
        "liver-phantom",
        description="a surface or mesh file (STL PLY OBJ VTK VTU VTP MSH), a segmentation (NII NRRD, or a folder of "
        "them), or a shape: liver-phantom, propeller, beam",
    )
    organ: str = Field("", description="label of a segmentation that the body is made from; empty: the liver")
    unit: Literal["m", "cm", "mm"] = Field("m", description="unit of length in the files")
    frame: Literal["", "lps", "ras"] = Field(
        "",
        description="axes of the files that say none, lps or ras; files in ras are turned, inside it is lps",
    )
    cell_size: float = Field(0.0, ge=0.0, description="edge length of the tetrahedra in metres; 0: from nodes")
    nodes: Count = Field(2000, description="number of nodes wanted where a surface is made solid and cell_size is 0")
    grid: float = Field(
        0.0,
        ge=0.0,
        description="edge length, metres, of the hexahedra of a regular grid that carries the organ's surface, in "
        "place of tetrahedra (architecture umesh wants it); 0: none",
    )
    fixed: str = Field(
        "",
        description=f"what holds the organ: points or triangles near it, .npy/.txt of node numbers, or {_WHERE}",
    )
    fixed_distance: float = Field(
        0.0, ge=0.0, description="how near to a file of fixed a node is fixed, in metres; 0: one cell"
    )
    observed: str = Field(
        "",
        description="what a camera sees: a surface file, (t, 3) node numbers in .npy, or words as for fixed; "
        "empty: the whole boundary",
    )
    zones: dict[str, str] = Field(
        default_factory=dict, description="named zones that tools may touch: files or words as for fixed"
    )
    inner: dict[str, str] = Field(
        default_factory=dict,
        description="named inner surfaces (vessels, tumours): surface files, or labels of a segmentation",
    )


Law = Literal["neo-hookean", "saint-venant-kirchhoff", "isochoric-neo-hookean", "linear-elastic"]
LAWS: tuple[str, ...] = get_args(Law)


class MaterialSection(_Section):
    """The tissue."""

    law: Law = Field("neo-hookean", description="strain energy")
    young_modulus: Positive = Field(5000.0, description="pascals")
    young_modulus_deviation: float = Field(
        0.0,
        ge=0.0,
        description="what is not known of it: standard deviation of its logarithm (0.3: a third), which forces found "
        "are the more in doubt by; displacements under forces alone do not depend on it",
    )
    poisson_ratio: float = Field(0.45, gt=0.0, lt=0.5, description="between 0 and 0.5; soft tissue 0.45 to 0.49")
    density: Positive = Field(1060.0, description="kg/m^3, for weight where gravity acts")


class LoadsSection(_Section):
    """The loads that the twin learns from (modes of the stiffness at rest, masked to patches)."""

    kind: Literal["modal", "random"] = Field(
        "modal", description="modal loads, or independent nodal forces to compare with"
    )
    modes: Count = Field(10, description="eigenmodes that make the loads")
    patches: Count = Field(2, description="most patches that act at once")
    radius: tuple[Positive, Positive] = Field(
        (0.06, 0.65), description="smallest and largest patch, relative to its zone"
    )
    zones: tuple[str, ...] = Field((), description="names of zones that carry the loads; empty: the whole boundary")
    displacement: Positive = Field(0.05, description="largest displacement wanted, metres; the loads are scaled to it")
    amplitude: float = Field(
        0.0, ge=0.0, description="fixed amplitude in newtons instead; 0: scale to the displacement"
    )
    sequence: Literal["random", "sobol"] = Field(
        "random", description="how training loads are spread: at random, or evenly by a Sobol sequence"
    )


class SamplesSection(_Section):
    """How many equilibria."""

    train: Count = Field(512, description="draws to learn from")
    validation: Count = Field(64, description="draws to choose the best weights with")
    test: Count = Field(128, description="draws held out, never seen in training")
    calibration: int = Field(
        0,
        ge=0,
        description="draws to calibrate bounds on errors with, neither learned nor chosen from; 0: no bounds",
    )
    rounds: int = Field(
        0,
        ge=0,
        description="active rounds: how often further draws to learn from are chosen, where the network trained on "
        "those before is least in balance; 0: none",
    )
    chosen: Count = Field(64, description="draws chosen in each active round, in whole blocks")
    candidates: Count = Field(16, description="loads looked at for each that is chosen")
    block: Count = Field(8, description="draws in one block of work")
    ramp: Count = Field(
        1,
        validation_alias=AliasChoices("ramp", "path"),
        description="draws that share a load at growing sizes, each solved from the one before; divides block",
    )
    jacobians: bool = Field(
        True,
        description="also the Jacobian of each training equilibrium in the reduced network's modes, which tell it more "
        "than further samples do; takes about half as long again; other networks have none",
    )
    seed: int = Field(0, ge=0, description="seed of everything random")
    ranks: int = Field(0, ge=0, description="MPI ranks that build and quickstart start; 0: one a core")

    @model_validator(mode="after")
    def _ramp_divides_block(self) -> SamplesSection:
        if self.block % self.ramp:
            raise ValueError(f"samples.ramp: expected a divisor of samples.block ({self.block}), got {self.ramp}")
        if self.rounds and self.chosen % self.block:
            raise ValueError(f"samples.chosen: expected whole blocks of {self.block} draws, got {self.chosen}")
        return self


class SolverSection(_Section):
    """Newton's method in the reference."""

    tolerance: float = Field(1e-8, gt=0.0, lt=1.0, description="residual relative to the forces")
    max_iterations: Count = Field(60, description="iterations of one load step")
    max_load_steps: Count = Field(20, description="load steps tried before a draw is rejected")


class TrainingSection(_Section):
    """The surrogate."""

    architecture: Literal["reduced", "mlp", "umesh", "transolver"] = Field(
        "reduced",
        description="reduced network; as yardsticks the thesis's perceptron (mlp) and U-Mesh (umesh, on a regular "
        "grid), and a transolver",
    )
    modes: Count = Field(64, description="displacement modes (POD) of the reduced network")
    width: Count = Field(256, description="width of its blocks")
    seconds: Positive = Field(
        120.0, description="wall time to train: ends with the step under way; reading the data not counted"
    )
    epochs: int = Field(
        0,
        ge=0,
        description="passes over the samples (reduced network: and their symmetric images) instead, whatever time they "
        "take; 0: by seconds",
    )
    seed: int = Field(0, ge=0, description="seed of the weights and the order of samples")
    precision: Literal["single", "mixed"] = Field(
        "single", description="mixed: products in bfloat16, for large networks on a GPU"
    )
    patience: int = Field(
        0, ge=0, description="end after so many of the 40 rounds without a smaller validation error; 0: never early"
    )
    settings: dict[str, int | float | bool | str] = Field(
        default_factory=dict, description="further settings of the architecture by name: { depth = 3 }"
    )
    physics: dict[str, float] = Field(
        default_factory=dict,
        description="weights in the loss of energy, residual and data (1): { energy = 0.1 }; empty: the data alone",
    )


class DoubtSection(_Section):
    """What the organ may be otherwise than its twin: `softtwin doubt` draws alternatives, and margins know of them."""

    draws: int = Field(96, ge=0, description="alternatives that are drawn, one under a training load each; 0: none")
    attachment: float = Field(
        0.004,
        ge=0.0,
        description="how far what holds the organ may lie elsewhere on it: standard deviation along each axis, metres",
    )
    poisson_ratio: tuple[float, float] | tuple[()] = Field(
        (), description="least and largest Poisson's ratio that the organ may have; empty: the material's"
    )
    meshes: int = Field(
        0, ge=0, description="other meshes of the organ's surface, of half to twice as many nodes; 0: the twin's own"
    )
    seed: int = Field(0, ge=0, description="seed of the draws")

    @property
    def is_asked_for(self) -> bool:
        """Whether anything may be otherwise, and is drawn."""
        return bool(self.draws and (self.attachment or self.poisson_ratio or self.meshes))


class RegistrationSection(_Section):
    """From a cloud to forces."""

    model: Literal["surrogate", "reference", "hybrid"] = Field(
        "surrogate", description="which forward model registers; hybrid: the surrogate first, the reference from there"
    )
    zone: str = Field("", description="zone whose nodes may carry force; empty: all loaded nodes")
    noise: Positive = Field(5e-4, description="noise of a point, metres, that the search for it begins with")
    noise_known: bool = Field(False, description="hold the noise at that value instead of finding it")
    force_scale: float = Field(
        0.0, ge=0.0, description="nodal force to begin with, newtons; 0: by stiffness and mesh; its size is found"
    )
    smoothness: float = Field(0.02, ge=0.0, description="correlation length of neighbouring forces, metres; 0: none")
    directions: Count = Field(64, description="most directions of force kept: those that a cloud tells best")
    points: Count = Field(1000, description="most points of a cloud used: larger ones are thinned")
    distance: Literal["surface", "plane"] = Field(
        "surface", description="of points to the surface, or to the planes of its triangles, along which they slide"
    )
    normals: bool = Field(False, description="clouds carry the normals of the surface seen, which pull, too")
    normal_deviation: Positive = Field(10.0, description="standard deviation of a normal across itself, degrees")
    budget: float = Field(0.0, ge=0.0, description="seconds for a frame, after which the best so far is taken; 0: none")
    rounds: int = Field(
        -1,
        ge=-1,
        description="how often a cold start gathers the forces where it has found some; -1: as the model and zone ask",
    )
    solver: Literal["gauss-newton", "l-bfgs"] = Field("gauss-newton", description="how the objective is minimised")
    penalty: Literal["prior", "amplitude", "divergence"] = Field(
        "prior",
        description="what forces cost: by their Gaussian prior, or by l-bfgs with their size (Odot 2023, eq. 6.5) or "
        "squared divergence (6.6) over the surface in its place",
    )
    alpha: float = Field(0.1, ge=0.0, le=1.0, description="weight of such a penalty beside the distances")
    max_iterations: int = Field(
        0, ge=0, description="most iterations; 0: what the solver is content with (gauss-newton 40, l-bfgs 200 a run)"
    )
    pose: Literal["auto", "fixed", "unknown"] = Field(
        "auto",
        description="whether the camera's pose is an unknown beside the forces; auto: where a start is given, and else "
        "the clouds are in the organ's coordinates, as well as known_turn and known_shift say",
    )
    forces: Literal["unknown", "known"] = Field(
        "unknown", description="known: none beside known_forces, gravity and pressure; the unknowns are to be found"
    )
    unknowns: tuple[str, ...] = Field((), description=f"unknowns beside the forces: {UNKNOWNS}")
    known_forces: str = Field("", description="known nodal forces: .npy (n, 3), newtons, on the axes of the files")
    gravity: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="that acts beyond what the body has at rest, m/s^2, on the axes of the files"
    )
    pressure: float = Field(0.0, description="on the whole boundary, pascals, following it (pneumoperitoneum)")
    pose_turn: Positive = Field(5.0, description="how far an unknown pose may turn from its start, degrees")
    pose_shift: Positive = Field(0.01, description="how far an unknown pose may shift from its start, metres")
    known_turn: float = Field(
        1.0,
        ge=0.0,
        allow_inf_nan=False,
        description="how well a pose that is not asked for is known, degrees; 0: exactly",
    )
    known_shift: float = Field(
        0.002,
        ge=0.0,
        allow_inf_nan=False,
        description="the same of its shift, metres; what it is found to be off by counts as displacement",
    )
    landmark_deviation: Positive = Field(
        0.002, description="standard deviation of where landmarks were found that pull beside the clouds, metres"
    )
    output_frame: Literal["lps", "ras", "source"] = Field(
        "lps", description="axes of what is written; source: of the organ's files"
    )
    output_unit: Literal["mm", "m", "source"] = Field(
        "mm", description="unit of what is written; source: of the organ's files (nrrd, mrk.json and seq.mrb: mm)"
    )
    voxel: float = Field(
        0.0, ge=0.0, description="edge of a voxel of a displacement field (nrrd), metres; 0: 64 along the organ"
    )
    target_points: int = Field(
        0, ge=0, description="points of the surface of each inner structure in mrk.json, beside its centre"
    )

    @model_validator(mode="after")
    def _unknowns_can_be_found(self) -> RegistrationSection:
        kinds = [Unknown.parse(text).kind for text in self.unknowns]
        others = set(kinds) - {"contact"}
        if "contact" in kinds and len(kinds) > 1:
            raise ValueError(f"registration.unknowns: expected contact alone, got {', '.join(self.unknowns)}")
        models = ["surrogate", "reference"] if kinds and not others else ["surrogate", "reference", "hybrid"]
        if others:  # a network has learned one material
            models = ["reference", "hybrid"]
        if self.known_forces:  # they are added to those that the network is asked for, where both engines know of them
            models = [model for model in models if model != "surrogate"]
        if any(self.gravity) or self.pressure or "moved" in kinds or self.forces == "known":
            models = ["reference"]  # a network has one support, and no load inside or that follows the surface
        if self.model not in models:
            raise ValueError(
                f"registration.model: expected {' or '.join(models)} with these unknowns and known loads (a network "
                f"has learned one material, one support and forces alone), got {self.model}"
            )
        if self.forces == "known" and not others:
            raise ValueError(
                "registration.unknowns: expected at least one (young-modulus, poisson-ratio, moved@NODES) where all "
                "forces are known, got none"
            )
        return self


class Config(_Section):
    """One twin, from its surface to its registrations."""

    folder: str = Field("twin-run", description="folder of everything that is made, relative to this file")
    body: BodySection = BodySection()
    material: MaterialSection = MaterialSection()
    loads: LoadsSection = LoadsSection()
    samples: SamplesSection = SamplesSection()
    solver: SolverSection = SolverSection()
    training: TrainingSection = TrainingSection()
    doubt: DoubtSection = DoubtSection()
    registration: RegistrationSection = RegistrationSection()

    @property
    def wants_jacobians(self) -> bool:
        """Whether Jacobians are asked for, and the network learns from them."""
        learns = self.training.architecture == "reduced" and self.training.settings.get("sobolev", 1.0) != 0.0
        return self.samples.jacobians and learns

    @model_validator(mode="after")
    def _radius_is_ordered(self) -> Config:
        if self.loads.radius[0] > self.loads.radius[1]:
            raise ValueError(f"loads.radius: expected smallest <= largest, got {self.loads.radius}")
        return self

    @model_validator(mode="after")
    def _modes_fit_the_nodes(self) -> Config:
        """Refuse before meshing what no mesh of so many nodes has; the mesh itself is asked again."""
        most = 3 * self.body.nodes // 2
        solid = self.body.cell_size == 0.0 and parse_file(self.body.source).path.name.lower().endswith(_SURFACES)
        if solid and self.loads.modes > most:
            raise ValueError(
                f"loads.modes: expected at most {most} with body.nodes = {self.body.nodes}, got {self.loads.modes}"
            )
        return self


def files_axes(section: BodySection) -> Axes | None:
    """The axes of a body's source, and of all files and coordinates that say none; None where nobody says.

    Args:
        section: the configuration's [body].
    """
    return parse_file(section.source).axes or section.frame or None


def axes_unknown(section: BodySection) -> bool:
    """Whether nobody says the axes of the files that a body was made from, so that they are taken as LPS.

    Args:
        section: the configuration's [body].
    """
    is_file = bool(parse_file(section.source).path.suffix)  # shapes are made in LPS
    return is_file and files_axes(section) is None


def read_config(path: Path | str) -> tuple[Config, Path]:
    """A checked configuration, and the folder that its relative paths start from.

    Args:
        path: TOML file.

    Raises:
        ConfigError: the file is missing, no TOML, or entries are unknown or out of range.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"configuration: expected a TOML file, found none at {path}; `softtwin config` writes one.")
    try:
        entries = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"configuration: {path} is no TOML ({error}).") from error
    return parse_config(entries, str(path)), path.parent


def parse_config(entries: dict[str, Any], source: str = "configuration") -> Config:
    """A configuration from plain entries.

    Raises:
        ConfigError: entries are unknown or out of range.
    """
    try:
        return Config.model_validate(entries)
    except ValidationError as error:
        lines = [f"  {_described(item)}" for item in error.errors()]
        raise ConfigError("\n".join([f"{source}: {len(lines)} wrong entries", *lines])) from None


def _described(item: Any) -> str:
    message = item["msg"].removeprefix("Value error, ")
    if isinstance(item["input"], dict | BaseModel):  # of a whole section: the message names the entry and what came
        return message
    return f"{'.'.join(map(str, item['loc'])) or 'configuration'}: {message}, got {reprlib.repr(item['input'])}"


def to_toml(config: Config) -> str:
    """The configuration as TOML, each entry with its meaning behind it."""
    document = tomlkit.document()
    document.add(tomlkit.comment("softtwin: research software, not a medical device"))
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if not isinstance(value, BaseModel):
            document.add(name, tomlkit.item(value).comment(field.description or ""))
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            document.add(tomlkit.nl())
            document.add(name, _table(value))
    return tomlkit.dumps(document)


def _table(section: BaseModel) -> Any:
    table = tomlkit.table()
    table.comment((type(section).__doc__ or "").strip())
    subtables = {}
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, dict):
            subtables[name] = value
            continue
        item = tomlkit.item(list(value) if isinstance(value, tuple) else value)
        table.add(name, item.comment(field.description or ""))
    for name, value in subtables.items():
        inner = tomlkit.inline_table()
        inner.update(value)
        table.add(name, inner.comment(type(section).model_fields[name].description or ""))
    return table
