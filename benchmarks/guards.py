"""What a rewritten registration may not make worse: a few cases of every benchmark of it, each with its own figures.

    python benchmarks/guards.py both                    # all rows, by two processes; goes on where it was stopped
    python benchmarks/guards.py --half liver            # the rows of one of them; --half others: of the other one
    python benchmarks/guards.py --only "calibration" --few --dry
    git show COMMIT:benchmarks/results/guards.json > OLD.json
    python benchmarks/guards.py --against OLD.json [NEW.json]     # old beside new; ends with 1 where a row is worse

The cases are those of robustness, liver_engines, foreign_patches and pose_noise (the half `liver`: all on the sequences
of the real liver, which lie between both engines) and of calibration, misspecified, alignment, beam_registration and
lungs (`others`), by the functions of these scripts. A case has the name, the truth and the noise that it has there, and
in every record; `comparison.py` says how two records are compared, and by which statistics. The two halves share no
twin that is dear to open, and take about as long.

Wrong, so that to accept it is a mistake, is a mean error of the nodes beyond the row's limit (2 mm on the organs, 5 mm
where the pose is taken for exact and is not, 1 mm on the beam whose points have no noise, 5 mm on the one that moves by
80, 9 mm of the lungs' landmarks), or beyond what doing nothing would be off by; a pose that is 30 mm off; and any state
of what is no state of the organ. Margins of a row with an unknown pose are those of positions that the camera sees, as
its errors are.

Old and new have to be of the same twins: they lie in benchmarks/runs/ of the tree that made the record, and a row names
its twin by a hash. The last row, `pace`, is of seconds alone: no case, no sampling error, no guard; another process
beside it makes it slower.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import alignment
import beam_registration
import calibration
import foreign_patches
import liver_engines
import lungs
import misspecified
import numpy as np
import pose_noise
import robustness
import stream
from columns import Column, markdown
from comparison import FIGURES, Case, RowFinding, cases_of, compared
from harness import RANKS, Benchmark, Given, Setting, run
from networks_bodies import data_of
from record import RESULTS, RUNS
from summaries import covered

from softtwin.app.twin import Sequence, Twin, find_twin
from softtwin.registration.pose import Pose
from softtwin.registration.result import Registration

SHARES = (0.9, 0.95)
ORGAN, OTHER_POSE, BEAM, MOVED_BEAM, LUNG = 2.0, 5.0, 1.0, 5.0, 9.0  # mm: beyond it a state is wrong
LUNGS = ((2, "right"), (4, "right"), (4, "left"), (5, "left"))  # whose searches have gone astray before
BLOCK = 5  # frames of a sequence that have much in common
LEVELS = (1e-4, 5e-4, 1e-3)  # of the pose's noise, of pose_noise's ten
HALVES = ("liver", "others")
PACE, PACED, EVERY = "pace", 300, 3  # frames; every third cloud of 60 a second
_FEW = 2  # in place of any number of draws, frames or cases


def so_many(given: Given, count: int) -> int:
    """A number of cases, or a few for a look."""
    return min(count, _FEW) if given.few else count


# ---------------------------------------------------------------------- from the rows of scripts to cases


def case(name: str, group: str, told: Mapping[str, Any], limit: float) -> Case:
    """A case by what a script says of it.

    Args:
        name: of the case.
        group: cases that have much in common.
        told: by the script.
        limit: beyond which an error is wrong, millimetres.
    """
    if "failed" in told:
        return Case(name, group, "failed")
    error, moved = told.get("tre_mm", told.get("error_mm")), told.get("moved_mm", told.get("tre_nothing_mm"))
    return Case(
        name,
        group,
        told["verdict"],
        error is not None and error > min(limit, moved),
        moved,
        error,
        told.get("tumour_mm"),
        told.get("force_error", told.get("force_off")),
        3.0 * told["z2"] if "z2" in told else None,
        {str(share): told["covered"][str(share)] for share in SHARES} if "covered" in told else {},
        {str(share): told["structures"][str(share)] for share in SHARES} if "structures" in told else {},
        told.get("seconds"),
    )


def frame(told: Mapping[str, Any], *words: object) -> str:
    """The name of a frame of a sequence."""
    return "/".join(map(str, (told["sequence"], told["frame"], *words)))


# ---------------------------------------------------------------------- the rows


@dataclass(frozen=True)
class Guard:
    """A row.

    Args:
        half: that makes it.
        cases: of it.
        twin: the folder of the network that it registers with; None where it needs none.
    """

    half: str
    cases: Callable[[Given], list[Case]]
    twin: Callable[[Given], Path] | None = None


def the_liver(given: Given) -> Path:
    return given.twin


def the_phantom(given: Given) -> Path:
    return find_twin(given.quickstart).folder


def the_beam(given: Given) -> Path:
    return RUNS / f"{beam_registration.BODY}-{given.beam_seconds:g}s"


def robust(engine: str, name: str) -> Guard:
    """Frames 0 to 9 (to 2 with the reference) of the sequences, cold and warm, under one degradation."""

    def cases(given: Given) -> list[Case]:
        model = given.opened(robustness.forward_model, engine, given.twin)
        frames, draws = (10, 2) if engine == "surrogate" else (3, 1)
        degrade, _, is_posed = robustness.ROWS[name]
        draws = 1 if degrade is robustness.clean and not is_posed else draws
        rows = robustness.run_row(name, model, so_many(given, draws), so_many(given, frames))
        return [case(frame(row, row["draw"], row["start"]), frame(row), row, ORGAN) for row in rows]

    return Guard("liver", cases, the_liver if engine == "surrogate" else None)


def nonsense(engine: str) -> Guard:
    """Clouds that show no state of the organ: none has a right answer."""

    def cases(given: Given) -> list[Case]:
        rows = robustness.nonsense(given.opened(robustness.forward_model, engine, given.twin))
        return [Case(row["cloud"], row["cloud"], row["verdict"], wrong=True) for row in rows]

    return Guard("liver", cases, the_liver if engine == "surrogate" else None)


def engine(name: str) -> Guard:
    """The sequences, each frame from the one before: all of the surrogate's, the first 11 of others."""
    row = liver_engines.ROWS[name]

    def cases(given: Given) -> list[Case]:
        frames = so_many(given, 50 if row.engine == "surrogate" else 11)
        rows = liver_engines.run_row(row, given.twin, given.ranks, frames)
        return [case(frame(each), f"{each['sequence']}/{each['frame'] // BLOCK}", each, ORGAN) for each in rows]

    return Guard("liver", cases, None if row.engine == "reference" else the_liver)


def patched(engine: str, name: str) -> Guard:
    """Four frames of each sequence with a part of the cloud elsewhere, from rest."""

    def cases(given: Given) -> list[Case]:
        model = given.opened(robustness.forward_model, engine, given.twin)
        registrars = {s: given.once(foreign_patches.registrar_for_sequence, model, s) for s in robustness.SEQUENCES}
        draws = so_many(given, 4 if engine == "surrogate" else 1)
        rows = foreign_patches.rows_of(name, registrars, model.body, draws)
        return [case(frame(row, row["draw"]), frame(row), row, ORGAN) for row in rows]

    return Guard("liver", cases, the_liver if engine == "surrogate" else None)


def posed(name: str) -> Guard:
    """Draws of one frame with noise of pose and cloud."""
    engine, has_pose, level = pose_noise.ROWS[name]

    def cases(given: Given) -> list[Case]:
        model = given.opened(robustness.forward_model, engine, given.twin)
        known = given.once(pose_noise.prepared, model, has_pose)
        draws = so_many(given, 100 if engine == "surrogate" else 12)
        rows = pose_noise.draws_of(known.registrar, known.clean, model.body, level, draws, has_pose)
        return [case(str(draw), str(draw), row, OTHER_POSE) for draw, row in enumerate(rows)]

    return Guard("liver", cases, the_liver if engine == "surrogate" else None)


def calibrated(name: str) -> Guard:
    """Truths drawn from the prior."""
    is_beam = name.startswith("beam")

    def cases(given: Given) -> list[Case]:
        one = calibration.CASES[name](given.twin, given.ranks)
        rows, _ = calibration.rows_of(one, so_many(given, 200 if is_beam else 120))
        return [
            case(str(i), str(i), calibrated_as_told(row), MOVED_BEAM if is_beam else ORGAN)
            for i, row in enumerate(rows)
        ]

    return Guard("others", cases, the_beam if is_beam else the_liver)


def calibrated_as_told(row: dict[str, Any]) -> dict[str, Any]:
    """A row of calibration in the words of the others."""
    if "z" not in row:
        return row
    shares = dict(zip(map(str, calibration.SHARES), row["covered"], strict=True))
    return {**row, "covered": shares, "z2": float(np.square(row["z"]).sum() / 3.0)}


def misspecified_as(engine: str, kind: str, has_ensemble: bool) -> Guard:
    """States of an organ that is not what the twin takes it for."""

    def cases(given: Given) -> list[Case]:
        states = given.once(misspecified.states_of, given.quickstart, kind, so_many(given, 24))
        few = states[:12] if misspecified.ENGINES[engine].get("parameters") else states  # four times as dear
        rows = misspecified.registered(given.quickstart, engine, few, has_ensemble)
        shares = ({**row, "covered": by_name(row["nodes"]), "structures": by_name(row["structures"])} for row in rows)
        return [case(str(i), str(i), row, ORGAN) for i, row in enumerate(shares)]

    return Guard("others", cases, the_phantom)


def by_name(shares: Mapping[float, float]) -> dict[str, float]:
    """Shares by their level in words."""
    return {str(level): share for level, share in shares.items()}


def aligned(name: str) -> Guard:
    """Rigid starts for views of the organ; an error is of those that are found."""
    kind, share = alignment.KINDS[name]

    def one(number: int, view: alignment.View, cloud: Any) -> Case:
        found, seconds, _ = alignment.timed(alignment.organ().boundary_surface, cloud)
        moved = 1e3 * Pose.identity().distance_to(view.pose, view.positions)
        off = alignment.off(found, view)
        verdict, error = ("accepted", 1e3 * off) if found.is_found else ("refused", None)
        is_wrong = bool(off >= alignment.FAR)
        return Case(str(number), str(number), verdict, is_wrong, moved, error, seconds=seconds)

    def cases(given: Given) -> list[Case]:
        views = zip(*alignment.views_of(kind, share, so_many(given, 40)), strict=True)
        return [one(i, *each) for i, each in enumerate(views)]

    return Guard("others", cases)


def impossible(name: str) -> Guard:
    """Clouds for which every rigid start is wrong."""

    def one(number: int) -> Case:
        cloud = alignment.IMPOSSIBLE[name](np.random.default_rng([3, number]))
        found, seconds, _ = alignment.timed(alignment.organ().boundary_surface, cloud)
        return Case(str(number), str(number), "accepted" if found.is_found else "refused", True, seconds=seconds)

    return Guard("others", lambda given: [one(number) for number in range(so_many(given, 20))])


def beam_network(given: Given) -> Any:
    """The network of table 6.1, trained once."""
    return beam_registration.network_of(data_of(beam_registration.BODY, given.ranks, True), given.beam_seconds)


def tabled(way: str, count: int) -> Guard:
    """Table 6.1: the beam under fresh loads, points without noise."""

    def cases(given: Given) -> list[Case]:
        run_one = beam_registration.WAYS[way](given.once(beam_network, given))
        loads = given.opened(beam_registration.solved, given.ranks, so_many(given, 150))
        return [tabled_case(one, beam_registration.answered(run_one, one)) for one in loads[: so_many(given, count)]]

    return Guard("others", cases, the_beam)


def tabled_case(one: beam_registration.Case, found: beam_registration.Answer | str) -> Case:
    """One load of table 6.1."""
    row = beam_registration.judged(found, one, None)
    told = {"failed": row["failure"]} if row["failure"] else {**row, "error_mm": 1e3 * row["mean_m"]}
    if not isinstance(found, str) and found.registration is not None:
        known, net = found.registration, one.forces.sum(axis=0)
        errors = np.linalg.norm(found.displacement - one.truth, axis=1)
        told |= {"moved_mm": 1e3 * float(np.linalg.norm(one.truth, axis=1).mean()), "seconds": found.seconds}
        told |= {"covered": covered(errors, known.uncertainty, SHARES), "z2": force_z2(known, net)}
    return case(str(one.number), str(one.number), told, BEAM)


def lung(seen: str) -> Guard:
    """Measured lungs, the whole surface, half of it, or a fifth of its points wrong: errors, regions of landmarks."""

    def one(number: int, side: str, given: Given) -> Case:
        told = lungs.work(f"case {number}, {side}, {seen}", given)
        name = f"{number} {side}"
        return case(name, name, {**told, "moved_mm": told["before_mm"], "covered": told["within"]}, LUNG)

    return Guard("others", lambda given: [one(*each, given) for each in LUNGS[: so_many(given, len(LUNGS))]])


def force_z2(found: Registration, net_force: Any) -> float:
    """Squared error of the net force in the metric of its covariance, over its components."""
    off = found.net_force - net_force
    return float(off @ np.linalg.solve(found.net_force_covariance, off) / 3.0)


def guards() -> Iterator[tuple[str, Guard]]:
    """All rows but the pace."""
    for one in ("surrogate", "reference"):
        yield from ((f"robustness, {one}: {name}", robust(one, name)) for name in robustness.ROWS)
        yield f"robustness, {one}: {robustness.NONSENSE}", nonsense(one)
    yield from ((f"liver_engines: {name}", engine(name)) for name in liver_engines.ROWS)
    for one in ("surrogate", "reference"):
        yield from ((f"foreign_patches, {one}: {name}", patched(one, name)) for name in foreign_patches.ROWS)
    for name, (one, _, level) in pose_noise.ROWS.items():
        if level in LEVELS and (one == "surrogate" or level == LEVELS[-1]):
            yield f"pose_noise: {name}", posed(name)
    yield from ((f"calibration: {name}", calibrated(name)) for name in calibration.CASES)
    for row in misspecified.ROWS:
        one, kind = row.split(": ")
        yield f"misspecified, ensemble: {row}", misspecified_as(one, kind, True)
        if one in ("surrogate", "hybrid"):
            yield f"misspecified, no ensemble: {row}", misspecified_as(one, kind, False)
    yield from ((f"alignment: {name}", aligned(name)) for name in alignment.KINDS)
    yield from ((f"alignment: {name}", impossible(name)) for name in alignment.IMPOSSIBLE)
    known, anywhere, _ = beam_registration.WAYS  # the third is the thesis's way, not ours
    yield f"table 6.1: {known}", tabled(known, 150)
    yield f"table 6.1: {anywhere}", tabled(anywhere, 50)
    yield from ((f"lungs: {seen}", lung(seen)) for seen in ("whole", "half", "outliers"))


GUARDS = dict(guards())


def pace(given: Given) -> dict[str, Any]:
    """Seconds of a warm frame of the quickstart's twin, as a stream of 60 clouds a second asks for them."""
    with Twin.open(given.quickstart, "surrogate", pose="fixed") as twin:
        clouds = stream.clouds_of(twin, stream.path_of(given.quickstart))
        sequence = Sequence(twin, "", is_live=True)
        sequence.register(clouds[0])
        frames = [sequence.register(clouds[EVERY * i % len(clouds)]) for i in range(1, 1 + so_many(given, PACED))]
    seconds = np.array([frame.seconds for frame in frames])
    return {
        "twin": fingerprint(the_phantom(given)),
        "is_guarded": False,
        "frames": len(frames),
        "accepted": sum(frame.judgement.verdict.value == "accepted" for frame in frames),
        "ms": {
            "median": 1e3 * np.median(seconds),
            "p95": 1e3 * np.quantile(seconds, 0.95),
            "longest": 1e3 * seconds.max(),
        },
    }


def fingerprint(folder: Path) -> str:
    """A hash of the files of a twin."""
    found = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        found.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:12]


def work(row: str, given: Given) -> dict[str, Any]:
    if row == PACE:
        return pace(given)
    guard, begun = GUARDS[row], time.process_time()
    cases = [each.as_entry() for each in guard.cases(given)]
    twin = None if guard.twin is None else fingerprint(guard.twin(given))
    return {"twin": twin, "processor_seconds": round(time.process_time() - begun, 1), "cases": cases}


def rows_of(given: Given) -> list[str]:
    """The rows of a half, or all."""
    halves = {name: guard.half for name, guard in GUARDS.items()} | {PACE: "others"}
    return [name for name, half in halves.items() if given.half in ("all", half)]


# ---------------------------------------------------------------------- both halves; old beside new


def both(*words: str) -> None:
    """Make both halves at once, each in a process of one thread."""
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    commands = [[sys.executable, __file__, "--half", half, *words] for half in HALVES]
    ended = [process.wait() for process in [subprocess.Popen(command, env=one_thread) for command in commands]]
    raise SystemExit(max(ended))


def against(old: str, new: str = str(RESULTS / "guards.json")) -> None:
    """Print an old record beside a new one; ends with 1 where a row is worse or missing."""
    was, now = (json.loads(Path(path).read_text())["figures"] for path in (old, new))
    found = compared(was, now)
    print("\n".join(map(page_of, found)))
    print(paces(was.get(PACE), now.get(PACE)))
    print(markdown(["row", "verdict"], [[row.row, row.verdict] for row in found if row.row != PACE]))
    count = sum(finding.is_guarded for row in found for finding in row.findings)
    print(
        f"{sum(row.fails for row in found)} of {len(found)} rows fail; {count} figures are guarded, by chance 1 % alarm"
    )
    raise SystemExit(int(any(row.fails for row in found)))


def page_of(row: RowFinding) -> str:
    """A row's figures, old beside new."""
    lines = [
        [
            each.figure,
            each.old,
            each.new,
            each.change,
            each.word if each.is_guarded else f"({each.word})",
            *named(each.names),
        ]
        for each in row.findings
    ]
    table = markdown(["figure", "old", "new", "change", "", "cases"], [[*line, ""][:6] for line in lines])
    return f"## {row.row}: {row.verdict}\n\n{row.said}\n\n{table if lines else ''}"


def named(names: tuple[str, ...]) -> list[str]:
    """The first of some cases, and how many more there are."""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return [", ".join(names[:5]) + more] if names else []


def paces(*rows: Mapping[str, Any] | None) -> str:
    """Median, 95 % and longest of a warm frame of both."""
    told = [f"{r['ms']['median']:.0f} / {r['ms']['p95']:.0f} / {r['ms']['longest']:.0f} ms" if r else "-" for r in rows]
    return f"pace of a warm frame (median / 95 % / longest; not guarded): {told[0]} before, {told[1]} now\n"


def warm(row: dict[str, Any]) -> str:
    """The cell of the pace."""
    return " / ".join(f"{value:.0f}" for value in row["ms"].values())


BENCHMARK = Benchmark(
    name="guards",
    title="Guards of registration: a few cases of every benchmark of it, case by case, with sampling errors",
    about=("registration", "surrogate", "reference", "app"),
    work=work,
    rows=rows_of,
    columns=(
        *(Column(f.name, f.unit, lambda row, f=f: f.shown(cases_of(row)) if "cases" in row else "-") for f in FIGURES),  # type: ignore[misc]
        Column("the row, processor", "s", "{processor_seconds:.0f}"),
        Column("pace: median / 95 % / longest", "ms", warm),
    ),
    settings={
        "half": Setting("all", "rows of one process", choices=("all", *HALVES), picks=True),
        "twin": Setting(RUNS / "liver" / "twin", "that registration_surrogate.py makes", picks=True),
        "quickstart": Setting(RUNS / "quickstart", "what `softtwin quickstart --output FOLDER` makes", picks=True),
        "beam_seconds": Setting(200.0, "of training of the beam's network", picks=True),
        "ranks": RANKS,
        "few": Setting(False, "two cases where there are many"),
    },
    small={"few": True},
    seeds=(0, 1, 3, 7, 11),
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"both": both, "--against": against})
