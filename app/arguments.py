"""Options that only the command line has: what is said of one run, and not of a twin."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from .schema import Section, option


class CloudArguments(Section):
    """Clouds in files, or from a peer."""

    unit: Literal["m", "cm", "mm"] | None = option(None, "unit of the clouds; the organ's if not given", basic=True)
    frame: Literal["lps", "ras"] | None = option(None, "axes of the clouds; the organ's if not given", basic=True)


class StartArguments(Section):
    """Where the camera stands: at most one of these."""

    group: ClassVar[str] = "pose"

    start: Path | None = option(
        None,
        "4 x 4 matrix from the undeformed body to the camera, shift in the clouds' unit (TXT CSV NPY JSON; TFM: mm)",
        basic=True,
        exists=True,
    )
    landmarks: tuple[Path, Path] | None = option(
        None,
        "named points on the body and in the camera's coordinates, which give the start of the pose",
        basic=True,
        exists=True,
        metavar="BODY CAMERA",
    )
    align: Literal["auto"] | None = option(None, "search the pose in the first cloud that shows it", basic=True)


class WatchArguments(Section):
    """A source that goes on."""

    watch: bool = option(
        False,
        "register the newest cloud until Ctrl-C; CLOUDS is a folder that is written to, or a place of OpenIGTLink "
        "(igtl://HOST:PORT, igtl://:PORT to listen; mm and RAS if not given)",
        basic=True,
    )
    idle: float | None = option(None, "end after this time without a new cloud", unit="seconds", gt=0.0)
    learn: bool = option(
        False,
        "learn while it is used: a second process solves for exact states of frames and of loads that may come, and "
        "adapts the surrogate to them; frames wait for nothing",
    )
    keep: bool = option(
        False, "with learn: put what was learned into the twin at the end, and what was built into its folder as-built"
    )


class RegisterArguments(Section):
    """One run of `softtwin register`."""

    group: ClassVar[str] = "output"

    frame_landmarks: tuple[Path, Path] | None = option(
        None,
        "named points that are fitted beside the clouds: on the undeformed organ, and a folder with a file for each "
        "cloud, named like it (or a file, for one cloud)",
        group="input",
        exists=True,
        metavar="BODY CAMERA",
        old=("marks",),
    )
    truth: Path | None = option(
        None, "true node positions in .npy, (frames, n, 3), to state errors", unit="metres", group="input", exists=True
    )
    formats: tuple[str, ...] = option(
        (),
        "files of each frame: vtu: the organ; stl, ply, obj, vtp: surfaces; nrrd: displacement field; mrk.json: "
        "targets; seq.mrb: sequences; vtu and vtp if not given",
        basic=True,
        flag="--format",
    )
    budget: float | None = option(
        None,
        "time for a frame, after which the best so far is taken; no limit if neither given nor in organ.toml",
        unit="seconds",
        group="solver",
        gt=0.0,
    )
    strict: bool = option(False, "end with code 3 unless every frame is accepted")
    output: Path = option(Path("registration"), "folder of the results", basic=True)


class IdentifyArguments(Section):
    """One run of `softtwin identify`."""

    group: ClassVar[str] = "output"

    output: Path = option(Path("identification"), "folder of the results", basic=True)


class TrainArguments(Section):
    """Where the network is trained."""

    group: ClassVar[str] = "training"

    device: Literal["auto", "cpu", "cuda"] = option(
        "auto", "device to train on; auto: a GPU where torch sees one", basic=False
    )
    processes: int = option(1, "processes that train together: a GPU each, or cores of this machine", ge=1)


class FreshArguments(Section):
    """What is done with earlier checkpoints."""

    group: ClassVar[str] = "training"

    fresh: bool = option(False, "throw earlier checkpoints away instead of going on from them", basic=True)


class EvaluateArguments(Section):
    """One run of `softtwin evaluate`."""

    group: ClassVar[str] = "input"

    cloud: tuple[str, ...] = option(
        (), "file of a cloud, a folder of them, or a pattern in quotes; may be given several times", basic=True
    )
    landmarks: tuple[str, str] | None = option(
        None,
        "places inside the organ that registration does not see: in the organ at rest, and where they are in each "
        "cloud's frame (a file, or a folder with one for each cloud, named like it); paired by names, or by rows; with "
        ":mm, :lps and so on behind a file in another unit or on other axes than the organ's files, or the clouds",
        basic=True,
        metavar="REST MOVED",
    )
    localisation_error: float = option(
        0.0,
        "standard deviation of each coordinate of a landmark that was set by hand; regions are the larger by it",
        unit="metres",
        ge=0.0,
        basic=True,
    )
    output: Path = option(Path("evaluation"), "folder to write to", group="output", basic=True)


class GenerateArguments(Section):
    """One run of `softtwin generate`."""

    group: ClassVar[str] = "equilibria"

    redo: tuple[int, ...] = option((), "number of a block to make again", basic=True)
    again: bool = option(False, "throw a data set that is there away, and make it anew", basic=True)
    shard: str | None = option(
        None,
        "solve shard I of N alone, I from 0, beside other jobs (examples/slurm.sh)",
        basic=True,
        metavar="I/N",
        old=("part",),
    )
    engine: Literal["reference", "torch"] = option(
        "reference",
        "what solves the equilibria; torch: many at once, in one process; the reference solves 1 % of them again",
        basic=True,
    )
    device: Literal["cpu", "cuda"] = option("cpu", "device of --engine torch", basic=True)


class BuildArguments(Section):
    """One run of `softtwin build`."""

    group: ClassVar[str] = "output"

    output: Path = option(Path("twin-run"), "folder of everything that is made", basic=True)
    again: bool = option(False, "throw equilibria that were solved in OUTPUT before away")


class QuickstartArguments(Section):
    """One run of `softtwin quickstart`."""

    group: ClassVar[str] = "output"

    output: Path = option(Path("softtwin-quickstart"), "folder of everything that is made", basic=True)
    small: bool = option(
        False, "a coarse organ and few samples: the same path in about a minute, for tests", basic=True
    )


class ExportArguments(Section):
    """One run of `softtwin export`."""

    group: ClassVar[str] = "output"

    output: Path | None = option(None, "folder to write; TWIN/onnx if not given", basic=True)
    directions: int = option(64, "directions of force in the Jacobian", ge=1, basic=True)


class DrawArguments(Section):
    """One run of `softtwin data export`."""

    draws: tuple[int, ...] = option((), "number of a draw", basic=True, flag="--draw")


class ReportArguments(Section):
    """One run of `softtwin report`."""

    registrations: tuple[Path, ...] = option((), "folder that softtwin register wrote", basic=True, exists=True)


class PageArguments(Section):
    """The page of `softtwin live`, `demo` and `pick`."""

    group: ClassVar[str] = "output"

    port: int | None = option(
        None, "port of the page; the first free one from 8080 on if not given", ge=1, le=65535, basic=True
    )
    browser: bool = option(True, "open the page where there is a display", basic=True)


class DemoArguments(Section):
    """One run of `softtwin demo`."""

    group: ClassVar[str] = "output"

    record: Path | None = option(None, "record the scene to this HTML file, which plays by itself, and end", basic=True)
    seconds: float = option(8.0, "length of the record", unit="seconds", ge=0.5, le=120.0, basic=True)


class PickArguments(Section):
    """What `softtwin pick` shows."""

    unit: Literal["m", "cm", "mm"] = option("m", "unit of the files", basic=True)
    frame: Literal["lps", "ras"] | None = option(None, "axes of files that state none", basic=True)
    inner: tuple[str, ...] = option((), "a vessel or tumour surface to show along", basic=True, metavar="NAME=FILE")
