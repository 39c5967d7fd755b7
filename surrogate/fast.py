"""A surrogate on a CPU or a GPU, single or double: displacement, and displacement with Jacobian, host to host.

On a GPU both are captured once as CUDA graphs: what a prediction costs there is the start of its hundred small kernels.
They are captured by hand, since torch.compile loses forward-mode tangents (pytorch issues 187284, 183603).
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from softtwin.reference.data.loading import checked_array

from .export import Linearised, Value, leading_directions
from .model import Surrogate
from .precision import without_tf32

Floats = NDArray[np.float64]
Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["single", "double"]
_WARM_UP = 3  # runs before a capture, as CUDA asks for
_KINDS = {"single": torch.float32, "double": torch.float64}


class FastSurrogate:
    """What a surrogate predicts: good to 1e-6 of its largest displacement in single precision, to rounding in double.

    Args:
        surrogate: the surrogate.
        device: `auto` takes a GPU where torch sees one.
        directions: of force, for the Jacobian: those that move the body most.
        batch: loads of one call of `solve_many`.
        precision: `single`, or `double` where 1e-6 is too much.

    Raises:
        ValueError: a GPU is asked for, and torch sees none; another precision.
    """

    def __init__(
        self,
        surrogate: Surrogate,
        device: Device = "auto",
        directions: int = 64,
        batch: int | None = None,
        precision: Precision = "single",
    ) -> None:
        if precision not in get_args(Precision):
            raise ValueError(f"FastSurrogate.precision: expected one of {get_args(Precision)}, got {precision!r}.")
        self.device, self.precision, kind = _resolved(device), precision, _KINDS[precision]
        self.body, self.loaded, self.batch = surrogate.body, surrogate.encoder_decoder.loaded, batch
        self.directions = leading_directions(surrogate, directions, self.device)
        inputs = 3 * len(self.loaded)
        value = Value(surrogate, np.eye(inputs), kind)
        self._value = Captured(value, torch.zeros(1, inputs, dtype=kind), self.device)
        linearised = Linearised(surrogate, self.directions, kind)
        self._linearised = Captured(linearised, torch.zeros(self.directions.shape[1], dtype=kind), self.device)
        self._many = None if batch is None else Captured(value, torch.zeros(batch, inputs, dtype=kind), self.device)

    def solve(self, forces: ArrayLike) -> Floats:
        """Displacement, (n, 3), metres, under nodal forces, (n, 3), newtons; those at nodes never loaded are left out.

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        given = checked_array("FastSurrogate.forces", forces, self.body.points.shape)
        (found,) = self._value(given[self.loaded].reshape(1, -1))
        return found.reshape(-1, 3).astype(np.float64)

    def solve_many(self, forces: ArrayLike) -> Floats:
        """Displacements, (batch, n, 3), metres, under as many nodal forces, newtons.

        Raises:
            ValueError: another shape than the batch's, or numbers that are not finite.
        """
        if self._many is None:
            raise ValueError("FastSurrogate.batch: expected a number of loads when it was built, got None.")
        given = checked_array("FastSurrogate.forces", forces, (self.batch or 0, *self.body.points.shape))
        (found,) = self._many(given[:, self.loaded].reshape(len(given), -1))
        return found.reshape(len(given), -1, 3).astype(np.float64)

    def linearised(self, coefficients: ArrayLike) -> tuple[Floats, Floats]:
        """Displacement, (n, 3), metres, and its derivative, (3n, k), for coefficients of the directions, (k,), newtons.

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        given = checked_array("FastSurrogate.coefficients", coefficients, (self.directions.shape[1],))
        displacement, jacobian = self._linearised(given)
        return displacement.reshape(-1, 3).astype(np.float64), jacobian.astype(np.float64)


class Captured:
    """A module without gradients, from arrays to arrays; on a GPU replayed from a CUDA graph.

    Args:
        module: in one precision.
        example: an input of the shape that all will have, in the module's precision.
        device: `cpu` or `cuda`.
    """

    def __init__(self, module: nn.Module, example: Tensor, device: str) -> None:
        self._module, self._kind = module.to(device).eval().requires_grad_(False), example.dtype
        self._graph: torch.cuda.CUDAGraph | None = None
        if device == "cuda":
            self._capture(example)

    def _capture(self, example: Tensor) -> None:
        self._input = example.to("cuda")
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.no_grad(), without_tf32(), torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._run(self._input)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.no_grad(), without_tf32(), torch.cuda.graph(self._graph):
            self._outputs = self._run(self._input)
        self._sent = torch.empty(example.shape, dtype=self._kind, pin_memory=True)
        self._received = [torch.empty(output.shape, dtype=output.dtype, pin_memory=True) for output in self._outputs]

    def _run(self, given: Tensor) -> tuple[Tensor, ...]:
        found = self._module(given)
        return found if isinstance(found, tuple) else (found,)

    def __call__(self, given: Floats) -> list[NDArray[Any]]:
        """Outputs for an input, copied: the next call does not change them."""
        if self._graph is None:
            with torch.no_grad():
                return [output.numpy() for output in self._run(torch.from_numpy(given).to(self._kind))]
        self._sent.copy_(torch.from_numpy(given))
        self._input.copy_(self._sent, non_blocking=True)
        self._graph.replay()
        for host, output in zip(self._received, self._outputs, strict=True):
            host.copy_(output, non_blocking=True)
        torch.cuda.synchronize()
        return [host.numpy().copy() for host in self._received]


def _resolved(device: Device) -> str:
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"FastSurrogate.device: expected a GPU that torch can use, found none (torch {torch.__version__}); take "
            "'cpu' or 'auto', or a build of torch with CUDA."
        )
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
