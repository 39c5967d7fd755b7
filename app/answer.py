"""One registered cloud of a running camera, and how it kept up; what gives it back to whoever sent the cloud."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from .twin import Frame


@dataclass(frozen=True, eq=False)
class Answer:
    """A frame, and how it kept up with the camera.

    Args:
        frame: the frame.
        cloud: name of its file, or what its sender calls it; empty for points without a name.
        age: from the cloud's coming to the answer, seconds.
        dropped: clouds that came and went unregistered since the frame before.
        is_late: whether the age is more than was allowed.
    """

    frame: Frame
    cloud: str
    age: float
    dropped: int
    is_late: bool


Reply = Callable[[Answer, Mapping[str, Any]], None]
"""What is given each answer, and its figures as they stand in the record."""
