"""A peer that goes away must not end the process: SIGPIPE stays ignored whatever native libraries do."""

import subprocess
import sys
import threading

import pytest

from softtwin.meshes.signals import restore_sigpipe

_WRITE = """
import os
reading, writing = os.pipe()
os.close(reading)
try:
    os.write(writing, b"x")
except BrokenPipeError:
    print("still here")
"""


def _run(before: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", before + _WRITE], capture_output=True, text=True, timeout=120)


def test_a_broken_pipe_is_an_error_after_gmsh_has_made_a_mesh() -> None:
    pytest.importorskip("gmsh", reason="gmsh is absent")
    done = _run("from softtwin.meshes.shapes import liver_phantom\nliver_phantom(0.02)\n")
    assert done.stdout.strip() == "still here", (done.returncode, done.stderr)


def test_gmsh_alone_would_end_the_process() -> None:
    pytest.importorskip("gmsh", reason="gmsh is absent")
    bare = "import gmsh\ngmsh.initialize(['-nopopup'], interruptible=False)\ngmsh.finalize()\n"
    if _run(bare).returncode == 0:
        pytest.skip("this gmsh leaves SIGPIPE alone: restore_sigpipe is not needed for it")
    assert _run(bare + "from softtwin.meshes.signals import restore_sigpipe\nrestore_sigpipe()\n").returncode == 0


def test_and_where_dolfinx_was_imported_before_the_reference() -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    done = _run("import dolfinx\nimport softtwin.reference.fem.fenicsx\n")
    assert done.stdout.strip() == "still here", (done.returncode, done.stderr)


def test_it_works_in_any_thread_and_leaves_what_a_program_chose() -> None:
    begin = "import signal, threading\nfrom softtwin.meshes.signals import restore_sigpipe\n"
    chosen = _run(begin + "signal.signal(signal.SIGPIPE, signal.SIG_DFL)\nrestore_sigpipe()\n")
    assert chosen.returncode < 0 and not chosen.stdout
    thread = threading.Thread(target=restore_sigpipe)
    thread.start()
    thread.join()
