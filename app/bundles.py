"""Registered sequences for 3D Slicer: a `.seq.mrb` for each structure, and one scene that plays all of them.

A `.mrb` is a zip with a scene (`NAME/NAME.mrml`) and its files (`NAME/Data`). A `.seq.mrb` holds one sequence: a model
for each frame, and a node with the tag `SequenceIndex` that says which frame is which (Slicer,
Libs/MRML/Core/vtkMRMLSequenceStorageNode.cxx: WriteDataInternal; vtkMRMLSequenceNode.cxx: ReadIndexValues). A scene
names such bundles as files of its sequences and has a browser that plays them
(Modules/Loadable/Sequences/MRML/vtkMRMLSequenceBrowserNode.cxx: ReadXMLAttributes). Slicer takes millimetres.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote
from xml.etree import ElementTree

from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLPolyDataWriter

from softtwin.meshes.export import PER_METRE, Coordinates
from softtwin.meshes.io import FileError, add_words, discard

_VERSION = "Slicer5.6.0"  # whose way of writing scenes this is
_LENGTHS = "displacement"  # an array that is a length
_COLOURS = ("0.87 0.55 0.45", "0.25 0.45 0.85", "0.55 0.35 0.75", "0.20 0.62 0.35", "0.90 0.65 0.20", "0.80 0.25 0.45")
_INDEX = {
    "indexName": "frame",
    "indexUnit": "",
    "indexType": "numeric",
    "numericIndexValueTolerance": "0.001",
}


@dataclass(frozen=True)
class Track:
    """A structure's surfaces, frame after frame.

    Args:
        name: of the structure, as a person wrote it.
        file: name of its `.seq.mrb`.
        frames: number and VTP file of each frame, at least one, in their order.
    """

    name: str
    file: str
    frames: Sequence[tuple[int, Path]]


def write_sequence(path: Path, track: Track, place: Coordinates) -> None:
    """Write a structure's surfaces as one sequence that 3D Slicer opens; the file appears whole or not at all.

    Args:
        path: file to write, `.seq.mrb`.
        track: the structure.
        place: coordinates of its files; the models are in millimetres and on these axes.

    Raises:
        FileError: a surface could not be read, or the file not be written.
    """
    scene, data, entries = _scene(), dict[str, Path](), list[str]()
    for count, (number, file) in enumerate(track.frames, 1):
        name = f"Data/model_{number:04d}.vtp"
        data[name] = file
        entries.append(f"{_model(scene, count, track.name, name, place)}:{number}")
    index = {"id": "vtkMRMLSequenceNodeSequenceIndex", "name": track.name, "singletonTag": "SequenceIndex"}
    _node(scene, "Sequence", **index, **_INDEX, indexValues=";".join(entries))
    _write(path, "sequence", scene, data, place)


def write_scene(path: Path, folder: Path, tracks: Sequence[Track], place: Coordinates) -> None:
    """Write a scene that plays the sequences of all structures together; the file appears whole or not at all.

    Args:
        path: file to write, `.mrb`.
        folder: where the sequences' files lie, already written.
        tracks: the structures.
        place: coordinates of their surfaces' files.

    Raises:
        FileError: a file could not be read, or the scene not be written.
    """
    scene, data, references = _scene(), dict[str, Path](), list[str]()
    for i, track in enumerate(tracks):
        sequence, surface = f"Data/sequence_{i}.seq.mrb", f"Data/model_{i}.vtp"
        data |= {sequence: folder / track.file, surface: track.frames[0][1]}
        display = _node(
            scene,
            "ModelDisplay",
            id=f"vtkMRMLModelDisplayNode{i + 1}",
            color=_COLOURS[i % len(_COLOURS)],
            opacity="0.4" if i == 0 else "1",
            visibility="true",
        )
        model = _model(scene, i + 1, track.name, surface, place, display)
        storage = _node(scene, "SequenceStorage", id=f"vtkMRMLSequenceStorageNode{i + 1}", fileName=sequence)
        entries = [f"vtkMRMLModelNode{count}:{number}" for count, (number, _) in enumerate(track.frames, 1)]
        known = _node(
            scene,
            "Sequence",
            id=f"vtkMRMLSequenceNode{i + 1}",
            name=f"{track.name} sequence",
            attributes="DataNodeClassName:vtkMRMLModelNode",
            references=f"storage:{storage};",
            **_INDEX,
            indexValues=";".join(entries),
        )
        references += [f"sequenceNodeRef{i}:{known}", f"dataNodeRef{i}:{model}"]
    _node(
        scene,
        "SequenceBrowser",
        id="vtkMRMLSequenceBrowserNode1",
        name="frames",
        references="".join(f"{reference};" for reference in references),
        playbackActive="false",
        playbackRateFps="10",
        playbackLooped="true",
        selectedItemNumber="0",
        virtualNodePostfixes=" ".join(str(i) for i in range(len(tracks))),
    )
    _write(path, "frames", scene, data, place)


def _scene() -> ElementTree.Element:
    scene = ElementTree.Element("MRML", {"version": _VERSION, "userTags": ""})
    scene.append(ElementTree.Comment(" softtwin output. Research software: not a medical device. "))
    return scene


def _model(scene: ElementTree.Element, number: int, name: str, file: str, place: Coordinates, display: str = "") -> str:
    """A model with its file, whose axes the scene says, too; returns its id."""
    storage = _node(
        scene,
        "ModelStorage",
        id=f"vtkMRMLModelStorageNode{number}",
        hideFromEditors="true",
        fileName=file,
        coordinateSystem=place.axes.upper(),
    )
    references = f"display:{display};storage:{storage};" if display else f"storage:{storage};"
    return _node(
        scene,
        "Model",
        id=f"vtkMRMLModelNode{number}",
        name=name,
        attributes=f"Sequences.BaseName:{quote(name)}",
        references=references,
    )


def _node(scene: ElementTree.Element, tag: str, **words: str) -> str:
    ElementTree.SubElement(scene, tag, {"name": tag, **words})
    return words["id"]


def _write(path: Path, root: str, scene: ElementTree.Element, files: Mapping[str, Path], place: Coordinates) -> None:
    ElementTree.indent(scene)
    partial = path.with_name(f".partial.{path.name}")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as bundle:
            text = ElementTree.tostring(scene, encoding="UTF-8", xml_declaration=True)
            bundle.writestr(f"{root}/{root}.mrml", text)
            for name, file in files.items():
                as_it_is = place.unit == "mm" or file.suffix != ".vtp"
                content = file.read_bytes() if as_it_is else _in_millimetres(file, place)
                bundle.writestr(f"{root}/{name}", content)
        os.replace(partial, path)
    except OSError as error:
        discard(partial)
        raise FileError(f"{path}: could not be written ({error}).") from None


def _in_millimetres(file: Path, place: Coordinates) -> bytes:
    """A VTP file of another unit with its lengths in millimetres."""
    scale = PER_METRE["mm"] / PER_METRE[place.unit]
    reader, writer = vtkXMLPolyDataReader(), vtkXMLPolyDataWriter()
    reader.SetFileName(str(file))
    reader.Update()
    data = reader.GetOutput()
    for array in (data.GetPoints().GetData(), data.GetPointData().GetArray(_LENGTHS)):
        if array is not None:
            vtk_to_numpy(array)[:] *= scale
    add_words(data, Coordinates("mm", place.axes).words)
    writer.SetInputData(data)
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString().encode()
