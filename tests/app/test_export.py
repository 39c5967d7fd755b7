"""Files of a registered frame: the surfaces and the organ in the unit and on the axes of the twin's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista

from softtwin.app.config import Config, ConfigError
from softtwin.app.export import FORMATS, Exporter, file_names
from softtwin.app.markups import targets_of
from softtwin.app.page.values import margins_of
from softtwin.app.record import frame_figures
from softtwin.app.twin import Twin
from softtwin.meshes.io import read_surface
from softtwin.registration.result import Registration

from .conftest import pulled, seen_cloud


@pytest.fixture(scope="module")
def twin(plain_twin: Twin) -> Twin:
    return Twin(plain_twin.model, Config.model_validate({"body": {"unit": "mm"}, "registration": {"zone": "tip"}}))


@pytest.fixture(scope="module")
def cloud(twin: Twin) -> np.ndarray:
    return seen_cloud(twin, pulled(twin.body, (0.0, 0.06, -0.2)))


@pytest.fixture(scope="module")
def result(twin: Twin, cloud) -> Registration:
    return twin.register(cloud)


def test_each_format_holds_the_moved_structures(twin: Twin, result, tmp_path: Path) -> None:
    names = Exporter(twin, tmp_path, ("stl", "ply", "vtp")).write(7, result)
    assert names == [f"{name}_0007.{kind}" for name in ("organ", "tumour") for kind in ("stl", "ply", "vtp")]
    for name, moved in twin.surfaces(result).items():
        for kind in ("stl", "ply", "vtp"):
            back = read_surface(tmp_path / f"{name}_0007.{kind}", "mm")
            assert back.volume == pytest.approx(moved.volume, rel=1e-4)  # of single precision's differences
            for corner in (np.min, np.max):
                outer = corner(moved.points[moved.triangles], axis=(0, 1))
                assert np.abs(corner(back.points, axis=0) - outer).max() < 1e-7  # metres


def test_what_lies_outside_the_organ_is_marked_as_not_known(
    twin: Twin, result: Registration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not twin.outside["tumour"].any()
    Exporter(twin, tmp_path, ("vtp",)).write(0, result)
    assert "is_known" not in pyvista.read(tmp_path / "tumour_0000.vtp").point_data
    assert "outside_share" not in frame_figures(twin, result, None)["targets"]["tumour"]
    outside = np.arange(len(twin.outside["tumour"])) % 4 == 0
    monkeypatch.setitem(twin.__dict__, "outside", {"tumour": outside})
    Exporter(twin, tmp_path, ("vtp",)).write(0, result)
    assert np.array_equal(pyvista.read(tmp_path / "tumour_0000.vtp").point_data["is_known"], ~outside)
    target = frame_figures(twin, result, None)["targets"]["tumour"]
    assert target["outside_share"] == pytest.approx(outside.mean())
    margins = result.uncertainty.margin(twin.embeddings["tumour"])
    assert target["margin95_m"] == pytest.approx(margins[~outside].max())
    assert margins_of(twin, result) == {"tumour": pytest.approx(margins[~outside].max())}
    centre, *spread = targets_of(twin, result, 9)
    assert centre.margin == pytest.approx(margins[~outside].max())
    assert f"{100 * outside.mean():.0f} % of it lies outside the organ and is carried along: NOT KNOWN" in centre.remark
    places = twin.body.inner["tumour"].points + twin.embeddings["tumour"].displace(result.displacement)
    inside = {tuple(place) for place in places[~outside]}
    assert len(spread) == (~outside).sum() > 0 and all(tuple(target.position) in inside for target in spread)


def test_the_organ_holds_displacement_and_force(twin: Twin, result, tmp_path: Path) -> None:
    (name,) = Exporter(twin, tmp_path, ("vtu",)).write(0, result)
    written = pyvista.read(tmp_path / name)
    np.testing.assert_allclose(written.points, 1e3 * (twin.body.points + result.displacement), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(written.point_data["displacement"], 1e3 * result.displacement, rtol=1e-12)
    np.testing.assert_allclose(written.point_data["force_N"], result.forces)


def test_the_cloud_is_written_where_the_body_is(twin: Twin, result, cloud, tmp_path: Path) -> None:
    names = Exporter(twin, tmp_path).write(0, result, cloud)
    assert names[-1] == "cloud_0000.vtp"
    np.testing.assert_allclose(pyvista.read(tmp_path / names[-1]).points, 1e3 * cloud, rtol=1e-12)


def test_the_series_holds_what_paraview_reads(twin: Twin, result, tmp_path: Path) -> None:
    exporter = Exporter(twin, tmp_path, FORMATS)
    frames = [(number, exporter.write(number, result)) for number in (0, 2)]
    assert exporter.write_series(frames) == "frames.pvd"
    reader = pyvista.get_reader(tmp_path / "frames.pvd")
    assert list(reader.time_values) == [0.0, 2.0]
    assert {Path(data.path).suffix for data in reader.datasets} == {".vtu", ".vtp"}
    assert Exporter(twin, tmp_path, ("stl",)).write_series([(0, ["organ_0000.stl"])]) == ""


def test_an_unknown_format_is_named(twin: Twin, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"Exporter\.formats: .*got xyz, off"):
        Exporter(twin, tmp_path, ("stl", "xyz", "off"))


def test_structures_get_names_that_files_may_bear() -> None:
    names = file_names(["vena cava/left", "vena cava:left", "organ", "frame", "..", "Gefäß 1"])
    assert names == {
        "vena cava/left": "vena_cava_left",
        "vena cava:left": "vena_cava_left-2",
        "organ": "organ-2",
        "frame": "frame-2",
        "..": "inner",
        "Gefäß 1": "Gefäß_1",
    }
