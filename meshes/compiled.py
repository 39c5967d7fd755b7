"""Loops that are compiled by numba, where that is installed: the extra `app` brings it, `register` leaves it out.

numba brings a compiler. What has loops for it has another way, too, for machines that only register and stay small.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

try:
    import numba
except ImportError:
    numba = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable[..., Any])
IS_COMPILED = numba is not None


def compiled(function: Function) -> Function:
    """A function of numbers and arrays, compiled when it is first called: for a decorator.

    Divisions by zero give infinities and NaN, as in NumPy. What was compiled is kept beside the source, else in the
    user's cache, else for this process alone. Without numba it stays as it is.
    """
    if numba is None:
        return function
    try:
        made: Any = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # no place to keep it
        made = numba.njit(error_model="numpy")(function)
    found: Function = made
    return found


def said_when_compiling(say: Callable[[], object]) -> AbstractContextManager[object]:
    """A context that calls `say` when numba compiles the first loop in it: that takes seconds, once a machine.

    Args:
        say: called once at most; never for loops that an earlier process has compiled and kept.
    """
    if numba is None:
        return nullcontext()
    from numba.core import event

    class Compiling(event.Listener):  # type: ignore[misc]
        is_said = False

        def on_start(self, event: object) -> None:
            if not self.is_said:
                self.is_said = True
                say()

        def on_end(self, event: object) -> None:
            pass

    listening: AbstractContextManager[object] = event.install_listener("numba:compile", Compiling())
    return listening
