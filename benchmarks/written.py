"""One organ, one cloud, one label map, landmarks and a pose, as each program at hand writes them in its options."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import meshio
import nibabel
import nrrd
import numpy as np
import pyvista
import trimesh
import vtk
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

from softtwin.meshes.body import Surface
from softtwin.meshes.export import Coordinates, write_surface
from softtwin.meshes.filling import gmsh_model
from softtwin.meshes.io import unstructured_grid
from softtwin.meshes.shapes import beam

SEED = 5
VOXEL = np.array([4.0, 4.0, 5.0])  # mm
CORNER = np.array([52.0, -140.0, 262.0])  # of the label map, mm, LPS
LANDMARKS = {"tip": (98.5, -111.25, 298.0), "notch": (115.5, -100.75, 324.0), "corner": (80.0, -90.0, 310.0)}
ANGLE, SHIFT = 0.7, np.array([4.0, 5.0, 6.0])  # of the pose: about (1, 2, 3), mm


@dataclass(frozen=True)
class Writer:
    """A way to write a content into a file.

    Args:
        content: surface, volume, cloud, labels, landmarks or transform.
        program: that writes.
        suffix: of the file.
        options: words for a reader.
        write: makes the file of that path.
    """

    content: str
    program: str
    suffix: str
    options: str
    write: Callable[[Path], Any]

    @property
    def name(self) -> str:
        """Content, program, suffix and options in one."""
        return " ".join(filter(None, (self.content, self.program, self.suffix, self.options)))


# --- The contents, in millimetres and LPS.


@cache
def surface() -> Surface:
    """An ellipsoid with a lobe."""
    source = vtk.vtkSphereSource()
    source.SetThetaResolution(24)
    source.SetPhiResolution(16)
    source.Update()
    ball = vtk_to_numpy(source.GetOutput().GetPoints().GetData()).astype(np.float64)
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    triangles = vtk_to_numpy(source.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    lobe = 1 + 0.3 * np.exp(-4 * ((ball - [0.0, 1.0, 0.0]) ** 2).sum(axis=1))
    return Surface(np.round(ball * lobe[:, None] * [50.0, 35.0, 30.0] + [100.0, -100.0, 300.0], 3), triangles)


@cache
def volume(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Points and cells of a block, all `tetrahedron` or all `hexahedron`."""
    body = beam((4, 3, 2), (0.08, 0.06, 0.04), kind)  # type: ignore[arg-type]
    return np.round(1e3 * body.points, 6), body.cells


@cache
def cloud() -> np.ndarray:
    """Points on the organ."""
    chosen = np.random.default_rng(SEED).permutation(len(surface().points))[:300]
    return surface().points[chosen]


@cache
def labels() -> np.ndarray:
    """An organ, label 1, with a tumour in it, label 2."""
    middles = np.stack(np.meshgrid(*(np.arange(n) for n in (24, 20, 16)), indexing="ij"), axis=-1) * VOXEL
    centre = np.array([46.0, 38.0, 37.5])
    organ = (((middles - centre) / [40.0, 32.0, 28.0]) ** 2).sum(axis=-1) < 1
    tumour = (((middles - centre - [8.0, 0.0, 0.0]) / 10.0) ** 2).sum(axis=-1) < 1
    return (organ.astype(np.uint8) + (organ & tumour)).astype(np.uint8)


def _place(ras: bool) -> np.ndarray:
    """From voxel numbers to millimetres, (4, 4); with axes that are neither sorted nor straight."""
    turn = np.array([[0.0, -1.0, 0.0], [0.96, 0.0, -0.28], [0.28, 0.0, 0.96]])
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = turn * VOXEL, CORNER
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ place if ras else place


def pose() -> np.ndarray:
    """The rigid motion, (4, 4), millimetres."""
    return trimesh.transformations.rotation_matrix(ANGLE, [1.0, 2.0, 3.0]) + np.pad(SHIFT[:, None], ((0, 1), (3, 0)))


# --- Surfaces.

_XML = (
    ("ascii", "", "little"), ("binary", "zlib", "big"), ("appended", "lz4", "little"), ("raw", "lzma", "little"),
    ("raw", "", "big"),
)  # fmt: skip


def _polydata(points: np.ndarray, triangles: np.ndarray | None) -> Any:
    if triangles is None:
        return pyvista.PolyData(points)
    return pyvista.PolyData.from_regular_faces(points, triangles)


def _trimesh(path: Path, kind: str, **options: Any) -> None:
    mesh = trimesh.Trimesh(surface().points, surface().triangles, process=False)
    if options.pop("colours", False):
        mesh.visual.vertex_colors = np.tile([200, 100, 50, 255], (len(mesh.vertices), 1))
    if options.pop("normals", False):
        mesh.vertex_normals  # noqa: B018  (computed, and written then)
    mesh.export(path, file_type=kind, **options)


def _pyvista(path: Path, **options: Any) -> None:
    _polydata(surface().points, surface().triangles).save(path, **options)


def _vtk_xml(path: Path, data: Any, writer: Any, mode: str, compressor: str, order: str) -> None:
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary, "appended": writer.SetDataModeToAppended,
     "raw": writer.SetDataModeToAppended}[mode]()  # fmt: skip
    if mode == "raw":
        writer.EncodeAppendedDataOff()
    {"": writer.SetCompressorTypeToNone, "zlib": writer.SetCompressorTypeToZLib, "lz4": writer.SetCompressorTypeToLZ4,
     "lzma": writer.SetCompressorTypeToLZMA}[compressor]()  # fmt: skip
    (writer.SetByteOrderToBigEndian if order == "big" else writer.SetByteOrderToLittleEndian)()
    writer.Write()


def _legacy(path: Path, data: Any, binary: bool, version: int) -> None:
    writer = vtk.vtkUnstructuredGridWriter() if data.IsA("vtkUnstructuredGrid") else vtk.vtkPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.SetFileVersion(version)
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.Write()


def _meshio(path: Path, points: np.ndarray, cells: Any, form: str, **options: Any) -> None:
    meshio.Mesh(points, cells).write(path, file_format=form, **options)


def _surface_cells() -> Any:
    return [("triangle", surface().triangles)]


def _strips(path: Path) -> None:
    stripper = vtk.vtkStripper()
    stripper.SetInputData(_polydata(surface().points, surface().triangles))
    stripper.Update()
    _vtk_xml(path, stripper.GetOutput(), vtk.vtkXMLPolyDataWriter(), "binary", "zlib", "little")


def _pymeshlab(path: Path, points: np.ndarray, triangles: np.ndarray | None, **options: Any) -> None:
    """With normals of vertices and faces, and colours where the options ask for them."""
    import pymeshlab

    colours = np.tile([0.8, 0.4, 0.2, 1.0], (len(points), 1))
    faces = {} if triangles is None else {"face_matrix": triangles}
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_color_matrix=colours, **faces))
    meshes.save_current_mesh(str(path), **options)


_MESHLAB_SURFACES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    (".stl", "binary", {"binary": True}), (".stl", "text", {"binary": False}),
    (".stl", "binary, colours", {"binary": True, "save_face_color": True}),
    (".obj", "", {}), (".obj", "normals", {"save_vertex_normal": True}),
    (".obj", "colours", {"save_vertex_color": True}),
    (".ply", "binary", {"binary": True}), (".ply", "text", {"binary": False}),
    (".ply", "binary, quality, normals, colours, flags",
     {"binary": True, "save_vertex_quality": True, "save_vertex_normal": True, "save_vertex_color": True,
      "save_vertex_flag": True, "save_face_quality": True, "save_face_color": True, "save_face_flag": True}),
    (".off", "", {}), (".x3d", "", {}), (".dae", "", {}), (".3ds", "", {}), (".ctm", "", {}), (".wrl", "", {}),
    (".dxf", "", {}),
)  # fmt: skip
_MESHLAB_CLOUDS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    (".ply", "binary", {"binary": True}), (".ply", "text, normals", {"binary": False, "save_vertex_normal": True}),
    (".xyz", "", {}), (".xyz", "normals", {"save_vertex_normal": True}), (".obj", "", {}),
    (".off", "", {}),
)  # fmt: skip


def _softtwin(path: Path, place: Coordinates) -> None:
    write_surface(path, Surface(place.lengths(1e-3 * surface().points), surface().triangles), place=place)


def _as_obj(
    path: Path, corner: str, beside: str = "", behind: str = "", newline: str = "\n", comma: bool = False
) -> None:
    lines = [beside] + [f"v {x:.6g} {y:.6g} {z:.6g}{behind}" for x, y, z in surface().points.tolist()]
    text = "\n".join(filter(None, lines))
    lines = ["f " + " ".join(corner.format(i + 1, i - len(surface().points)) for i in t) for t in surface().triangles]
    text = (text.replace(".", ",") if comma else text) + "\n" + "\n".join(lines) + "\n"
    path.write_bytes(text.replace("\n", newline).encode())


def _gmsh(
    path: Path, points: np.ndarray, cells: np.ndarray, kind: int, dimension: int, version: float, binary: bool
) -> None:
    with gmsh_model("written") as gmsh:
        entity = gmsh.model.addDiscreteEntity(dimension)
        gmsh.model.mesh.addNodes(dimension, entity, range(1, len(points) + 1), points.ravel())
        gmsh.model.mesh.addElementsByType(entity, kind, [], (cells + 1).ravel())
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", int(binary))
        gmsh.write(str(path))


def _surfaces() -> Iterator[Writer]:
    def writer(program: str, suffix: str, options: str, write: Callable[[Path], Any]) -> Writer:
        return Writer("surface", program, suffix, options, write)

    points, triangles = surface().points, surface().triangles
    yield writer("trimesh", ".stl", "binary", lambda p: _trimesh(p, "stl"))
    yield writer("trimesh", ".stl", "text", lambda p: _trimesh(p, "stl_ascii"))
    yield writer("trimesh", ".obj", "", lambda p: _trimesh(p, "obj"))
    yield writer("trimesh", ".obj", "normals", lambda p: _trimesh(p, "obj", normals=True, include_normals=True))
    yield writer("trimesh", ".obj", "colours", lambda p: _trimesh(p, "obj", colours=True, include_color=True))
    yield writer("trimesh", ".ply", "binary", lambda p: _trimesh(p, "ply"))
    yield writer("trimesh", ".ply", "text", lambda p: _trimesh(p, "ply", encoding="ascii"))
    yield writer("trimesh", ".ply", "normals, colours", lambda p: _trimesh(p, "ply", colours=True, vertex_normal=True))
    yield writer("trimesh", ".off", "", lambda p: _trimesh(p, "off"))
    yield writer("trimesh", ".glb", "", lambda p: _trimesh(p, "glb"))
    for suffix in (".stl", ".ply", ".vtk", ".vtp"):
        for binary in (True, False):
            yield writer("pyvista", suffix, "binary" if binary else "text",
                         lambda p, b=binary: _pyvista(p, binary=b))  # fmt: skip
    for mode, compressor, order in _XML:
        yield writer("VTK", ".vtp", ", ".join(filter(None, (mode, compressor, order))),
                     lambda p, m=mode, c=compressor, o=order: _vtk_xml(
                         p, _polydata(points, triangles), vtk.vtkXMLPolyDataWriter(), m, c, o))  # fmt: skip
    yield writer("VTK", ".vtp", "triangle strips", _strips)
    for version, binary in ((42, True), (42, False), (51, True), (51, False)):
        yield writer("VTK", ".vtk", f"{version / 10}, {'binary' if binary else 'text'}",
                     lambda p, v=version, b=binary: _legacy(p, _polydata(points, triangles), b, v))  # fmt: skip
    for form, suffix, options in (
        ("stl", ".stl", {"binary": False}), ("stl", ".stl", {"binary": True}), ("obj", ".obj", {}),
        ("ply", ".ply", {"binary": False}), ("ply", ".ply", {"binary": True}), ("vtk42", ".vtk", {"binary": True}),
        ("vtk51", ".vtk", {"binary": False}), ("vtu", ".vtu", {"binary": True}), ("vtu", ".vtu", {"binary": False}),
        ("gmsh22", ".msh", {"binary": True}), ("gmsh", ".msh", {"binary": False}), ("off", ".off", {}),
        ("nastran", ".bdf", {}), ("abaqus", ".inp", {}),
    ):  # fmt: skip
        words = "" if "binary" not in options else "binary" if options["binary"] else "text"
        yield writer("meshio", suffix, ", ".join(filter(None, (form, words))),
                     lambda p, f=form, o=options: _meshio(p, points, _surface_cells(), f, **o))  # fmt: skip
    for version, binary in ((1.0, False), (2.2, False), (2.2, True), (4.1, False), (4.1, True)):
        yield writer("gmsh", ".msh", f"{version}, {'binary' if binary else 'text'}",
                     lambda p, v=version, b=binary: _gmsh(p, points, triangles, 2, 2, v, b))  # fmt: skip
    yield writer("gmsh", ".stl", "text", lambda p: _gmsh(p, points, triangles, 2, 2, 2.2, False))
    yield writer("gmsh", ".ply2", "", lambda p: _gmsh(p, points, triangles, 2, 2, 2.2, False))
    if find_spec("pymeshlab") is not None:
        for suffix, words, options in _MESHLAB_SURFACES:
            yield writer("PyMeshLab", suffix, words,
                         lambda p, o=options: _pymeshlab(p, points, triangles, **o))  # fmt: skip
    for suffix in (".stl", ".ply", ".obj", ".vtp"):
        for place in (Coordinates("mm", "ras"), Coordinates("cm", "lps"), Coordinates("m", "ras")):
            yield writer("softtwin", suffix, f"{place.unit}, {place.axes}", lambda p, at=place: _softtwin(p, at))
    yield writer(
        "by hand", ".obj", "as Blender", lambda p: _as_obj(p, "{0}/{0}/{0}", "vt 0 0\nvt 1 0\nvn 0 0 1\no a\ns off")
    )
    yield writer("by hand", ".obj", "as MeshLab, colours", lambda p: _as_obj(p, "{0}//{0}", "", " 0.5 0.25 1"))
    yield writer("by hand", ".obj", "counted from the end, CR LF", lambda p: _as_obj(p, "{1}", newline="\r\n"))
    yield writer("by hand", ".obj", "continued lines", lambda p: _as_obj(p, "\\\n {0}"))
    yield writer("by hand", ".obj", "decimal commas", lambda p: _as_obj(p, "{0}", comma=True))


# --- Volumes.

_KINDS = {"tetrahedron": ("tetra", 4), "hexahedron": ("hexahedron", 5)}


def _grid(kind: str) -> Any:
    return unstructured_grid(*volume(kind))


def _volumes() -> Iterator[Writer]:
    for kind, (name, number) in _KINDS.items():
        points, cells = volume(kind)

        def writer(program: str, suffix: str, options: str, write: Callable[[Path], Any], kind: str = kind) -> Writer:
            return Writer("volume", program, suffix, f"{kind}, {options}", write)

        for mode, compressor, order in _XML:
            yield writer("VTK", ".vtu", ", ".join(filter(None, (mode, compressor, order))),
                         lambda p, k=kind, m=mode, c=compressor, o=order: _vtk_xml(
                             p, _grid(k), vtk.vtkXMLUnstructuredGridWriter(), m, c, o))  # fmt: skip
        for version, binary in ((42, True), (42, False), (51, True), (51, False)):
            yield writer("VTK", ".vtk", f"{version / 10}, {'binary' if binary else 'text'}",
                         lambda p, k=kind, v=version, b=binary: _legacy(p, _grid(k), b, v))  # fmt: skip
        for form, suffix, options in (
            ("vtu", ".vtu", {"binary": True}), ("vtk42", ".vtk", {"binary": True}),
            ("vtk51", ".vtk", {"binary": False}), ("gmsh22", ".msh", {"binary": True}),
            ("gmsh22", ".msh", {"binary": False}),
            ("gmsh", ".msh", {"binary": True}), ("gmsh", ".msh", {"binary": False}), ("abaqus", ".inp", {}),
            ("nastran", ".bdf", {}), ("xdmf", ".xdmf", {}), ("med", ".med", {}),
        ):  # fmt: skip
            if form in ("xdmf", "med") and find_spec("h5py") is None:
                continue
            words = "" if "binary" not in options else "binary" if options["binary"] else "text"
            yield writer("meshio", suffix, ", ".join(filter(None, (form, words))),
                         lambda p, x=(points, [(name, cells)]), f=form, o=options: _meshio(p, *x, f, **o))  # fmt: skip
        for version, binary in ((1.0, False), (2.2, False), (2.2, True), (4.1, False), (4.1, True)):
            yield writer("gmsh", ".msh", f"{version}, {'binary' if binary else 'text'}",
                         lambda p, x=(points, cells, number), v=version, b=binary: _gmsh(p, *x, 3, v, b))  # fmt: skip
        yield writer("gmsh", ".unv", "", lambda p, x=points, c=cells, n=number: _gmsh(p, x, c, n, 3, 2.2, False))
        yield writer("pyvista", ".vtu", "", lambda p, k=kind: pyvista.wrap(_grid(k)).save(p))


# --- Clouds.


def _table(path: Path, separator: str, head: str = "", behind: str = "", comma: bool = False, before: str = "") -> None:
    rows = [[f"{value:.3f}" for value in row] for row in cloud().tolist()]
    rows = [[value.replace(".", ",") for value in row] if comma else row for row in rows]
    lines = [before + separator.join(row) + (separator.join(["", *behind.split()]) if behind else "") for row in rows]
    path.write_text(head + "\n".join(lines) + "\n")


def _organised(with_zeros: bool, dtype: Any = np.float64) -> np.ndarray:
    image = np.full((20, 30, 3), 0.0 if with_zeros else np.nan)
    chosen = np.sort(np.random.default_rng(1).permutation(600)[:300])
    image.reshape(-1, 3)[chosen] = cloud()
    return image.astype(dtype)


def _fielded() -> np.ndarray:
    found = np.zeros(len(cloud()), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgb", "u4")])
    for i, axis in enumerate("xyz"):
        found[axis] = cloud()[:, i]
    return found


def _pcd(path: Path, encoding: str, is_organised: bool) -> None:
    from pypcd4 import Encoding, PointCloud

    points = _organised(False, np.float32).reshape(-1, 3) if is_organised else cloud().astype(np.float32)
    PointCloud.from_xyz_points(points).save(path, encoding=Encoding(encoding))


def _clouds() -> Iterator[Writer]:
    def writer(program: str, suffix: str, options: str, write: Callable[[Path], Any]) -> Writer:
        return Writer("cloud", program, suffix, options, write)

    yield writer("NumPy", ".npy", "double", lambda p: np.save(p, cloud()))
    yield writer("NumPy", ".npy", "single, big-endian", lambda p: np.save(p, cloud().astype(">f4")))
    yield writer("NumPy", ".npy", "Fortran order", lambda p: np.save(p, np.asfortranarray(cloud())))
    yield writer("NumPy", ".npy", "(h, w, 3), NaN", lambda p: np.save(p, _organised(False)))
    yield writer("NumPy", ".npy", "(h, w, 3), zeros", lambda p: np.save(p, _organised(True, np.float32)))
    yield writer("NumPy", ".npy", "with colours", lambda p: np.save(p, np.hstack([cloud(), np.full((300, 3), 7.0)])))
    yield writer("NumPy", ".npy", "fields x, y, z, rgb", lambda p: np.save(p, _fielded()))
    yield writer("NumPy", ".npy", "a depth image", lambda p: np.save(p, np.ones((48, 64))))
    yield writer("NumPy", ".txt", "savetxt", lambda p: np.savetxt(p, cloud()))
    yield writer("NumPy", ".csv", "savetxt, header", lambda p: np.savetxt(p, cloud(), delimiter=",", header="x,y,z"))
    for words, suffix, options in (
        ("blanks", ".xyz", {"separator": " "}), ("tabs", ".tsv", {"separator": "\t", "head": "x\ty\tz\n"}),
        ("semicolons, decimal commas", ".csv", {"separator": ";", "comma": True, "head": "X;Y;Z\n"}),
        ("blanks, decimal commas", ".txt", {"separator": " ", "comma": True}),
        ("commas, decimal commas", ".csv", {"separator": ",", "comma": True}),
        ("as CloudCompare", ".txt", {"separator": " ", "head": "//X Y Z R G B\n300\n", "behind": "1 2 3"}),
        ("as CloudCompare, scalar field", ".asc",
         {"separator": ",", "head": "//X,Y,Z,Scalar field\n", "behind": "0.5"}),
        ("as ParaView", ".csv",
         {"separator": ",", "head": '"N:0","Points:0","Points:1","Points:2"\n', "before": "0.5,"}),
        ("PTS with a count", ".pts", {"separator": " ", "head": "300\n", "behind": "10 1 2 3"}),
        ("pandas with an index", ".csv", {"separator": ",", "head": ",x,y,z\n", "before": "7,"}),
        ("units in the names", ".csv", {"separator": ",", "head": "x [mm],y [mm],z [mm],t [s]\n", "behind": "0"}),
        ("names without x, y, z", ".csv", {"separator": ",", "head": "a,b,c,d\n", "behind": "0"}),
        ("byte order mark", ".csv", {"separator": ",", "head": "\ufeffx,y,z\n"}),
    ):  # fmt: skip
        yield writer("by hand", suffix, words, lambda p, o=options: _table(p, **o))
    for encoding in ("ascii", "binary", "binary_compressed"):
        for is_organised in (False, True):
            yield writer("pypcd4", ".pcd", encoding + (", NaN" if is_organised else ""),
                         lambda p, e=encoding, o=is_organised: _pcd(p, e, o))  # fmt: skip
    yield writer("trimesh", ".ply", "", lambda p: trimesh.PointCloud(cloud()).export(p))
    yield writer("trimesh", ".xyz", "", lambda p: trimesh.PointCloud(cloud()).export(p))
    yield writer("trimesh", ".ply", "colours", lambda p: trimesh.PointCloud(
        cloud(), colors=np.tile([9, 8, 7, 255], (300, 1))).export(p))  # fmt: skip
    for suffix in (".ply", ".vtk", ".vtp"):
        yield writer("pyvista", suffix, "", lambda p: _polydata(cloud(), None).save(p))
    if find_spec("pymeshlab") is not None:
        for suffix, words, options in _MESHLAB_CLOUDS:
            yield writer("PyMeshLab", suffix, words, lambda p, o=options: _pymeshlab(p, cloud(), None, **o))
    yield writer("meshio", ".ply", "", lambda p: _meshio(p, cloud(), [("vertex", np.arange(300)[:, None])], "ply"))


# --- Label maps.


def _nifti(
    path: Path, dtype: str, unit: str = "mm", big: bool = False, layers: bool = False, form: str = "both"
) -> None:
    voxels = labels()[..., None] if layers else labels()
    place = np.diag([*[{"mm": 1.0, "meter": 1e-3, "micron": 1e3}[unit]] * 3, 1.0]) @ _place(ras=True)
    image = nibabel.Nifti1Image(voxels.astype(dtype), place, nibabel.Nifti1Header(endianness=">" if big else "<"))
    image.header.set_xyzt_units(unit)
    image.set_sform(place, 1 if form in ("both", "sform") else 0)
    image.set_qform(place, 1 if form in ("both", "qform") else 0)
    nibabel.save(image, path)


def _sloped(path: Path) -> None:
    """Numbers in single precision, which nibabel brings into 16 bits by a slope and an intercept."""
    image = nibabel.Nifti1Image(labels().astype(np.float32) * 0.9999999, _place(ras=True))
    image.set_data_dtype(np.int16)
    nibabel.save(image, path)


def _analyze(path: Path) -> None:
    nibabel.save(nibabel.Spm2AnalyzeImage(labels().astype(np.int16), _place(ras=True)), path)


def _nrrd_header(ras: bool, **more: Any) -> dict[str, Any]:
    place = _place(ras)
    return {"space": "right-anterior-superior" if ras else "left-posterior-superior",
            "space directions": place[:3, :3].T, "space origin": place[:3, 3], **more}  # fmt: skip


def _nrrd(
    path: Path, encoding: str = "gzip", ras: bool = False, detached: bool = False, dtype: Any = np.uint8, **more: Any
) -> None:
    header = _nrrd_header(ras, encoding=encoding, **more)
    nrrd.write(str(path), labels().astype(dtype), header, detached_header=detached)


def _meta(path: Path, compress: bool) -> None:
    image = vtk.vtkImageData()
    image.SetDimensions(*labels().shape)
    image.SetSpacing(*VOXEL)
    image.SetOrigin(*CORNER)
    image.GetPointData().SetScalars(numpy_to_vtk(labels().ravel(order="F"), deep=True))
    writer = vtk.vtkMetaImageWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    writer.SetCompression(compress)
    writer.Write()


def _sitk(path: Path, compress: bool, kind: str) -> None:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(labels().transpose(2, 1, 0))
    place = _place(ras=False)
    image.SetSpacing(VOXEL.tolist())
    image.SetOrigin(CORNER.tolist())
    image.SetDirection((place[:3, :3] / VOXEL).ravel().tolist())
    SimpleITK.WriteImage(SimpleITK.Cast(image, getattr(SimpleITK, kind)), str(path), compress)


def _labels() -> Iterator[Writer]:
    def writer(program: str, suffix: str, options: str, write: Callable[[Path], Any]) -> Writer:
        return Writer("labels", program, suffix, options, write)

    for suffix in (".nii", ".nii.gz"):
        for dtype in ("u1", "i2", "i4", "u4", "f4", "f8"):
            yield writer("nibabel", suffix, dtype, lambda p, d=dtype: _nifti(p, d))
    yield writer("nibabel", ".nii.gz", "big-endian", lambda p: _nifti(p, "i2", big=True))
    yield writer("nibabel", ".nii.gz", "a slope", _sloped)
    yield writer("nibabel", ".nii.gz", "(i, j, k, 1)", lambda p: _nifti(p, "u1", layers=True))
    yield writer("nibabel", ".nii.gz", "metres", lambda p: _nifti(p, "u1", unit="meter"))
    yield writer("nibabel", ".nii.gz", "micrometres", lambda p: _nifti(p, "u1", unit="micron"))
    yield writer("nibabel", ".nii.gz", "qform alone", lambda p: _nifti(p, "u1", form="qform"))
    yield writer("nibabel", ".nii.gz", "sform alone", lambda p: _nifti(p, "u1", form="sform"))
    yield writer("nibabel", ".img", "Analyze", _analyze)
    for encoding in ("raw", "gzip", "bzip2", "ascii"):
        yield writer("pynrrd", ".nrrd", encoding, lambda p, e=encoding: _nrrd(p, e))
    yield writer("pynrrd", ".nrrd", "RAS, big-endian", lambda p: _nrrd(p, "raw", True, dtype=">i2", endian="big"))
    yield writer("pynrrd", ".nrrd", "double", lambda p: _nrrd(p, dtype=np.float64))
    for encoding in ("raw", "gzip"):
        yield writer("pynrrd", ".nhdr", encoding, lambda p, e=encoding: _nrrd(p, e, detached=True))
    for suffix in (".mha", ".mhd"):
        for compress in (False, True):
            words = "compressed" if compress else "raw"
            yield writer("VTK", suffix, f"{words}, straight axes", lambda p, c=compress: _meta(p, c))
            if find_spec("SimpleITK") is not None:
                yield writer("SimpleITK", suffix, words, lambda p, c=compress: _sitk(p, c, "sitkUInt8"))
    if find_spec("SimpleITK") is not None:
        for suffix in (".nii.gz", ".nrrd", ".nhdr", ".mha"):
            for kind in ("sitkInt16", "sitkFloat32", "sitkUInt32"):
                yield writer("SimpleITK", suffix, kind, lambda p, k=kind: _sitk(p, True, k))
        yield writer("SimpleITK", ".tif", "", lambda p: _sitk(p, False, "sitkUInt8"))


# --- Landmarks and poses.


def _landmark_rows(path: Path, head: str, row: str, ras: bool = False) -> None:
    turn = -1.0 if ras else 1.0
    lines = [row.format(name, turn * x, turn * y, z, k) for k, (name, (x, y, z)) in enumerate(LANDMARKS.items(), 1)]
    path.write_text(head + "\n".join(lines) + "\n")


def _markups(path: Path, system: str, units: Any, scale: float) -> None:
    turn = np.array([-1.0, -1.0, 1.0] if system == "RAS" else [1.0, 1.0, 1.0]) / scale
    points = [{"id": str(k), "label": name, "position": (turn * place).tolist(), "positionStatus": "defined"}
              for k, (name, place) in enumerate(LANDMARKS.items(), 1)]  # fmt: skip
    points.append({"id": "9", "label": "none", "position": [0, 0, 0], "positionStatus": "undefined"})
    markup = {"type": "Fiducial", "coordinateSystem": system, "coordinateUnits": units, "controlPoints": points}
    path.write_text(json.dumps({"markups": [markup]}))


def _landmarks() -> Iterator[Writer]:
    def writer(program: str, suffix: str, options: str, write: Callable[[Path], Any]) -> Writer:
        return Writer("landmarks", program, suffix, options, write)

    table = "{0},{1:.4f},{2:.4f},{3:.4f},1,1,1,0,"
    rest = "defined,selected,visible,locked,description\n"
    fcsv = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n# columns = " + \
        "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"  # fmt: skip
    line = "vtkMRMLMarkupsFiducialNode_{4},{1:.3f},{2:.3f},{3:.3f},0,0,0,1,1,1,0,{0},,"
    yield writer("by hand", ".csv", "name,x,y,z", lambda p: _landmark_rows(p, "", "{0},{1},{2},{3}"))
    yield writer("by hand", ".csv", "header", lambda p: _landmark_rows(p, "name,x,y,z\n", "{0},{1},{2},{3}"))
    yield writer("by hand", ".csv", "semicolons", lambda p: _landmark_rows(p, "", "{0};{1};{2};{3}"))
    yield writer("by hand", ".txt", "tabs", lambda p: _landmark_rows(p, "", "{0}\t{1}\t{2}\t{3}"))
    yield writer("3D Slicer", ".csv", "table, RAS", lambda p: _landmark_rows(p, f"label,r,a,s,{rest}", table, True))
    yield writer("3D Slicer", ".csv", "table, LPS", lambda p: _landmark_rows(p, f"label,l,p,s,{rest}", table))
    for system, ras in (("0", True), ("LPS", False), ("RAS", True), ("1", False)):
        yield writer("3D Slicer", ".fcsv", f"system {system}",
                     lambda p, s=system, r=ras: _landmark_rows(p, fcsv.format(s), line, r))  # fmt: skip
    yield writer("3D Slicer", ".fcsv", "system IJK", lambda p: _landmark_rows(p, fcsv.format("2"), line))
    for system, units, scale in (
        ("LPS", "mm", 1.0),
        ("RAS", "mm", 1.0),
        ("LPS", ["cm"] * 3, 10.0),
        ("LPS", "µm", 1e-3),
    ):
        yield writer("3D Slicer", ".mrk.json", f"{system}, {units if isinstance(units, str) else units[0]}",
                     lambda p, s=system, u=units, k=scale: _markups(p, s, u, k))  # fmt: skip


def _itk(path: Path, kind: str, parameters: Any, fixed: Any) -> None:
    words = [" ".join(f"{value:.17g}" for value in np.ravel(values)) for values in (parameters, fixed)]
    path.write_text("#Insight Transform File V1.0\n#Transform 0\n"
                    f"Transform: {kind}_double_3_3\nParameters: {words[0]}\nFixedParameters: {words[1]}\n")  # fmt: skip


def _transforms() -> Iterator[Writer]:
    def writer(program: str, suffix: str, options: str, write: Callable[[Path], Any]) -> Writer:
        return Writer("transform", program, suffix, options, write)

    matrix = pose()
    inverse = np.linalg.inv(matrix)  # a .tfm leads back
    versor = -np.sin(ANGLE / 2) * np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    flat = [*inverse[:3, :3].ravel(), *inverse[:3, 3]]
    yield writer("NumPy", ".npy", "", lambda p: np.save(p, matrix))
    yield writer("NumPy", ".txt", "savetxt", lambda p: np.savetxt(p, matrix))
    yield writer("NumPy", ".csv", "savetxt, commas", lambda p: np.savetxt(p, matrix, delimiter=","))
    yield writer(
        "NumPy", ".txt", "printed, in brackets", lambda p: p.write_text(str(matrix.tolist()).replace("], [", "]\n ["))
    )
    yield writer("NumPy", ".txt", "sixteen in a line", lambda p: np.savetxt(p, matrix.reshape(1, 16)))
    yield writer("NumPy", ".txt", "transposed", lambda p: np.savetxt(p, matrix.T))
    yield writer("NumPy", ".txt", "three rows", lambda p: np.savetxt(p, matrix[:3]))
    yield writer("by hand", ".txt", "decimal commas", lambda p: p.write_text(
        "\n".join(" ".join(f"{x:.12f}".replace(".", ",") for x in row) for row in matrix) + "\n"))  # fmt: skip
    yield writer("by hand", ".json", "rows", lambda p: p.write_text(json.dumps(matrix.tolist())))
    yield writer(
        "by hand",
        ".json",
        "an object, columns",
        lambda p: p.write_text(json.dumps({"matrix": matrix.T.ravel().tolist()})),
    )
    yield writer("by hand", ".txt", "a mirror", lambda p: np.savetxt(p, matrix @ np.diag([-1.0, 1.0, 1.0, 1.0])))
    yield writer("ITK", ".tfm", "affine", lambda p: _itk(p, "AffineTransform", flat, [0, 0, 0]))
    yield writer(
        "ITK", ".tfm", "versor", lambda p: _itk(p, "VersorRigid3DTransform", [*versor, *inverse[:3, 3]], [0, 0, 0])
    )
    yield writer("ITK", ".tfm", "similarity, scale 1",
                 lambda p: _itk(p, "Similarity3DTransform", [*versor, *inverse[:3, 3], 1.0], [0, 0, 0]))  # fmt: skip
    yield writer("ITK", ".tfm", "similarity, scale 1.05",
                 lambda p: _itk(p, "Similarity3DTransform", [*versor, *inverse[:3, 3], 1.05], [0, 0, 0]))  # fmt: skip
    yield writer("ITK", ".tfm", "B-spline", lambda p: _itk(p, "BSplineTransform", [0.0] * 3, [0, 0, 0]))
    yield writer("ITK", ".h5", "", lambda p: p.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64)))


def writers() -> list[Writer]:
    """All of them, each with a name of its own."""
    found = [*_surfaces(), *_volumes(), *_clouds(), *_labels(), *_landmarks(), *_transforms()]
    assert len({writer.name for writer in found}) == len(found)
    return found
