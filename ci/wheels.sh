# Sourced by ci/setup.sh: what a machine must bring for the way of wheels, asked at the door and by name.
SHARED_LIBRARIES=(
    # what the wheel of gmsh loads
    libGLU.so.1 libGL.so.1 libX11.so.6 libXext.so.6 libXrender.so.1 libXcursor.so.1 libXfixes.so.3 libXft.so.2
    libXinerama.so.1 libfontconfig.so.1
)
CUDA_BUILD_GB=9 # all extras with torch's CUDA build, while pip unpacks
CPU_BUILD_GB=4

# FFCx compiles each form to a module of Python: a compiler, libc's headers and Python's, tried on the smallest module.
compiles() {
    "$1" - <<'EOF' 2>&1
import os, pathlib, shlex, subprocess, sys, sysconfig, tempfile
compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
with tempfile.TemporaryDirectory() as folder:
    source = pathlib.Path(folder, "m.c")
    source.write_text("#include <Python.h>\n#include <math.h>\n")
    command = [*compiler, f"-I{sysconfig.get_path('include')}", "-fPIC", "-shared", str(source), "-o", f"{folder}/m.so", "-lm"]
    try:
        told = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        sys.exit(f"{compiler[0]}: {error.strerror}")
sys.exit(told.returncode and (told.stderr.strip().splitlines() or ["the compiler failed"])[0])
EOF
}

missing_libraries() {
    "$1" - "${SHARED_LIBRARIES[@]}" <<'EOF'
import ctypes, sys
for name in sys.argv[1:]:
    try:
        ctypes.CDLL(name)
    except OSError:
        print(name)
EOF
}

check_machine() { # PYTHON: everything that pip cannot bring, in one message
    local python=$1 reason missing wanted=""
    if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then wanted+=$'\n'"  venv and ensurepip for $python"; fi
    if ! reason=$(compiles "$python"); then wanted+=$'\n'"  a C compiler with Python's headers, for FFCx at run time: $reason"; fi
    missing=$(missing_libraries "$python" | tr '\n' ' ')
    if [ -n "$missing" ]; then wanted+=$'\n'"  libraries that the wheel of gmsh loads: $missing"; fi
    [ -n "$wanted" ] || return 0
    fail "FEniCSx and all else come as wheels here, without root, but these are for the system to bring:$wanted
By their names in some systems:
  Ubuntu, Debian:  apt-get install python3-venv python3-dev gcc libc6-dev libgl1 libglu1-mesa libxrender1 libxcursor1 libxfixes3 libxft2 libxinerama1 libegl1
  Fedora:          dnf install python3-devel gcc mesa-libGL mesa-libGLU libXrender libXcursor libXfixes libXft libXinerama mesa-libEGL
  openSUSE:        zypper install python313-devel gcc Mesa-libGL1 libGLU1 libXrender1 libXcursor1 libXfixes3 libXft2 libXinerama1
  Arch:            pacman -S python gcc libglvnd glu libxrender libxcursor libxfixes libxft libxinerama"
}

has_gpu() { [ -e /dev/nvidia0 ] || command -v nvidia-smi >/dev/null; }

# From PyPI torch is built for CUDA on x86-64. PyTorch's own index has the build for the CPU, of a higher version
# (2.14.1+cpu), which pip takes as soon as it sees it.
announce_torch() {
    local needed=$CUDA_BUILD_GB free
    if [ "$(uname -m)" != x86_64 ] || [ -n "${PIP_EXTRA_INDEX_URL:-}${PIP_INDEX_URL:-}" ]; then
        needed=$CPU_BUILD_GB
    elif ! has_gpu; then
        say "torch: no GPU is seen here, and from PyPI comes the build for CUDA (6 GB instead of 1). For the build for the
  CPU stop now, export PIP_EXTRA_INDEX_URL=(the address that PyTorch's page \"Get started\" names for Pip and CPU), run again"
    fi
    free=$(df -Pk "$ROOT" | awk 'NR == 2 { print int($4 / 1e6) }')
    [ "$free" -ge "$needed" ] || fail "disk: $needed GB are needed in $ROOT, $free GB are free"
}
