"""How a registration ended, and what to try."""

from __future__ import annotations

from enum import Enum


class Outcome(Enum):
    """How a solver stopped; only `CONVERGED` is a success."""

    CONVERGED = "converged"
    NO_DESCENT = "no step lowers the objective"
    NO_STATE = "the model finds no state further on"
    MAXIMUM_ITERATIONS = "most iterations reached"
    OUT_OF_TIME = "the time for it was over"

    @property
    def is_success(self) -> bool:
        """True for convergence alone."""
        return self is Outcome.CONVERGED

    @property
    def advice(self) -> str:
        """What to try."""
        return _ADVICE[self]


_ADVICE = {
    Outcome.CONVERGED: "nothing: a further step would change less than is uncertain by far.",
    Outcome.NO_DESCENT: "start from another frame's result or a better pose; look whether cloud and organ match.",
    Outcome.NO_STATE: "the forces that the cloud asks for leave what the model can solve: check pose and stiffness.",
    Outcome.MAXIMUM_ITERATIONS: "raise max_iterations, or start from the result of this frame.",
    Outcome.OUT_OF_TIME: "this is the best so far; allow more time a frame, or take a faster engine.",
}
