"""The configuration file of a twin: TOML, checked, with every default and its meaning written out on demand."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

import tomlkit
from pydantic import BaseModel, Field, ValidationError, model_validator

from softtwin.meshes.attachment import parse_file, parse_place
from softtwin.meshes.io import SEGMENTATIONS, Axes, Unit
from softtwin.reference.data.springs import Ligament, Springs, Support

from .parameters import NamedParameter
from .parameters import words as words_of_parameters
from .schema import ConfigError as ConfigError
from .schema import Section, described, option, option_of, part

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


_SURFACES = (".stl", ".ply", ".obj", ".vtp", *SEGMENTATIONS)


# What says where something is: `meshes/attachment.py` reads it.
_WHERE = (
    "near:STRUCTURE:5mm, touching:LABEL:5mm, ball:X,Y,Z:R, box:X,Y,Z:X,Y,Z, halfspace:X,Y,Z:NX,NY,NZ or "
    "seen-from:X,Y,Z (a unit behind a number, else unit), or several with ' + ' between"
)


class BodySection(Section):
    """Where the body comes from. A file with another unit or axes has them behind its name (veins.ply:mm:ras)."""

    source: str = option(
        "liver-phantom",
        "a surface or mesh file (STL PLY OBJ VTK VTU VTP MSH), a segmentation (NII NRRD, or a folder of them), or a "
        "shape: liver-phantom, propeller, beam",
    )
    organ: str = option("", "label of a segmentation that the body is made from; empty: the liver")
    join: str = option(
        "", "labels of a segmentation that are part of the organ, wherever they lie", repeated=True, metavar="LABEL"
    )
    component: str = option(
        "largest",
        "which component is meant where there are several: largest, left or right (the patient's), 2 for the second "
        "largest, or near:STRUCTURE",
    )
    cavities: Literal["", "keep", "fill"] = option(
        "",
        "closed holes inside the organ: keep or fill them all; empty: a surface keeps those that lie inside another "
        "one, a segmentation those of more than 2 ml and 2 % of the organ",
    )
    unit: Literal["m", "cm", "mm"] = option("m", "unit of length of the files that state none", basic=True)
    frame: Literal["", "lps", "ras"] = option(
        "", "axes of the files that state none, lps or ras; files in ras are rotated, inside it is lps"
    )
    cell_size: float = option(0.0, "edge length of the tetrahedra; 0: from nodes", unit="metres", ge=0.0)
    nodes: int = option(
        2000, "number of nodes wanted where a surface is made solid and cell_size is 0", ge=1, basic=True
    )
    grid: float = option(
        0.0,
        "edge length of the hexahedra of a regular grid that carries the organ's surface, in place of tetrahedra "
        "(architecture umesh wants it); 0: none",
        unit="metres",
        ge=0.0,
    )
    fixed: str = option(
        "",
        f"what holds the organ: points or triangles near it, .npy/.txt of node numbers, or {_WHERE}",
        basic=True,
        repeated=True,
        metavar="WHERE",
    )
    fixed_distance: float = option(
        0.0, "how near to a file of fixed a node is fixed; 0: one cell", unit="metres", ge=0.0
    )
    observed: str = option(
        "",
        "observed surface, which a camera sees: a surface file, (t, 3) node numbers in .npy, or words as for fixed; "
        "empty: the whole boundary",
        basic=True,
        repeated=True,
        metavar="WHERE",
    )
    zones: dict[str, str] = option(
        {},
        "named zones that tools may touch: files or words as for fixed",
        basic=True,
        flag="--zone",
        metavar="NAME=WHERE",
    )
    inner: dict[str, str] = option(
        {},
        "named inner surfaces (vessels, tumours): surface files, or labels of a segmentation",
        basic=True,
        metavar="NAME[=FILE]",
    )


class SpringsSection(Section):
    """What holds the organ and gives way (ligaments, vessels, what it lies on), beside what body.fixed holds."""

    where: dict[str, str] = option(
        {}, "named parts of the surface: files or words as for fixed", flag="--springs", metavar="NAME=WHERE"
    )
    normal: dict[str, float] = option(
        {}, "stiffness per area across the surface of each part", unit="N/m^3", metavar="NAME=STIFFNESS"
    )
    tangential: dict[str, float] = option(
        {}, "stiffness per area along it; without one the organ slides there", unit="N/m^3", metavar="NAME=STIFFNESS"
    )

    ligaments: dict[str, str] = option(
        {},
        "named cords, each from a place of the organ to a point that stays: X,Y,Z to X,Y,Z on the axes of the files (a "
        "unit behind a number, else unit)",
        flag="--ligament",
        metavar="NAME=PLACES",
    )
    stiffness: dict[str, float] = option({}, "of each cord", unit="N/m", metavar="NAME=STIFFNESS")
    slack: dict[str, float] = option(
        {},
        "length beyond which each cord pulls; that of the undeformed organ where nothing is said",
        unit="metres",
        metavar="NAME=LENGTH",
    )

    @model_validator(mode="after")
    def _belong_together(self) -> SpringsSection:
        for word, of in (
            ("normal", "where"),
            ("tangential", "where"),
            ("stiffness", "ligaments"),
            ("slack", "ligaments"),
        ):
            known = getattr(self, of)
            strange = sorted(getattr(self, word).keys() - known.keys())
            if strange:
                raise ValueError(f"springs.{word}: expected names of springs.{of}, {sorted(known)}, got {strange[0]!r}")
        taken = sorted(self.where.keys() & ({"fixed", "observed", "boundary"} | self.ligaments.keys()))
        if taken:
            raise ValueError(f"springs.where: expected a name of its own, got {taken[0]!r}")
        without = sorted(self.ligaments.keys() - self.stiffness.keys())
        if without:
            raise ValueError(f"springs.stiffness: expected one for the ligament {without[0]!r}, got none")
        self.supports("m", False)
        return self

    @property
    def names(self) -> list[str]:
        """Of all springs and ligaments, sorted."""
        return sorted({*self.where, *self.ligaments})

    def supports(self, unit: Unit, is_ras: bool) -> dict[str, Support]:
        """The springs of each part, and ligaments.

        Args:
            unit: of coordinates without one.
            is_ras: coordinates are on the axes RAS, in place of LPS.

        Raises:
            ValueError: places that cannot be read, stiffnesses out of range.
        """
        found: dict[str, Support] = {
            name: Springs(self.normal.get(name, 0.0), self.tangential.get(name, 0.0)) for name in self.where
        }
        for name, text in self.ligaments.items():
            ends = text.split(" to ")
            if len(ends) != 2:
                raise ValueError(f"springs.ligaments.{name}: expected X,Y,Z to X,Y,Z, got {text!r}")
            sign = -1.0 if is_ras else 1.0
            place, end = ((sign * x, sign * y, z) for x, y, z in (parse_place(each, unit) for each in ends))
            found[name] = Ligament(place, end, self.stiffness[name], self.slack.get(name))
        return found


Law = Literal["neo-hookean", "saint-venant-kirchhoff", "isochoric-neo-hookean", "linear-elastic"]
LAWS: tuple[str, ...] = get_args(Law)


class MaterialSection(Section):
    """The tissue."""

    group: ClassVar[str] = "material"

    law: Law = option("neo-hookean", "strain energy")
    young_modulus: float = option(5000.0, "Young's modulus", unit="pascals", gt=0.0, basic=True)
    young_modulus_deviation: float = option(
        0.0,
        "standard deviation of the logarithm of Young's modulus (0.3: a third), which adds to the uncertainty of the "
        "forces found; displacements under forces alone do not depend on it",
        ge=0.0,
    )
    poisson_ratio: float = option(0.45, "Poisson's ratio; soft tissue 0.45 to 0.49", gt=0.0, lt=0.5)
    density: float = option(1060.0, "mass density, for weight where gravity acts", unit="kg/m^3", gt=0.0)


class LoadsSection(Section):
    """The loads that the twin learns from (modes of the stiffness of the undeformed body, masked to patches)."""

    group: ClassVar[str] = "equilibria"

    kind: Literal["modal", "random"] = option("modal", "modal loads, or independent nodal forces to compare with")
    modes: int = option(10, "eigenmodes that make the loads", ge=1)
    patches: int = option(2, "maximum number of patches that act at once", ge=1)
    radius: tuple[Positive, Positive] = option((0.06, 0.65), "smallest and largest patch, relative to its zone")
    zones: tuple[str, ...] = option((), "names of zones that carry the loads; empty: the whole boundary")
    displacement: float = option(
        0.05, "largest displacement to learn; the loads are scaled to it", unit="metres", gt=0.0
    )
    amplitude: float = option(
        0.0, "fixed amplitude of the loads instead; 0: scale to the displacement", unit="newtons", ge=0.0
    )
    sequence: Literal["random", "sobol"] = option(
        "random", "how training loads are spread: at random, or evenly by a Sobol sequence"
    )
    smoothness: float = option(0.02, "correlation length of the forces of smooth draws", unit="metres", gt=0.0)


class SamplesSection(Section):
    """How many equilibria."""

    group: ClassVar[str] = "equilibria"

    train: int = option(
        512,
        "equilibria to learn from; build makes 32 for architecture galerkin where none are asked for",
        ge=1,
        basic=True,
        flag="--samples",
    )
    validation: int = option(64, "draws to choose the best weights with", ge=1)
    test: int = option(128, "draws held out, never seen in training", ge=1)
    calibration: int = option(
        0, "draws to calibrate error bounds with, neither learned nor chosen from; 0: no bounds", ge=0
    )
    smooth: int = option(
        0,
        "draws of smooth forces on a patch, rougher than modal loads, to see what the surrogate gets wrong under "
        "such; 0: it is seen under the validation draws alone",
        ge=0,
    )
    rounds: int = option(
        0,
        "active rounds: how often further draws to learn from are chosen, where the network trained on those before "
        "is least in balance; 0: none",
        ge=0,
    )
    chosen: int = option(64, "draws chosen in each active round, in whole blocks", ge=1)
    candidates: int = option(16, "loads looked at for each that is chosen", ge=1)
    block: int = option(8, "draws in one block of work", ge=1)
    load_path: int = option(
        1,
        "draws on one load path: they share a load at growing amplitudes, each solved from the one before (cheaper); "
        "divides block",
        ge=1,
        old=("ramp", "path"),
    )
    jacobians: bool = option(
        True,
        "also the Jacobian of each training equilibrium in the reduced network's modes, which tell it more than "
        "further samples do; takes about half as long again; other networks have none",
    )
    seed: int = option(0, "seed of everything random", ge=0)
    ranks: int = option(0, "MPI ranks that build and quickstart start; 0: one a core", ge=0)

    @model_validator(mode="after")
    def _load_path_divides_block(self) -> SamplesSection:
        if self.block % self.load_path:
            raise ValueError(
                f"samples.load_path: expected a divisor of samples.block ({self.block}), got {self.load_path}"
            )
        if self.rounds and self.chosen % self.block:
            raise ValueError(f"samples.chosen: expected whole blocks of {self.block} draws, got {self.chosen}")
        return self


def default_samples(architecture: str) -> int:
    """Equilibria that `build` makes for an architecture: a Galerkin model only extends its basis by them."""
    return 32 if architecture == "galerkin" else 512


class SolverSection(Section):
    """Newton's method in the reference."""

    group: ClassVar[str] = "solver"

    tolerance: float = option(1e-8, "residual relative to the forces", gt=0.0, lt=1.0)
    max_iterations: int = option(60, "maximum number of iterations of one load step", ge=1)
    max_load_steps: int = option(20, "load steps tried before a draw is rejected", ge=1)


class TrainingSection(Section):
    """The surrogate."""

    group: ClassVar[str] = "training"

    architecture: Literal["reduced", "galerkin", "mlp", "umesh", "transolver"] = option(
        "reduced",
        "reduced network; galerkin: equilibria in the span of a few modes, which takes a tenth of the equilibria and "
        "learns nothing; as yardsticks the thesis's perceptron (mlp) and U-Mesh (umesh, on a regular grid), and a "
        "transolver",
    )
    modes: int = option(64, "displacement modes (POD) of the reduced network", ge=1)
    width: int = option(256, "width of its blocks", ge=1)
    seconds: float = option(
        120.0,
        "wall time to train: ends with the step under way; reading the data not counted",
        unit="seconds",
        gt=0.0,
        basic=True,
    )
    epochs: int = option(
        0,
        "passes over the samples (reduced network: and their symmetric images) instead, whatever time they take; 0: "
        "by seconds",
        ge=0,
    )
    seed: int = option(0, "seed of the weights and the order of samples", ge=0)
    precision: Literal["single", "mixed"] = option("single", "mixed: products in bfloat16, for large networks on a GPU")
    patience: int = option(
        0, "end after so many of the 40 rounds without a smaller validation error; 0: never early", ge=0
    )
    settings: dict[str, int | float | bool | str] = option(
        {}, "further settings of the architecture by name: { depth = 3 }"
    )
    physics: dict[str, float] = option(
        {},
        "weights in the loss of energy, residual and data (1): { energy = 0.1 }; empty: the data alone",
    )
    vary: dict[str, tuple[float, float]] = option(
        {},
        "least and largest value of what is not known of the tissue (poisson-ratio, young-modulus@STRUCTURE), and of "
        "how many times as stiff as said springs are (springs@SURFACE), which the surrogate is then to know; galerkin "
        "alone: { poisson-ratio = [0.4, 0.49] }",
    )

    @model_validator(mode="after")
    def _galerkin_alone_varies(self) -> TrainingSection:
        if self.vary and self.architecture != "galerkin":
            raise ValueError(f"training.vary: expected architecture galerkin beside it, got {self.architecture}")
        return self


class ModelErrorSection(Section):
    """The model-error ensemble: `softtwin model-error` solves perturbed models of the organ, for the margins."""

    group: ClassVar[str] = "model error"

    draws: int = option(96, "perturbed models that are drawn, one under a training load each; 0: none", ge=0)
    attachment: float = option(
        0.004,
        "standard deviation, along each axis, of where on the organ the attachment lies",
        unit="metres",
        ge=0.0,
    )
    poisson_ratio: tuple[float, float] | tuple[()] = option(
        (), "minimum and maximum of the Poisson's ratio that the organ may have; empty: the material's"
    )
    meshes: int = option(
        0, "other meshes of the organ's surface, of half to twice as many nodes; 0: the twin's own", ge=0
    )
    seed: int = option(0, "seed of the draws", ge=0)

    @property
    def is_asked_for(self) -> bool:
        """Whether any perturbed model is to be drawn."""
        return bool(self.draws and (self.attachment or self.poisson_ratio or self.meshes))


class RegistrationSection(Section):
    """From a cloud to forces."""

    group: ClassVar[str] = "solver"

    model: Literal["surrogate", "reference", "hybrid", "torch"] = option(
        "surrogate",
        "which forward model registers; hybrid: the surrogate first, the reference from there; torch: equilibria like "
        "the reference's, solved without FEniCSx",
        basic=True,
        old=("engine",),
    )
    zone: str = option("", "zone whose nodes may carry force; empty: all loaded nodes", group="forces")
    noise: float = option(
        5e-4,
        "standard deviation of a point's noise that its estimation begins with",
        unit="metres",
        gt=0.0,
        group="noise",
        basic=True,
    )
    noise_known: bool = option(False, "keep the noise at that value instead of estimating it", group="noise")
    force_scale: float = option(
        0.0,
        "nodal force that the estimation of its size begins with; 0: by stiffness and mesh",
        unit="newtons",
        ge=0.0,
        group="forces",
    )
    smoothness: float = option(
        0.02, "correlation length of neighbouring forces; 0: none", unit="metres", ge=0.0, group="forces"
    )
    directions: int = option(
        64, "maximum number of directions of force kept: the likelihood-informed ones", ge=1, group="forces"
    )
    points: int = option(1000, "maximum number of a cloud's points used: larger clouds are thinned", ge=1)
    distance: Literal["surface", "plane"] = option(
        "surface", "of points to the surface, or to the planes of its triangles, along which they slide"
    )
    normals: bool = option(
        False, "read the normals in the clouds' files and fit the surface's normals to them, too", group="input"
    )
    normal_deviation: float = option(
        10.0, "standard deviation of such a normal across itself", unit="degrees", gt=0.0, group="noise"
    )
    budget: float = option(
        0.0, "time for a frame, after which the best so far is taken; 0: no limit", unit="seconds", ge=0.0
    )
    reweighting_rounds: int = option(
        -1,
        "reweighting rounds of the sparse force localisation at a cold start; -1: as the model and zone ask",
        ge=-1,
        group="forces",
        old=("rounds",),
    )
    solver: Literal["gauss-newton", "l-bfgs"] = option("gauss-newton", "how the objective is minimised")
    penalty: Literal["prior", "amplitude", "divergence"] = option(
        "prior",
        "what forces cost: by their Gaussian prior, or by l-bfgs with their size (Odot 2023, eq. 6.5) or squared "
        "divergence (6.6) over the surface in its place",
        group="forces",
    )
    alpha: float = option(0.1, "weight of such a penalty beside the distances", ge=0.0, le=1.0, group="forces")
    max_iterations: int = option(
        0, "maximum number of iterations; 0: the solver's own (gauss-newton 40, l-bfgs 200 a run)", ge=0
    )
    pose: Literal["auto", "fixed", "unknown"] = option(
        "auto",
        "whether the camera's pose is estimated with the forces; auto: where a start is given, and else the clouds are "
        "in the organ's coordinates, as well as known_rotation and known_translation say",
        group="pose",
    )
    forces: Literal["unknown", "normal", "known"] = option(
        "unknown",
        "normal: an unknown pressure alone, along the normal of the undeformed surface, which slides (a lung in its "
        "chest); known: none beside known_forces, gravity and pressure; the parameters are to be found",
        group="forces",
    )
    parameters: tuple[str, ...] = option(
        (),
        f"parameter to estimate beside the forces: {words_of_parameters()}",
        group="parameters",
        flag="--parameter",
        old=("unknowns", "unknown"),
    )
    known_forces: str = option(
        "", "known nodal forces: .npy (n, 3), on the axes of the files", unit="newtons", group="forces", exists=True
    )
    gravity: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "gravity beyond what acts on the organ as the files show it, on their axes",
        unit="m/s^2",
        group="forces",
    )
    scan_gravity: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "gravity under which the files show the organ, on their axes: its stress-free shape is found, and states are "
        "equilibria of that; zeros: the files show it free of stress (reference only)",
        unit="m/s^2",
        group="forces",
    )
    pressure: float = option(
        0.0, "pressure on the whole boundary, following it (pneumoperitoneum)", unit="pascals", group="forces"
    )
    pose_rotation: float = option(
        5.0,
        "prior standard deviation of an unknown pose's rotation from its start",
        unit="degrees",
        gt=0.0,
        group="pose",
        old=("pose_turn",),
    )
    pose_translation: float = option(
        0.01,
        "prior standard deviation of an unknown pose's translation from its start",
        unit="metres",
        gt=0.0,
        group="pose",
        old=("pose_shift",),
    )
    known_rotation: float = option(
        1.0,
        "standard deviation of the rotation of a pose that is not estimated; 0: known exactly",
        unit="degrees",
        ge=0.0,
        group="pose",
        old=("known_turn",),
    )
    known_translation: float = option(
        0.002,
        "standard deviation of the translation of a pose that is not estimated; a correction counts as displacement",
        unit="metres",
        ge=0.0,
        group="pose",
        old=("known_shift",),
    )
    landmark_deviation: float = option(
        0.002,
        "standard deviation of where the landmarks of each frame were found",
        unit="metres",
        gt=0.0,
        group="noise",
    )
    output_frame: Literal["lps", "ras", "source"] = option(
        "lps", "axes of what is written; source: of the organ's files", group="output"
    )
    output_unit: Literal["mm", "m", "source"] = option(
        "mm", "unit of what is written; source: of the organ's files (nrrd, mrk.json and seq.mrb: mm)", group="output"
    )
    voxel: float = option(
        0.0,
        "edge of a voxel of a displacement field (nrrd); 0: 64 along the organ",
        unit="metres",
        ge=0.0,
        group="output",
    )
    target_points: int = option(
        0, "points of the surface of each inner structure in mrk.json, beside its centre", ge=0, group="output"
    )

    def _check_scan_gravity(self, kinds: list[str]) -> None:
        """The stress-free shape is found once, for what is expected of the tissue."""
        wrong = [kind for kind in kinds if kind in ("young-modulus", "poisson-ratio", "springs", "weight")]
        wrong += ["forces = 'normal'"] * (self.forces == "normal")
        if wrong:
            raise ValueError(
                "registration.scan_gravity: expected tissue and weight that are known, since the stress-free shape "
                f"depends on them, got {', '.join(wrong)} beside it"
            )

    @model_validator(mode="after")
    def _parameters_can_be_found(self) -> RegistrationSection:
        named = [NamedParameter.parse(text) for text in self.parameters]
        kinds, others = [each.kind for each in named], [each for each in named if each.is_input]
        if "contact" in kinds and len(kinds) > 1:
            raise ValueError(f"registration.parameters: expected contact alone, got {', '.join(self.parameters)}")
        models = ["surrogate", "reference", "hybrid", "torch"]
        if "contact" in kinds:
            models.remove("hybrid")
        if any(each.kind not in ("young-modulus", "poisson-ratio", "springs") for each in others):
            models.remove("surrogate")  # it has one support, but for how stiff springs are
        if self.known_forces:  # they are added to those that the network is asked for, where both engines know of them
            models = [model for model in models if model != "surrogate"]
        of_gravity = {"weight", "gravity"} & set(kinds)
        if of_gravity:  # it is among the nodal forces then
            models = ["reference", "torch"]
        if len(of_gravity) > 1:
            raise ValueError("registration.parameters: expected weight or gravity, got both")
        has_weight = any(self.gravity) and not of_gravity
        if any(self.scan_gravity):
            self._check_scan_gravity(kinds)
        if has_weight or any(self.scan_gravity) or self.pressure or "moved" in kinds or self.forces == "known":
            models = ["reference"]  # a network has one support, and no load inside or that follows the surface
        if self.model not in models:
            raise ValueError(
                f"registration.model: expected {' or '.join(models)} with these parameters and known loads (a network "
                f"has learned one material, one support and forces alone), got {self.model}"
            )
        if "weight" in kinds and not any(self.gravity):
            raise ValueError("registration.parameters: expected gravity beside weight, got none (gravity = [0, 0, 0])")
        if self.forces == "known" and not others:
            raise ValueError(
                "registration.parameters: expected at least one (young-modulus, poisson-ratio, moved@NODES) where all "
                "forces are known, got none"
            )
        return self


class Config(Section):
    """One twin, from its surface to its registrations."""

    folder: str = option("twin-run", "folder of everything that is made, relative to this file")
    body: BodySection = part(BodySection)
    springs: SpringsSection = part(SpringsSection)
    material: MaterialSection = part(MaterialSection)
    loads: LoadsSection = part(LoadsSection)
    samples: SamplesSection = part(SamplesSection)
    solver: SolverSection = part(SolverSection)
    training: TrainingSection = part(TrainingSection)
    model_error: ModelErrorSection = part(ModelErrorSection, old=("doubt",))
    registration: RegistrationSection = part(RegistrationSection)

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

    @property
    def supports(self) -> dict[str, Support]:
        """The springs of each part of the surface, and ligaments, by name."""
        return self.springs.supports(self.body.unit, files_axes(self.body) == "ras")

    @model_validator(mode="after")
    def _galerkin_chooses_nothing(self) -> Config:
        if self.samples.rounds and self.training.architecture == "galerkin":
            raise ValueError(
                "samples.rounds: expected 0 with architecture galerkin, which learns nothing more from them"
            )
        return self

    @model_validator(mode="after")
    def _surrogate_knows_the_tissue(self) -> Config:
        if self.registration.model != "surrogate":
            return self
        named = [NamedParameter.parse(text) for text in self.registration.parameters]
        asked = [f"{each.kind}@{each.place}".rstrip("@") for each in named if each.is_input]
        if asked and self.training.architecture != "galerkin":
            raise ValueError(
                f"registration.model: expected reference or hybrid or torch with {asked[0]} (a network has learned one "
                "material, one support and forces alone; training.architecture galerkin takes others), got surrogate"
            )
        unknown = [name for name in asked if name not in self.training.vary and name != "young-modulus"]
        if unknown:
            raise ValueError(
                f"registration.parameters: expected parameters that the surrogate knows a range of (training.vary: "
                f"{', '.join(self.training.vary) or 'none'}), got {unknown[0]}; name its range there and train again, "
                "or use --model reference, torch or hybrid"
            )
        return self

    @model_validator(mode="after")
    def _springs_are_there(self) -> Config:
        named = [NamedParameter.parse(text) for text in self.registration.parameters]
        strange = [each.place for each in named if each.kind == "springs" and each.place not in self.springs.names]
        if strange:
            raise ValueError(
                f"registration.parameters: expected springs@ one of {self.springs.names}, got {strange[0]!r}"
            )
        held = sorted(self.springs.where)
        places = {name: name.partition("@") for name in self.training.vary}
        unheld = [name for name, (kind, _, place) in places.items() if kind == "springs" and place not in held]
        if unheld:
            raise ValueError(f"training.vary: expected springs@ one of {held}, got {unheld[0]!r}")
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
        path: TOML file, or a folder with one that is called organ.toml.

    Raises:
        ConfigError: the file is missing, no TOML, or entries are unknown or out of range.
    """
    path = Path(path)
    if (path / "organ.toml").is_file():
        path = path / "organ.toml"
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
        lines = [f"  {described(Config, item)}" for item in error.errors()]
        raise ConfigError("\n".join([f"{source}: {len(lines)} wrong entries", *lines])) from None


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
        if isinstance(value, Section):
            document.add(tomlkit.nl())
            document.add(name, _table(value))
    return tomlkit.dumps(document)


def _comment(section: type[Section], name: str) -> str:
    entry = option_of(section, name)
    return f"{entry.meaning} [{entry.allowed}]" if entry.allowed else entry.meaning


def _table(section: Section) -> Any:
    table = tomlkit.table()
    table.comment((type(section).__doc__ or "").strip())
    subtables = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, dict):
            subtables[name] = value
            continue
        item = tomlkit.item(list(value) if isinstance(value, tuple) else value)
        table.add(name, item.comment(_comment(type(section), name)))
    for name, value in subtables.items():
        inner = tomlkit.inline_table()
        inner.update(value)
        table.add(name, inner.comment(_comment(type(section), name)))
    return table
