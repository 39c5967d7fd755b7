"""What native libraries do to the signals of the process that loads them, undone."""

from __future__ import annotations

import ctypes
import signal

_SIG_IGN = 1  # of <signal.h>


def restore_sigpipe() -> None:
    """Let a write to a socket or pipe that nobody reads raise BrokenPipeError again, as Python arranges at its start.

    gmsh, when it is finalised, and PETSc, when DOLFINx loads it with its own handler, put another action in its place:
    the next browser or camera that goes away would then end the process without a word. Python's own `signal.signal`
    works in the main thread alone, and does not see what C has changed. A program that chose another action by
    `signal.signal` keeps it.
    """
    if getattr(signal, "SIGPIPE", None) is None or signal.getsignal(signal.SIGPIPE) is not signal.SIG_IGN:
        return
    put = ctypes.CDLL(None).signal
    put.argtypes, put.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
    put(signal.SIGPIPE, _SIG_IGN)
