"""An exported surrogate under onnxruntime: NumPy alone, neither torch nor FEniCSx."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

MANIFEST, CARD = "export.json", "surrogate.json"
FILES = ("value.onnx", "linearised.onnx", "value.pt2", "linearised.pt2", "directions.npy", "loaded.npy")
FORMAT = 1


class ExportError(ValueError):
    """An export that cannot be used: missing, truncated, changed, or of another twin."""


class ExportedTwin:
    """The graphs of a folder, good to 1e-6 of what torch says.

    Args:
        folder: where `export` wrote them.
        twin: folder of the twin that is meant; not compared if not given.

    Raises:
        ExportError: files missing, truncated or changed, another format, or graphs of another twin.
        ModuleNotFoundError: `onnxruntime` is absent: `pip install 'softtwin[onnx]'`.
    """

    def __init__(self, folder: Path | str, twin: Path | str | None = None) -> None:
        try:
            import onnxruntime
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "ExportedTwin: expected the package onnxruntime, found none; pip install 'softtwin[onnx]'."
            ) from error
        folder = Path(folder)
        self.manifest = _checked(folder)
        if twin is not None and _weights_of(Path(twin)) != self.manifest["weights"]:
            raise ExportError(
                f"ExportedTwin.twin: the graphs in {folder} are of another twin than {twin}, or of an earlier training "
                "of it; export it again (`softtwin export`)."
            )
        self.nodes: int = self.manifest["nodes"]
        self.directions: Floats = np.load(folder / "directions.npy")
        self.loaded: NDArray[np.int64] = np.load(folder / "loaded.npy")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # threads that wait cost more than they do
        self._value, self._linearised = (
            onnxruntime.InferenceSession(folder / name, options, providers=["CPUExecutionProvider"])
            for name in ("value.onnx", "linearised.onnx")
        )

    def solve(self, forces: ArrayLike) -> Floats:
        """Displacements, (n, 3) or (s, n, 3), metres, under nodal forces of the same shape, newtons.

        Raises:
            ValueError: no real numbers, another shape, numbers that are not finite, or forces at nodes that never carry
                load.
        """
        given = _numbers("forces", forces)
        if given.ndim not in (2, 3) or given.shape[-2:] != (self.nodes, 3):
            raise ValueError(
                f"ExportedTwin.forces: expected shape ({self.nodes}, 3) or (s, {self.nodes}, 3), got {given.shape}."
            )
        batch = given.reshape(-1, self.nodes, 3)
        idle = np.abs(np.delete(batch, self.loaded, axis=1)).max(initial=0.0)
        if idle > 0.0:
            raise ValueError(
                f"ExportedTwin.forces: expected forces at the {len(self.loaded)} nodes that carried load in training "
                f"(loaded), got up to {idle:.3g} N at others."
            )
        loads = batch[:, self.loaded].reshape(len(batch), -1).astype(np.float32)
        (found,) = self._value.run(None, {"forces": loads})
        return np.asarray(found, dtype=np.float64).reshape(given.shape)

    def linearised(self, coefficients: ArrayLike) -> tuple[Floats, Floats]:
        """Displacement, (n, 3), metres, and its derivative, (3n, k), for coefficients of the directions, (k,), newtons.

        Raises:
            ValueError: no real numbers, another shape, or numbers that are not finite.
        """
        given, expected = _numbers("coefficients", coefficients), self.directions.shape[1:]
        if given.shape != expected:
            raise ValueError(f"ExportedTwin.coefficients: expected shape {expected}, got {given.shape}.")
        displacement, jacobian = self._linearised.run(None, {"coefficients": given.astype(np.float32)})
        moved = np.asarray(displacement, dtype=np.float64).reshape(-1, 3)
        return moved, np.asarray(jacobian, dtype=np.float64)


def _numbers(name: str, values: ArrayLike) -> Floats:
    """Finite numbers of any shape; here, since `checked_array` would load more than NumPy."""
    try:
        given = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"ExportedTwin.{name}: expected an array, got rows of different lengths.") from error
    if given.dtype.kind not in "biuf":
        raise ValueError(f"ExportedTwin.{name}: expected real numbers, got {given.dtype}.")
    if not np.isfinite(given).all():
        raise ValueError(f"ExportedTwin.{name}: expected finite numbers, got NaN or infinity.")
    return given.astype(np.float64, copy=False)


def _checked(folder: Path) -> dict[str, Any]:
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_text())
    except FileNotFoundError as error:
        raise ExportError(
            f"ExportedTwin.folder: expected an export with {MANIFEST} in {folder}, found none."
        ) from error
    except (ValueError, OSError) as error:
        raise ExportError(f"ExportedTwin.folder: {folder / MANIFEST} cannot be read ({error}).") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ExportError(f"ExportedTwin.folder: expected an export of format {FORMAT} in {folder}.")
    for name in FILES:
        path = folder / name
        if not path.exists() or digest(path) != manifest.get("files", {}).get(name):
            raise ExportError(
                f"ExportedTwin.folder: {path} is not the file that {MANIFEST} names: missing, truncated, or of another "
                "twin; export it again."
            )
    return manifest


def _weights_of(twin: Path) -> str:
    """Hash of a twin's weights, as its card has it."""
    try:
        return str(json.loads((twin / CARD).read_text())["weights"])
    except (OSError, ValueError, KeyError) as error:
        raise ExportError(f"ExportedTwin.twin: expected a twin with {CARD} in {twin} ({error!r}).") from error


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
