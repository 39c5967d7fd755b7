"""What is written for 3D Slicer and ParaView: read back by readers of its own, in every format, frame and unit."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest
import pyvista
from own_forward_model import Cantilever

from softtwin.app.config import Config, ConfigError
from softtwin.app.export import FORMATS, Exporter
from softtwin.app.live import register_live
from softtwin.app.markups import MARGIN, Target, write_targets
from softtwin.app.record import RECORD, Recorder
from softtwin.app.register import register_clouds
from softtwin.app.streams import fed
from softtwin.app.twin import Frame, Twin
from softtwin.meshes.body import Body
from softtwin.meshes.displacement import read_displacement
from softtwin.meshes.export import SURFACE_FORMATS, Coordinates
from softtwin.meshes.io import FileError, read_surface, read_volume
from softtwin.registration.pose import read_landmarks
from softtwin.registration.result import Registration
from softtwin.registration.verdict import Judgement, Verdict

from .conftest import pulled, seen_cloud

CLOSE = 1e-6  # metres: a thousandth of a millimetre
FRAMES = [(unit, frame) for unit in ("mm", "m") for frame in ("lps", "ras")]
NAMES = ("Gefäß 1", "frames", "organ", "targets")  # as a person, or one of our own files, might be called


@pytest.fixture(scope="module")
def body(seen_body: Body) -> Body:
    return replace(seen_body, inner=dict.fromkeys(NAMES, seen_body.inner["tumour"]))


@pytest.fixture(scope="module")
def found(body: Body) -> tuple[np.ndarray, Registration]:
    """A cloud of a pull to the side and down, so that no axis stands still, and what it told."""
    twin = a_twin(body)
    cloud = seen_cloud(twin, pulled(body, (0.05, 0.09, -0.2)))
    return cloud, twin.register(cloud)


def a_twin(body: Body, unit: str = "mm", frame: str = "lps", **section: object) -> Twin:
    entries = {"zone": "tip", "output_frame": frame, "output_unit": unit, "voxel": 0.01, "target_points": 3, **section}
    return Twin(Cantilever(body), Config.model_validate({"registration": entries}))


def in_order(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points, 6).T)]


@pytest.mark.parametrize(("unit", "frame"), FRAMES)
def test_every_format_is_read_back_without_being_told_how(body, found, tmp_path, unit, frame) -> None:
    cloud, result = found
    twin, place = a_twin(body, unit, frame), Coordinates(unit, frame)
    names = Exporter(twin, tmp_path, FORMATS).write(4, result, cloud)
    assert len(set(names)) == len(names) and {path.name for path in tmp_path.iterdir()} == set(names)
    for (name, moved), part in zip(twin.surfaces(result).items(), parts(), strict=True):
        used = moved.points[np.unique(moved.triangles)]
        for kind in SURFACE_FORMATS:
            back = read_surface(tmp_path / f"{part}_0004.{kind}")
            assert np.abs(in_order(back.points) - in_order(used)).max() < CLOSE, (name, kind)
    points, _ = read_volume(tmp_path / "frame_0004.vtu")
    assert np.abs(points - body.points - result.displacement).max() < CLOSE
    grid = pyvista.read(tmp_path / "frame_0004.vtu")
    assert np.abs(place.metres(grid.point_data["displacement"]) - result.displacement).max() < CLOSE
    assert np.abs(place.directions(grid.point_data["force_N"]) - result.forces).max() < 1e-12
    for direction in ("forward", "inverse"):
        field = read_displacement(tmp_path / f"displacement-{direction}_0004.nrrd")
        assert field.direction == direction and field.spacing == pytest.approx(0.01)
    marked = read_landmarks(tmp_path / "targets_0004.mrk.json", axes="lps")
    for name, moved in twin.targets(result).items():
        surface = body.inner[name]
        corners = moved[surface.triangles]
        areas = np.linalg.norm(
            np.cross(
                *(surface.points[surface.triangles[:, i]] - surface.points[surface.triangles[:, 0]] for i in (1, 2))
            ),
            axis=1,
        )
        assert np.abs(marked[name] - areas @ corners.mean(axis=1) / areas.sum()).max() < CLOSE
        for number in (1, 2, 3):
            assert np.linalg.norm(moved - marked[f"{name} {number}"], axis=1).min() < CLOSE


def parts() -> list[str]:
    """Of the organ and of each structure, as files name them."""
    return ["organ", "Gefäß_1", "frames-2", "organ-2", "targets-2"]


# --- Sequences, by a reader that knows MRML alone.


def read_bundle(path: Path, folder: Path) -> tuple[ElementTree.Element, Path]:
    """The scene of a bundle, unpacked, and the folder that its files are named from."""
    with zipfile.ZipFile(path) as bundle:
        assert bundle.testzip() is None
        bundle.extractall(folder)
    (scene,) = folder.rglob("*.mrml")  # Slicer takes the first that it finds
    return ElementTree.parse(scene).getroot(), scene.parent


def references(node: ElementTree.Element) -> dict[str, str]:
    return dict(pair.split(":") for pair in node.attrib["references"].split(";") if pair)


def read_sequence(path: Path, folder: Path) -> tuple[str, dict[float, np.ndarray]]:
    """Name and points on LPS axes, in millimetres, of each index: as vtkMRMLSequenceStorageNode goes about it."""
    scene, root = read_bundle(path, folder)
    nodes = {node.attrib["id"]: node for node in scene}
    (index,) = [node for node in scene if node.attrib.get("singletonTag") == "SequenceIndex"]
    assert index.tag == "Sequence" and index.attrib["indexType"] == "numeric"
    models, names = dict[float, np.ndarray](), set[str]()
    for entry in index.attrib["indexValues"].split(";"):
        node, _, value = entry.partition(":")
        model, storage = nodes[node], nodes[references(nodes[node])["storage"]]
        assert (model.tag, storage.tag) == ("Model", "ModelStorage")
        names.add(model.attrib["name"])
        assert unquote(model.attrib["attributes"]) == f"Sequences.BaseName:{model.attrib['name']}"
        models[float(value)] = model_points(root, storage)
    (name,) = names
    return name, models


def model_points(root: Path, storage: ElementTree.Element) -> np.ndarray:
    data = pyvista.read(root / unquote(storage.attrib["fileName"]))
    (space,), (unit,) = data.field_data["SPACE"], data.field_data["UNIT"]
    assert space == storage.attrib["coordinateSystem"] and unit == "mm"
    return np.array(data.points) * ([-1.0, -1.0, 1.0] if space == "RAS" else 1.0)


@pytest.mark.parametrize(("unit", "frame"), FRAMES)
def test_a_sequence_is_one_bundle_for_each_structure(body, found, tmp_path, unit, frame) -> None:
    _, result = found
    twin, out = a_twin(body, unit, frame), tmp_path / "out put"
    out.mkdir()
    exporter = Exporter(twin, out, ("seq.mrb",))
    numbers = (0, 2, 10)
    written = exporter.write_bundles([(number, exporter.write(number, result)) for number in numbers])
    assert written == [*(f"{part}.seq.mrb" for part in parts()), "frames.mrb"]
    for i, (name, moved) in enumerate(twin.surfaces(result).items()):
        said, models = read_sequence(out / written[i], tmp_path / f"read {i}")
        assert said == name and tuple(models) == numbers
        used = 1e3 * moved.points[np.unique(moved.triangles)]
        for points in models.values():
            assert np.abs(points - used).max() < 1e3 * CLOSE
    assert not list(out.glob(".*"))


def test_a_scene_plays_all_sequences_together(body, found, tmp_path) -> None:
    _, result = found
    exporter = Exporter(a_twin(body), tmp_path, ("seq.mrb",))
    exporter.write_bundles([(number, exporter.write(number, result)) for number in (3, 4)])
    scene, root = read_bundle(tmp_path / "frames.mrb", tmp_path / "scene")
    nodes = {node.attrib["id"]: node for node in scene}
    assert len(nodes) == len(list(scene))  # no id twice
    (browser,) = [node for node in scene if node.tag == "SequenceBrowser"]
    linked, names = references(browser), list(exporter.twin.surfaces(result))
    assert browser.attrib["virtualNodePostfixes"].split() == [str(i) for i in range(len(names))]
    for i, name in enumerate(names):
        sequence, proxy = nodes[linked[f"sequenceNodeRef{i}"]], nodes[linked[f"dataNodeRef{i}"]]
        inner = root / nodes[references(sequence)["storage"]].attrib["fileName"]
        said, models = read_sequence(inner, tmp_path / f"inner {i}")
        assert said == name == proxy.attrib["name"] and tuple(models) == (3.0, 4.0)
        entries = [entry.partition(":") for entry in sequence.attrib["indexValues"].split(";")]
        assert [float(value) for _, _, value in entries] == [3.0, 4.0]
        own, _ = read_bundle(inner, tmp_path / f"ids {i}")
        assert {node for node, _, _ in entries} == {node.attrib["id"] for node in own if node.tag == "Model"}
        assert nodes[references(proxy)["display"]].tag == "ModelDisplay"
        np.testing.assert_array_equal(model_points(root, nodes[references(proxy)["storage"]]), models[3.0])


def test_a_record_names_its_bundles_and_the_next_one_removes_them(body, found, tmp_path) -> None:
    """The frames that are refused are in none, as in the series for ParaView."""
    cloud, result = found
    refused = Judgement(Verdict.REFUSED, ("nonsense",))
    with Recorder(Exporter(a_twin(body), tmp_path, ("seq.mrb",))) as recorder:
        recorder.add(Frame(0, result.judgement, result, 0.1, cloud))
        recorder.add(Frame(1, refused, result, 0.1, cloud))
    record = json.loads((tmp_path / RECORD).read_text())
    assert record["bundles"][-1] == "frames.mrb" and all((tmp_path / name).is_file() for name in record["bundles"])
    assert tuple(read_sequence(tmp_path / "organ.seq.mrb", tmp_path / "read")[1]) == (0.0,)
    with Recorder(Exporter(a_twin(body), tmp_path, ("stl",))):
        pass
    assert not list(tmp_path.glob("*.mrb")) and "bundles" not in json.loads((tmp_path / RECORD).read_text())


def test_bundles_are_there_after_a_stream_too(body, found, tmp_path) -> None:
    cloud, _ = found
    register_live(a_twin(body), fed([cloud]), tmp_path, formats=("seq.mrb",), say=lambda line: None)
    assert (tmp_path / "frames.mrb").is_file()


def test_no_frame_makes_no_bundle(body, tmp_path) -> None:
    with Recorder(Exporter(a_twin(body), tmp_path, ("seq.mrb",))):
        pass
    assert [path.name for path in tmp_path.iterdir()] == [RECORD]


# --- Targets.


def test_targets_carry_their_margins(body, found, tmp_path) -> None:
    _, result = found
    twin = a_twin(body)
    Exporter(twin, tmp_path, ("mrk.json",)).write(0, result)
    content = json.loads((tmp_path / "targets_0000.mrk.json").read_text())
    (markup,) = content["markups"]
    assert content["@schema"].endswith("markups-schema-v1.0.3.json#") and "not a medical device" in content["notice"]
    assert (markup["type"], markup["coordinateSystem"], markup["coordinateUnits"]) == ("Fiducial", "LPS", "mm")
    labels = [point["label"] for point in markup["controlPoints"]]
    assert len(set(labels)) == len(labels) == 4 * len(NAMES)
    (measured,) = markup["measurements"]
    assert measured["name"] == MARGIN and measured["units"] == "mm"
    margins = 1e3 * result.uncertainty.margin(twin.embeddings["organ"], 0.95)
    by_label = dict(zip(labels, measured["controlPointValues"], strict=True))
    assert by_label["organ"] == pytest.approx(margins.max()) and measured["value"] == max(by_label.values())
    for number in (1, 2, 3):
        assert np.abs(margins - by_label[f"organ {number}"]).min() < 1e-9
    said = markup["controlPoints"][labels.index("organ")]["description"]
    assert said.startswith(f"{MARGIN} {margins.max():.1f} mm (95 %)")


def test_a_target_of_a_frame_that_may_not_be_used_says_so(body, found, tmp_path) -> None:
    _, result = found
    doubtful = replace(result, judgement=Judgement(Verdict.DOUBTFUL, ("the cloud is thin",)))
    Exporter(a_twin(body), tmp_path, ("mrk.json",)).write(0, doubtful)
    (markup,) = json.loads((tmp_path / "targets_0000.mrk.json").read_text())["markups"]
    assert all("FRAME DOUBTFUL: the cloud is thin" in point["description"] for point in markup["controlPoints"])


def test_a_margin_without_end_is_unknown_in_words_and_no_number(tmp_path) -> None:
    path = tmp_path / "t.mrk.json"
    write_targets(path, [Target("tumour", np.ones(3), np.inf, "for each point of tumour")], "ras")
    (markup,) = json.loads(path.read_text())["markups"]
    assert markup["measurements"] == [] and f"{MARGIN} unknown" in markup["controlPoints"][0]["description"]
    assert markup["controlPoints"][0]["position"] == [-1000.0, -1000.0, 1000.0]


def test_nobody_is_to_move_images_by_a_refused_frame(body, found, tmp_path) -> None:
    _, result = found
    refused = replace(result, judgement=Judgement(Verdict.REFUSED, ("nonsense",)))
    assert Exporter(a_twin(body), tmp_path, ("nrrd",)).write(0, refused) == []


@pytest.mark.parametrize("voxel", [1e-9, 1e-4])
def test_voxels_that_nobody_can_store_are_refused_before_the_first_frame(body, tmp_path, voxel) -> None:
    with pytest.raises(ConfigError, match=r"registration\.voxel: expected 0 or at least 0\.0012 m"):
        Exporter(a_twin(body, voxel=voxel), tmp_path, ("nrrd",))
    Exporter(a_twin(body, voxel=voxel), tmp_path, ("vtu",))


def test_targets_of_a_twin_without_structures_are_refused_before_the_first_frame(body, tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"inner structures for mrk\.json .*--inner"):
        Exporter(a_twin(replace(body, inner={})), tmp_path, ("mrk.json",))


# --- What is said of coordinates.


def test_the_record_says_unit_and_axes_of_all_that_it_holds(body, found, tmp_path) -> None:
    cloud, _ = found
    quiet = {"say": lambda line: None, "formats": ()}
    lps = register_clouds(a_twin(body), [cloud], tmp_path / "lps", **quiet)[0]
    ras = register_clouds(a_twin(body, "m", "ras"), [cloud], tmp_path / "ras", **quiet)[0]
    np.testing.assert_allclose(ras["net_force_N"], np.array([-1, -1, 1]) * lps["net_force_N"], rtol=1e-12)
    assert ras["pose"] == lps["pose"]  # clouds are read on the axes of the organ's files in any case
    record = json.loads((tmp_path / "ras" / RECORD).read_text())
    assert record["files_in"] == {"unit": "m", "axes": "ras"} and record["figures_in"] == {"unit": "m", "axes": "ras"}
    assert record["pose_in"] == record["source_in"] == {"unit": "m", "axes": "lps"}
    assert any("3D Slicer would read as mm" in note for note in record["notes"])
    assert json.loads((tmp_path / "lps" / RECORD).read_text())["notes"] == []


@pytest.mark.parametrize(("entries", "is_said"), [({}, True), ({"frame": "ras"}, False), ({"unit": "m"}, True)])
def test_axes_that_nobody_says_are_taken_as_lps_and_that_is_said(body, tmp_path, entries, is_said) -> None:
    config = Config.model_validate({"body": {"source": "liver.stl", "unit": "mm", "fixed": "f.npy", **entries}})
    with Recorder(Exporter(Twin(Cantilever(body), config), tmp_path)):
        pass
    record = json.loads((tmp_path / RECORD).read_text())
    assert any("taken as LPS" in note for note in record["notes"]) == is_said
    assert record["files_in"] == {"unit": "mm", "axes": "lps"}


def test_source_writes_what_the_organ_came_in(body, tmp_path) -> None:
    config = Config.model_validate(
        {
            "body": {"source": "liver.stl", "unit": "cm", "frame": "ras"},
            "registration": {"output_frame": "source", "output_unit": "source"},
        }
    )
    assert Twin(Cantilever(body), config).written_in == Coordinates("cm", "ras")


@pytest.mark.parametrize("kind", ["vtu", "stl", "obj", "nrrd", "mrk.json"])
def test_a_folder_that_is_gone_is_an_error_with_the_files_name(body, found, tmp_path, kind) -> None:
    exporter = Exporter(a_twin(body), tmp_path / "gone", (kind,))
    with pytest.raises(FileError, match=rf"_0000\.{kind}: could not be written"):
        exporter.write(0, found[1])


def test_bundles_that_cannot_be_written_are_an_error_with_the_files_name(body, found, tmp_path) -> None:
    exporter = Exporter(a_twin(body), tmp_path, ("seq.mrb",))
    frames = [(0, exporter.write(0, found[1]))]
    (tmp_path / "organ_0000.vtp").unlink()
    with pytest.raises(FileError, match=r"organ\.seq\.mrb: could not be written .*organ_0000\.vtp"):
        exporter.write_bundles(frames)
    assert not list(tmp_path.glob("*.mrb")) and not list(tmp_path.glob(".*"))
