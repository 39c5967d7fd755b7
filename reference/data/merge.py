"""Several data sets of one body and material as one: what was solved elsewhere, or later, is learned from together."""

from __future__ import annotations

import hashlib
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .dataset import NEEDED, SPLITS, DataSet, DataSetError, Split, stored_plan
from .writing import create, write_block

_SAME = ("material", "young_modulus", "poisson_ratio", "springs")


def merge(sources: Sequence[DataSet], path: Path | str) -> DataSet:
    """A data set with all draws of others, split by split: what was held out stays held out.

    Draws of active rounds become training draws. Its plan is the first one's, with the samples of all; it cannot be
    gone on with. Jacobians are not taken along: `generate` makes them again.

    Args:
        sources: at least two, complete, of one body, one material, the same modes and as many draws of each load path
            (`ramp`): a bound that is calibrated on paths of two kinds holds for loads of neither. Where several have
            smooth draws, these are as smooth in all.
        path: folder to make.

    Raises:
        DataSetError: something is there already, sets that do not belong together, a draw that is in two of them, or
            blocks that are missing or damaged.
    """
    path = Path(path)
    _check(sources, path)
    first = sources[0]
    block = first.header["block"]
    kinds: tuple[Split, ...] = (*NEEDED, "calibration", "smooth")
    counts = {split: sum(map(len, _ranges(sources, split))) for split in kinds}
    counts = {split: count for split, count in counts.items() if count}
    header = {
        **{name: entry for name, entry in first.header.items() if name not in ("format", "body", "checksums")},
        "samples": counts,
        "plan": {**stored_plan(first.header), **_loads(sources), "samples": counts},
        "merged": [_told(source) for source in sources],
    }
    partial = path.with_name(f".{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    made = create(partial, header, first.body, first.response, first.shapes, first.eigenvalues)
    for split in counts:
        number = made.split_draws(split).start // block
        for rows in _blocks(sources, split, block):
            write_block(partial, number, rows)
            number += 1
    partial.rename(path)
    return DataSet(path)


def _smoothness(source: DataSet) -> float | None:
    """Correlation length of a set's smooth draws, metres; None where it has none."""
    told = stored_plan(source.header).get("loads", {}).get("smoothness")
    return float(told) if len(source.split_draws("smooth")) and told is not None else None


def _loads(sources: Sequence[DataSet]) -> dict[str, Any]:
    """The first plan's loads, with how smooth the smooth draws of any set are."""
    loads = stored_plan(sources[0].header).get("loads")
    known = [each for each in map(_smoothness, sources) if each is not None]
    return {"loads": {**loads, "smoothness": known[0]}} if loads is not None and known else {}


def _told(source: DataSet) -> dict[str, Any]:
    """What a merged set keeps of a source, with what that was merged from: where its load paths begin, for instance."""
    header = source.header
    known = {name: header[name] for name in ("merged",) if name in header}
    known |= {"engines": source.engines} if source.engines else {}
    return {"identity": source.identity, "samples": header["samples"], "plan": header.get("plan", {}), **known}


def _check(sources: Sequence[DataSet], path: Path) -> None:
    if path.exists():
        raise DataSetError(f"merge.path: expected a folder that is not there yet, found {path}.")
    if len(sources) < 2:
        raise DataSetError(f"merge.sources: expected at least two data sets, got {len(sources)}.")
    first = sources[0]
    for other in sources[1:]:
        where = f"{other.path} and {first.path}"
        if other.body.fingerprint != first.body.fingerprint:
            raise DataSetError(f"merge.sources: expected one body, got {where}, which differ in nodes, cells or sets.")
        plans = stored_plan(first.header), stored_plan(other.header)
        wrong = [f"{name} ({plans[0].get(name)}, {plans[1].get(name)})" for name in _SAME
                 if plans[0].get(name) != plans[1].get(name)]  # fmt: skip
        if wrong:
            raise DataSetError(f"merge.sources: expected one material and support, got {where}: {'; '.join(wrong)}.")
        ramps = [plan.get("ramp", 1) for plan in plans]
        if ramps[0] != ramps[1]:
            raise DataSetError(
                f"merge.sources: expected as many draws of each load path, got {where} with {ramps[1]} and {ramps[0]} "
                "(samples.load_path); make both with the same."
            )
        if not np.array_equal(other.response.loaded, first.response.loaded):
            raise DataSetError(f"merge.sources: expected the same loaded nodes, got others in {where}.")
        if other.has_gradients != first.has_gradients or not _alike(other.shapes, first.shapes):
            raise DataSetError(
                f"merge.sources: expected gradients for the same modes, got others in {where}; make both with the same "
                "loads.modes, on one machine."
            )
    smooth = sorted({each for each in map(_smoothness, sources) if each is not None})
    if len(smooth) > 1:
        raise DataSetError(
            f"merge.sources: expected smooth draws of one correlation length (loads.smoothness), got {smooth[0]:g} and "
            f"{smooth[-1]:g} m: what is told of them would hold for neither."
        )
    _refuse_twice(sources)


def _alike(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return one.shape == other.shape and np.allclose(one, other, rtol=0.0, atol=1e-9 * np.abs(one).max(initial=1e-300))


def _refuse_twice(sources: Sequence[DataSet]) -> None:
    """A draw of one set that another holds out, or learns from again, would be told by nobody."""
    loads: Counter[bytes] = Counter()
    for source in sources:
        here, size = set(), source.header["block"]
        for split in SPLITS:
            draws = source.split_draws(split)
            if len(draws):
                source.check_complete(split)
            for begin in range(draws.start, draws.stop, size):
                rows = source.rows(range(begin, min(begin + size, draws.stop)))
                here |= {hashlib.sha256(forces.tobytes()).digest() for forces in rows["forces"]}
        loads.update(here)
    twice = sum(count > 1 for count in loads.values())
    if twice:
        raise DataSetError(
            f"merge.sources: expected draws that differ, got {twice} that are in more than one set; were they made "
            "with the same seed? Make one of them with another [samples] seed."
        )


def _ranges(sources: Sequence[DataSet], split: Split) -> list[range]:
    return [draws for source in sources for draws in source.ranges(split)]


def _blocks(sources: Sequence[DataSet], split: Split, size: int) -> Iterator[dict[str, NDArray[Any]]]:
    """The rows of a split of all sources one after the other, in whole blocks; the last is filled up with its last."""
    kept: dict[str, NDArray[Any]] = {}
    pairs = [(source, draws) for source in sources for draws in source.ranges(split)]
    for source, draws in pairs:
        for begin in range(draws.start, draws.stop, size):
            rows = source.rows(range(begin, min(begin + size, draws.stop)))
            kept = {name: np.concatenate([kept[name], values]) if kept else values for name, values in rows.items()}
            while len(kept["reason"]) >= size:
                yield {name: values[:size] for name, values in kept.items()}
                kept = {name: values[size:] for name, values in kept.items()}
    if kept and len(kept["reason"]):
        missing = size - len(kept["reason"])
        yield {name: np.concatenate([values, np.repeat(values[-1:], missing, axis=0)]) for name, values in kept.items()}
