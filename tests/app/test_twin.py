"""Python's way in: what a twin predicts, registers, streams and tells, with any forward model behind it."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtwin.app.config import Config, ConfigError, to_toml
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.clouds import CloudError
from softtwin.registration.pose import Pose
from softtwin.registration.residuals.landmarks import LandmarkPairs
from softtwin.registration.verdict import Verdict

from .conftest import pulled, seen_cloud

TURNED = Pose.identity().moved(np.array([0.02, -0.03, 0.02, 0.004, -0.003, 0.002]), np.array([0.15, 0.03, 0.03]))


@pytest.fixture(scope="module")
def forces(plain_twin: Twin) -> np.ndarray:
    return pulled(plain_twin.body, (0.0, 0.06, -0.2))


def test_a_cloud_gives_back_the_force(plain_twin: Twin, forces) -> None:
    result = plain_twin.register(seen_cloud(plain_twin, forces))
    assert result.judgement.verdict is Verdict.ACCEPTED
    assert np.linalg.norm(result.net_force - forces.sum(axis=0)) < 0.05 * np.linalg.norm(forces.sum(axis=0))


def test_targets_and_surfaces_are_where_the_body_carries_them(plain_twin: Twin, forces) -> None:
    result = plain_twin.register(seen_cloud(plain_twin, forces))
    rest = plain_twin.body.inner["tumour"].points
    truth = rest + plain_twin.embeddings["tumour"].displace(plain_twin.predict(forces).displacement)
    found = plain_twin.targets(result)["tumour"]
    assert np.linalg.norm(found - truth, axis=1).max() < 5e-4 < np.linalg.norm(rest - truth, axis=1).min()
    surfaces = plain_twin.surfaces(result)
    assert list(surfaces) == ["organ", "tumour"]
    assert np.array_equal(surfaces["tumour"].points, found)
    assert np.array_equal(surfaces["organ"].points, plain_twin.body.points + result.displacement)


def test_an_inner_structure_may_be_called_organ(plain_twin: Twin, forces) -> None:
    body = replace(plain_twin.body, inner={"organ": plain_twin.body.inner["tumour"]})
    twin = Twin(replace(plain_twin.model, body=body), plain_twin.config)
    surfaces = twin.surfaces(twin.register(seen_cloud(twin, forces)))
    assert {name: len(surface.triangles) for name, surface in surfaces.items()} == {
        "organ surface": len(body.boundary),
        "organ": 4,
    }


def test_what_a_zone_needs_is_prepared_once(plain_twin: Twin) -> None:
    assert plain_twin.registrar("tip") is plain_twin.registrar()
    assert plain_twin.registrar("") is not plain_twin.registrar("tip")


def test_a_zone_that_is_not_there_is_named(plain_twin: Twin) -> None:
    with pytest.raises(ConfigError, match=r"registration\.zone: expected one of .*tip.*, got 'nowhere'"):
        plain_twin.register(np.zeros((9, 3)), zone="nowhere")
    with pytest.raises(ConfigError, match="nowhere"):
        next(plain_twin.stream([], zone="nowhere"))


def test_a_known_camera_changes_nothing_but_coordinates(plain_twin: Twin, forces) -> None:
    cloud = seen_cloud(plain_twin, forces)
    plain = plain_twin.register(cloud, camera=Pose.identity())
    seen = plain_twin.register(TURNED.apply(cloud), camera=TURNED)
    assert seen.pose is TURNED
    # Both have converged: a further step is shorter than a fifth of what is uncertain.
    assert (np.abs(seen.net_force - plain.net_force) < 0.2 * plain.net_force_deviation).all()


@pytest.mark.parametrize("off", [0.0, 1.0])
def test_a_pose_that_nobody_asks_for_is_known_to_a_few_millimetres(plain_twin: Twin, forces, off: float) -> None:
    """What it is off by is displacement, within the margins; exactly known, it makes a wrong organ."""
    turn = Rotation.from_rotvec(off * np.deg2rad(0.7) * np.array([0.0, 0.6, 0.8])).as_matrix()
    moved = Pose(turn, off * np.array([1e-3, -2e-3, 2e-3]))
    cloud = moved.apply(seen_cloud(plain_twin, forces))
    rest = plain_twin.body.points
    truth = moved.apply(rest + plain_twin.predict(forces).displacement) - rest
    free = np.setdiff1d(np.arange(len(rest)), plain_twin.body.fixed)
    errors, covered = {}, {}
    for name, camera in (("as said", None), ("exactly", Pose.identity())):
        found = plain_twin.register(cloud, camera=camera)
        away = np.linalg.norm(found.displacement - truth, axis=1)
        errors[name], covered[name] = away[free].mean(), np.mean(away <= found.uncertainty.margin())
        assert found.pose.distance_to(Pose.identity(), rest) == 0.0
        found_off = found.pose_correction.distance_to(Pose.identity(), rest)
        assert (found_off > 0.0) == (name == "as said")
    assert covered["as said"] > 0.9
    if off:
        assert errors["as said"] < 0.5 * errors["exactly"] and covered["exactly"] < 0.5
        assert found.chance_of_pose == 1.0


def test_who_knows_the_pose_exactly_says_so(plain_twin: Twin) -> None:
    said = plain_twin.as_said
    assert (
        said is not None
        and said.is_said
        and (said.rotation_deviation, said.translation_deviation) == pytest.approx((np.deg2rad(1.0), 2e-3))
    )
    sought = Twin(plain_twin.model, Config.model_validate({"registration": {"pose": "unknown"}})).as_said
    assert sought is not None and not sought.is_said and sought.translation_deviation == pytest.approx(0.01)
    for entries in (
        {"pose": "fixed"},
        {"known_rotation": 0.0},
        {"known_translation": 0.0},
        {"model": "reference", "forces": "known", "gravity": [0.0, 0.0, -9.81], "parameters": ["young-modulus"]},
    ):
        twin = Twin(plain_twin.model, Config.model_validate({"registration": entries}))
        assert twin.as_said is None


@pytest.mark.parametrize("camera", [None, TURNED])
def test_landmarks_pull_beside_the_cloud(plain_twin: Twin, forces, camera: Pose | None) -> None:
    """Of a cloud so noisy that they tell more, on the body's and on the camera's axes."""
    truth = plain_twin.predict(forces).displacement
    cloud = seen_cloud(plain_twin, forces) + 3e-3 * np.random.default_rng(5).standard_normal((1, 3))
    seen = plain_twin.registrar().observed.nodes
    ends = seen[np.argsort(plain_twin.body.points[seen, 0])[-6:]]
    rest, places = plain_twin.body.points[ends], plain_twin.body.points[ends] + truth[ends]
    turned = [points if camera is None else camera.apply(points) for points in (cloud, places)]
    alone = plain_twin.register(turned[0], camera=camera)
    both = plain_twin.register(turned[0], camera=camera, landmarks=(rest, turned[1]), landmark_deviation=1e-4)
    errors = [np.linalg.norm((found.displacement - truth)[ends], axis=1).mean() for found in (alone, both)]
    assert errors[1] < 0.5 * errors[0]
    with pytest.raises(ValueError, match="expected points on the observed surface"):
        plain_twin.register(turned[0], camera=camera, landmarks=(rest + 1.0, turned[1]))


def test_an_unknown_camera_is_found_with_the_forces(plain_twin: Twin, forces) -> None:
    truth = TURNED.apply(plain_twin.body.points + plain_twin.predict(forces).displacement)
    cloud = TURNED.apply(seen_cloud(plain_twin, forces))
    found = plain_twin.register(cloud, camera=plain_twin.near(Pose.identity()))
    errors = np.linalg.norm(found.pose.apply(plain_twin.body.points + found.displacement) - truth, axis=1)
    before = np.linalg.norm(plain_twin.body.points - truth, axis=1)
    assert errors.mean() < 0.1 * before.mean()


def test_a_stream_survives_clouds_that_cannot_be_used(plain_twin: Twin, forces) -> None:
    cloud = seen_cloud(plain_twin, forces)
    poor = [np.empty((0, 3)), np.full((50, 3), np.nan), cloud + 3.0, np.zeros((5, 2))]
    frames = list(plain_twin.stream([cloud, *poor, cloud]))
    assert [frame.number for frame in frames] == list(range(6))
    assert [frame.registration is None for frame in frames] == [False, True, True, True, True, False]
    for frame, word in zip(frames[1:5], ("empty", "NaN", "far", "(p, 3)"), strict=True):
        assert frame.judgement.verdict is Verdict.REFUSED
        assert len(frame.judgement.reasons) == 1 and (word in frame.judgement.reasons[0] or word == "far")
    assert frames[5].judgement.verdict is Verdict.ACCEPTED
    assert frames[5].registration.evaluations < frames[0].registration.evaluations  # it began where frame 0 ended


@pytest.mark.parametrize("is_live", [False, True])
def test_other_measurements_pull_in_a_stream_as_in_one_cloud(plain_twin: Twin, forces, is_live: bool) -> None:
    cloud = seen_cloud(plain_twin, forces)
    moved = plain_twin.body.points + plain_twin.predict(forces).displacement
    observed = plain_twin.observed
    places = observed.body.points[observed.nodes[:4]]
    right = LandmarkPairs.of(observed, places, moved[observed.nodes[:4]], 1e-4)
    wrong = LandmarkPairs.of(observed, places, moved[observed.nodes[:4]] + 0.01, 1e-4)
    sequence = Sequence(plain_twin, is_live=is_live)
    told = [sequence.register(cloud, terms=(term,)) for term in (right, right, wrong)]
    sequence.close()
    assert [frame.judgement.is_usable for frame in told[:2]] == [True, True]
    for frame in told:
        assert [term for term in frame.registration.problem.terms if isinstance(term, LandmarkPairs)]
    assert told[2].judgement.verdict is not Verdict.ACCEPTED
    one, pulled_off = (frame.registration.displacement for frame in told[1:])
    assert np.linalg.norm(pulled_off - one, axis=1).max() > 2e-3
    frames = list(plain_twin.stream([cloud, cloud], terms=(wrong,)))
    assert all(frame.judgement.verdict is not Verdict.ACCEPTED for frame in frames)


def test_one_bad_frame_does_not_spoil_those_after_it(plain_twin: Twin, forces) -> None:
    """A mirrored cloud leaves a wild state; the frame after it is accepted all the same."""
    cloud = seen_cloud(plain_twin, forces)
    wild = cloud * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.10]
    frames = list(plain_twin.stream([cloud, wild, cloud]))
    verdicts = [frame.judgement.verdict for frame in frames]
    assert verdicts[0] is verdicts[2] is Verdict.ACCEPTED and verdicts[1] is not Verdict.ACCEPTED


def test_a_cloud_without_a_pose_is_refused_by_name(plain_twin: Twin, rng) -> None:
    with pytest.raises(CloudError, match="the pose was not found"):
        plain_twin.register(rng.uniform(-1.0, 1.0, (200, 3)), camera="align")


def test_large_clouds_are_thinned_to_what_is_asked(seen_body, plain_twin: Twin, forces) -> None:
    twin = Twin(plain_twin.model, Config.model_validate({"registration": {"zone": "tip", "points": 100}}))
    frame = next(twin.stream([seen_cloud(twin, forces)]))
    assert frame.registration.points == len(frame.cloud) <= 100


@pytest.mark.parametrize("known", [True, False])
def test_the_noise_is_held_where_it_is_known(plain_twin: Twin, forces, known: bool) -> None:
    options = {"zone": "tip", "noise": 2e-3, "noise_known": known}
    twin = Twin(plain_twin.model, Config.model_validate({"registration": options}))
    noise = twin.register(seen_cloud(twin, forces)).noise
    # The scale is a multiple of a tenth of its logarithm.
    assert (abs(np.log(noise / 2e-3)) <= 0.051) == known


def test_a_folder_without_a_surrogate_says_what_works_without(mesh_folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"found no surrogate\.json.*--model reference"):
        Twin.open(mesh_folder)


def test_a_folder_that_is_no_twin_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="softtwin build"):
        Twin.open(tmp_path)


def test_options_are_checked(mesh_folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"registration\.noise"):
        Twin.open(mesh_folder, noise=-1.0)
    with pytest.raises(ConfigError, match=r"registration\.loudness"):
        Twin.open(mesh_folder, loudness=1.0)


def test_a_body_alone_is_enough_for_the_reference(mesh_folder: Path, seen_body) -> None:
    """As a folder, and as the configuration file that the stages were run with."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    forces = pulled(seen_body, (0.0, 0.0, -0.02))
    with Twin.open(mesh_folder, model="reference", zone="tip") as twin:
        assert not (mesh_folder / "surrogate.json").exists()
        result = twin.register(seen_cloud(twin, forces, noise=1e-4))
        assert result.judgement.verdict is Verdict.ACCEPTED, result.judgement.reasons
        assert np.linalg.norm(result.net_force - [0.0, 0.0, -0.02]) < 0.002
    run = mesh_folder.parent / "run"
    shutil.copytree(mesh_folder, run)
    file = mesh_folder.parent / "organ.toml"
    file.write_text(to_toml(Config.model_validate({"folder": "run"})))
    with Twin.open(file, model="reference") as twin:
        assert twin.body.fingerprint == seen_body.fingerprint
    (run / "body.vtu").unlink()
    with pytest.raises(ConfigError, match="softtwin mesh"):
        Twin.open(file, model="reference")


@pytest.mark.parametrize("unknown", [[], ["poisson-ratio"], ["contact"]], ids=["forces", "poisson-ratio", "contact"])
def test_torch_registers_as_the_reference_does(mesh_folder: Path, seen_body, unknown: list[str]) -> None:
    """The same state, forces, doubt and verdict, by another solver."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    forces, found = pulled(seen_body, (0.0, 0.0, -0.02)), []
    options = {"zone": "tip", "parameters": unknown, "pose": "fixed"}
    with Twin.open(mesh_folder, model="torch", **options) as twin:
        cloud = seen_cloud(twin, forces, noise=2e-4)
    for model in ("reference", "torch"):
        with Twin.open(mesh_folder, model=model, **options) as twin:
            result = twin.register(cloud)
            told = [(each.name, each.value, each.variance_reduction) for each in result.estimates]
            doubt = result.uncertainty.margin()
            found.append((result.displacement, result.net_force, doubt, told, result.judgement.verdict))
    ours, theirs = found
    size = np.abs(ours[0]).max()
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-3 * size)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-3 * np.abs(ours[1]).max())
    np.testing.assert_allclose(ours[2], theirs[2], atol=1e-2 * ours[2].max())
    assert ours[4] is theirs[4] and [each[0] for each in ours[3]] == [each[0] for each in theirs[3]]
    for one, other in zip(ours[3], theirs[3], strict=True):
        np.testing.assert_allclose(one[1:], other[1:], rtol=1e-2)


def test_torch_says_what_it_does_not_know(mesh_folder: Path) -> None:
    for options in ({"gravity": (0.0, 0.0, -9.81)}, {"pressure": 100.0}, {"parameters": ["moved@tip"]}):
        with pytest.raises(ConfigError, match=r"registration\.model: expected reference with these"):
            Twin.open(mesh_folder, model="torch", zone="tip", **options)


def test_the_folder_around_a_twin_opens_it(small_quickstart: Path) -> None:
    for folder in (small_quickstart, small_quickstart / "twin"):
        with Twin.open(folder) as twin:
            assert twin.config.body.source == "liver-phantom"


def test_a_closed_twin_says_so(mesh_folder: Path) -> None:
    """FEniCSx would end the process where what was given back is used again."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    with Twin.open(mesh_folder, model="reference") as twin:
        rest = np.zeros_like(twin.body.points)
        assert not twin.predict(rest).displacement.any()
    for use in (lambda: twin.predict(rest), lambda: twin.register(rest)):
        with pytest.raises(RuntimeError, match="closed"):
            use()
    assert len(twin.body.points) == len(rest)


def guide_block(word: str, folder: Path) -> str:
    """The block of the guide's Python that has a word in it, for a twin in a folder."""
    guide = (Path(__file__).parents[2] / "docs" / "registration.md").read_text()
    (block,) = (block for block in re.findall(r"```python\n(.*?)```", guide, flags=re.S) if word in block)
    return block.replace("liver/twin", str(folder / "twin"))


def test_the_stream_of_the_guide_runs(small_quickstart: Path, capsys) -> None:
    cloud = np.load(small_quickstart / "demo" / "cloud.npy")
    lines = guide_block("answers(", small_quickstart).replace("budget=0.1", "budget=60.0")
    exec(lines, {"camera": [cloud]})
    assert capsys.readouterr().out.startswith("accepted")


def test_the_five_lines_of_the_guide_run(small_quickstart: Path, capsys) -> None:
    lines = guide_block("twin.register(", small_quickstart)
    assert len([line for line in lines.splitlines() if line.strip()]) <= 5
    found = {"cloud": np.load(small_quickstart / "demo" / "cloud.npy")}
    exec(lines, found)
    assert capsys.readouterr().out.startswith("accepted")
    assert found["result"].judgement.verdict is Verdict.ACCEPTED
