"""Files in and out, one module for each content; always metres and LPS inside.

What a file holds is read whole, or refused by a message that names what is not read. `labels` (segmentations),
`landmarks` and `transforms` are imported by their own names.
"""

from .bodies import read_body, read_fields, write_body, write_deformed
from .clouds import Cloud, read_cloud, read_points
from .common import (
    AXES,
    LARGEST,
    METRES,
    RAS_TO_LPS,
    SEGMENTATIONS,
    SMALLEST,
    UNITS,
    Axes,
    ContentError,
    FileError,
    Unit,
    UnitWarning,
    discard,
    existing,
    in_metres,
    is_companion,
    is_labelmap,
    is_segmentation,
    structure_files,
    unit_advice,
)
from .formats.vtk import add_words, unstructured_grid, vtk_messages
from .raw import stated_axes, stated_unit
from .surfaces import read_surface
from .volumes import Volume, read_mesh, read_volume

__all__ = [
    "AXES",
    "LARGEST",
    "METRES",
    "RAS_TO_LPS",
    "SEGMENTATIONS",
    "SMALLEST",
    "UNITS",
    "Axes",
    "Cloud",
    "ContentError",
    "FileError",
    "Unit",
    "UnitWarning",
    "Volume",
    "add_words",
    "discard",
    "existing",
    "in_metres",
    "is_companion",
    "is_labelmap",
    "is_segmentation",
    "read_body",
    "read_cloud",
    "read_fields",
    "read_mesh",
    "read_points",
    "read_surface",
    "read_volume",
    "stated_axes",
    "stated_unit",
    "structure_files",
    "unit_advice",
    "unstructured_grid",
    "vtk_messages",
    "write_body",
    "write_deformed",
]
