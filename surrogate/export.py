"""A surrogate as plain graphs for other programs, by torch.export and ONNX: displacement and Jacobian.

In single precision. Forward-mode derivatives are traced into ordinary operations: what runs the graph needs none of its
own.
"""

from __future__ import annotations

import copy
import json
import logging
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .exported import FILES, FORMAT, MANIFEST, digest
from .model import Surrogate
from .precision import without_tf32
from .twin import NOTICE

Floats = NDArray[np.float64]


class Value(nn.Module):
    """Displacements, (s, 3n), metres, for coefficients of a basis of forces, (s, k).

    Args:
        surrogate: what predicts.
        basis: forces at the loaded nodes for unit coefficients, (3l, k), newtons.
        kind: precision of all, that of what is exported if not said.

    Raises:
        ValueError: a model that searches for its states.
    """

    offset: Tensor
    linear: Tensor
    encode: Tensor
    decode: Tensor | None

    def __init__(self, surrogate: Surrogate, basis: Floats, kind: torch.dtype = torch.float32) -> None:
        super().__init__()
        if not surrogate.network.is_graph:
            raise ValueError(
                f"Value.surrogate: expected a network, got {surrogate.card.get('architecture', 'a model')}, which "
                "searches for equilibria and is no graph; train a network (architecture reduced)."
            )
        encoder_decoder = surrogate.encoder_decoder
        self.network = copy.deepcopy(surrogate.network).to(kind).requires_grad_(False)
        for name, values in (
            ("offset", encoder_decoder.offset),
            ("linear", encoder_decoder.linear(basis)),
            ("encode", encoder_decoder.encoded(basis)),
            ("decode", encoder_decoder.decode),
        ):
            self.register_buffer(name, None if values is None else torch.tensor(values, dtype=kind))

    def forward(self, coefficients: Tensor) -> Tensor:
        """Displacements for coefficients."""
        values: Tensor = self.network(coefficients @ self.encode.T)
        return self.offset + coefficients @ self.linear.T + self._decoded(values.mT).mT

    def _decoded(self, columns: Tensor) -> Tensor:
        return columns if self.decode is None else self.decode @ columns


class Linearised(Value):
    """Displacement, (3n,), and its derivative, (3n, k), for coefficients, (k,)."""

    def forward(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """Displacement and Jacobian."""
        at = self.network.traced(self.encode @ coefficients)
        slopes = self.linear + self._decoded(at.jvp(self.encode))
        return self.offset + self.linear @ coefficients + self._decoded(at.values[:, None])[:, 0], slopes


def leading_directions(surrogate: Surrogate, count: int, device: str = "cpu") -> Floats:
    """The directions of force at the loaded nodes that move the body most, seen from rest: (3l, k), orthonormal.

    Args:
        surrogate: the surrogate.
        count: most directions wanted.
        device: where the whole Jacobian at rest is made, a tangent for each force: on a GPU in single precision, since
            a large U-Mesh takes minutes for it on a processor.

    Raises:
        ValueError: fewer than one.
    """
    if count < 1:
        raise ValueError(f"leading_directions.count: expected at least 1, got {count}.")
    inputs, kind = 3 * len(surrogate.encoder_decoder.loaded), torch.float64 if device == "cpu" else torch.float32
    module = Linearised(surrogate, np.eye(inputs), kind).to(device).eval().requires_grad_(False)
    with torch.no_grad(), without_tf32():
        whole = module(torch.zeros(inputs, dtype=kind, device=device))[1].cpu().double().numpy()
    return np.ascontiguousarray(np.linalg.svd(whole, full_matrices=False)[2][:count].T)


def plain_graph(module: nn.Module, *inputs: Tensor) -> torch.fx.GraphModule:
    """A module as a graph of ordinary forward operations, its derivatives among them, for inputs of these shapes."""
    from torch._decomp import core_aten_decompositions
    from torch.fx.experimental.proxy_tensor import make_fx

    # What forward mode makes of a tangent that is zero; nothing that reads ONNX knows it.
    blank = {torch.ops.aten._new_zeros_with_same_feature_meta.default: _zeros}
    graph = make_fx(module, decomposition_table={**core_aten_decompositions(), **blank})(*inputs)
    graph.graph.eliminate_dead_code()
    graph.recompile()
    for name, tensor in list(graph.named_buffers()):
        if tensor._is_zerotensor():  # forward mode's zeros without memory of their own
            setattr(graph, name, torch.zeros(tensor.shape, dtype=tensor.dtype, device=tensor.device))
    return graph


def _zeros(like: Tensor, other: Tensor, *, self_num_batch_dims: int = 0) -> Tensor:
    return other.new_zeros((*like.shape[:self_num_batch_dims], *other.shape))


def export(surrogate: Surrogate, folder: Path | str, directions: int = 64) -> Path:
    """Write a surrogate as graphs into a folder, which `exported.ExportedTwin` opens; it appears whole or not at all.

    `value.onnx` and `value.pt2` take forces at the loaded nodes, (s, 3l), for any s, and give displacements, (s, 3n).
    `linearised.onnx` and `.pt2` take coefficients of the directions, (k,), and give displacement and Jacobian.

    Args:
        surrogate: what to export; from a twin's folder (`twin.load`) its graphs know which twin they are of.
        folder: one that was exported before is replaced.
        directions: most directions of force for the second: those that move the body most.

    Raises:
        ValueError: fewer than one direction, another folder is there, or a model that searches for its states.
        ModuleNotFoundError: `onnx` and `onnxscript` are absent: `pip install 'softtwin[onnx]'`.
    """
    folder = Path(folder)
    if folder.exists() and not (folder / MANIFEST).exists():
        raise ValueError(f"export.folder: expected none, or one that was exported before, got {folder}.")
    _need_onnx()
    basis = leading_directions(surrogate, directions)
    inputs = 3 * len(surrogate.encoder_decoder.loaded)
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    with _quiet(), torch.no_grad():
        forces = torch.zeros(2, inputs)
        value = torch.export.export(
            Value(surrogate, np.eye(inputs)), (forces,), dynamic_shapes=({0: torch.export.Dim("samples")},)
        )
        _write(value, partial / "value", ["forces"], ["displacements"])
        coefficients = torch.zeros(basis.shape[1])
        graph = plain_graph(Linearised(surrogate, basis), coefficients)
        linearised = torch.export.export(graph, (coefficients,))
        _write(linearised, partial / "linearised", ["coefficients"], ["displacement", "jacobian"])
    np.save(partial / "directions.npy", basis)
    np.save(partial / "loaded.npy", surrogate.encoder_decoder.loaded)
    manifest = {
        "format": FORMAT,
        "body": surrogate.body.fingerprint,
        "nodes": len(surrogate.body.points),
        "weights": surrogate.card.get("weights"),
        "architecture": surrogate.card.get("architecture"),
        "files": {name: digest(partial / name) for name in FILES},
        "notice": NOTICE,
    }
    (partial / MANIFEST).write_text(json.dumps(manifest, indent=2))
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(partial, folder)
    return folder


def _write(program: Any, path: Path, inputs: list[str], outputs: list[str]) -> None:
    torch.export.save(program, path.with_suffix(".pt2"))
    converted = torch.onnx.export(program, input_names=inputs, output_names=outputs, dynamo=True, verbose=False)
    assert converted is not None
    converted.save(path.with_suffix(".onnx"))


def _need_onnx() -> None:
    try:
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "export: expected the packages onnx and onnxscript, found none; pip install 'softtwin[onnx]'."
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporter says of packages that nobody needs here."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    try:
        logger.setLevel(logging.ERROR)
        with warnings.catch_warnings():
            for kind in (DeprecationWarning, FutureWarning, UserWarning):
                warnings.filterwarnings("ignore", category=kind, module=r"(torch|onnx|onnxscript|copyreg)(\.|$)")
            yield
    finally:
        logger.setLevel(level)
