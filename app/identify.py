"""What a body is made of, from clouds under known loads: `softtwin identify`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from softtwin.meshes.io import Unit
from softtwin.registration.parameters.block import Estimate
from softtwin.registration.result import Registration
from softtwin.registration.verdict import Verdict

from .export import WRITTEN, Exporter
from .record import Recorder, describe, describe_estimate
from .register import Scene, Start, check_any, check_output, find_clouds, name_of, registered, say_coordinates
from .twin import Sequence as Frames

Floats = NDArray[np.float64]


def identify_files(
    place: Path,
    names: Sequence[Path | str],
    output: Path,
    options: Mapping[str, Any],
    *,
    unit: Unit | None = None,
    start: Start | None = None,
    say: Callable[[str], None] = print,
) -> int:
    """Find unknowns from the clouds in files, and what all of them together tell; returns how many could be used.

    Args:
        place: the twin; see `find_twin`.
        names: files, folders or patterns of clouds.
        output: folder to write to; see `Recorder`.
        options: entries of [registration] that replace the twin's: unknowns and known loads among them.
        unit: of the clouds; that of the twin's files if not given.
        start: where the camera stands; in the body's coordinates if not given.
        say: prints a line a cloud, and one for each unknown in the end.

    Raises:
        ConfigError, FileError, CloudError, PoseError, TwinError: what cannot be used, and why.
    """
    scene = Scene.of(place, options, unit)
    clouds, found = find_clouds(names, scene.outside, scene.normals), list[Registration]()
    check_output(output, scene.home, names)
    with scene.opened(start or Start(), say) as (twin, camera):
        say_coordinates(twin, say)
        frames = Frames(twin, None, camera)
        with Recorder(Exporter(twin, output, WRITTEN)) as recorder:
            for cloud in tqdm(clouds, desc="identifying", unit="cloud", disable=None):
                frame = registered(frames, cloud)
                with tqdm.external_write_mode():
                    say(describe(recorder.add(frame, name_of(cloud))))
                if frame.registration is not None and frame.judgement.is_usable:
                    found.append(frame.registration)
            estimates = together(found)
            recorder.header["together"] = [asdict(estimate) for estimate in estimates]
    check_any(recorder.rows)
    say(f"of {len(clouds)} clouds {len(found)} could be used")
    doubtful = [result.judgement for result in found if result.judgement.verdict is Verdict.DOUBTFUL]
    if doubtful:
        reasons = Counter(reason for judgement in doubtful for reason in judgement.reasons[:1])
        say(f"warning: {len(doubtful)} of them are doubtful, and so is what follows: {reasons.most_common(1)[0][0]}")
    for estimate in estimates:
        say(describe_estimate(asdict(estimate)))
    return len(found)


def together(found: Sequence[Registration]) -> tuple[Estimate, ...]:
    """What several clouds of one body say of the same unknowns: normal laws whose prior is counted once.

    Args:
        found: a result for each cloud, of the same unknowns.
    """
    if not found:
        return ()
    input_blocks, part = found[0].problem.inputs, found[0].problem.input_part
    assert input_blocks is not None
    precision, pulled = (1.0 - len(found)) * np.eye(input_blocks.size), np.zeros(input_blocks.size)
    for result in found:
        known = np.linalg.inv(result.posterior.covariance[part, part])
        precision += known
        pulled += known @ result.coefficients[part]
    covariance = np.linalg.inv(precision)
    return input_blocks.estimates(covariance @ pulled, covariance)
