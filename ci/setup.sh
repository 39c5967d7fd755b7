#!/usr/bin/env bash
# All set-up, idempotent: FEniCSx on one of the ways of ci/way.sh, the virtual environment .venv, the project in it.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
source "$ROOT/ci/way.sh"
source "$ROOT/ci/wheels.sh"
cd "$ROOT"
exec 9<"$ROOT"
flock 9 # two set-ups at once would break each other's virtual environment

PACKAGES=(
    # FEniCSx with PETSc, SLEPc and MPI, and a BLAS that does not make MUMPS 4 times slower
    python3-dolfinx-real python3-petsc4py-real python3-slepc4py-real python3-mpi4py
    libopenblas0-pthread openmpi-bin
    # a virtual environment, and the C compiler and headers that FFCx needs at run time
    python3-venv python3-dev gcc libc6-dev make
    # what the wheels of gmsh and VTK load: OpenGL (also without a screen, by EGL) and X
    libgl1 libegl1 libglu1-mesa libopengl0 libglx0 libx11-6 libxext6 libxcursor1 libxfixes3 libxft2 libxinerama1
    libxrender1 libfontconfig1 libgomp1
)

# missing NAME...: those of the packages that are not installed.
missing() {
    local installed
    installed=$(dpkg-query -W -f='${Package} ${db:Status-Status}\n' "$@" 2>/dev/null | awk '$2 == "installed" { print $1 }') || true
    comm -23 <(printf '%s\n' "$@" | sort) <(printf '%s\n' "$installed" | sort)
}

# install_packages NAME...: by apt, those that are missing.
install_packages() {
    local wanted
    mapfile -t wanted < <(missing "$@")
    if [ ${#wanted[@]} = 0 ]; then
        say "system packages: all $# are there"
        return
    fi
    say "system packages: ${#wanted[@]} of $# are missing: ${wanted[*]}"
    if [ "$(id -u)" != 0 ] && ! command -v sudo >/dev/null; then
        fail "they need root. Run as root, or ask for: apt-get install ${wanted[*]}"
    fi
    local lock=(-o DPkg::Lock::Timeout=600)
    # An installation that was cut short leaves packages half configured, and apt-get would stop there.
    if [ -n "$(dpkg --audit 2>/dev/null)" ]; then as_root dpkg --configure -a </dev/null; fi
    if [ -z "${LISTS_ARE_NEW:-}" ]; then
        as_root apt-get "${lock[@]}" -q update </dev/null || fail "apt-get update did not work; wanted: ${wanted[*]}"
        LISTS_ARE_NEW=1
    fi
    as_root apt-get "${lock[@]}" -q install -y --no-install-recommends "${wanted[@]}" </dev/null ||
        fail "apt-get could not install: ${wanted[*]}"
}

# The pins were resolved for two ways; on another Python the newest versions that fit are taken.
constraints() {
    local version
    version=$("$SYSTEM_PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    case $WAY-$version in
        apt-3.11) echo ci/constraints.txt ;;
        wheels-3.12 | wheels-3.13) echo ci/constraints-011.txt ;;
        *) echo /dev/null ;;
    esac
}

# NumPy of the kind (1 or 2) that the FEniCSx of this Python was built for.
same_numpy() {
    "$SYSTEM_PYTHON" -c 'import numpy; major = int(numpy.__version__.split(".")[0]); print(f"numpy>={major},<{major + 1}")' 2>/dev/null || true
}

# install WORDS...: by uv, which is several times as quick and told what pip is told; by pip where there is no uv.
install() {
    local pins
    pins=$(constraints)
    if "$VENV/bin/python" -m pip install -q -c "$pins" uv </dev/null 2>/dev/null; then
        eval "$("$VENV/bin/python" -m pip config list | "$VENV/bin/python" ci/uv_settings.py)"
        UV_LINK_MODE=${UV_LINK_MODE:-copy} "$VENV/bin/uv" pip install -q --python "$VENV/bin/python" -c "$pins" "$@" </dev/null
    else
        say "virtual environment: no uv for this machine, taking pip"
        "$VENV/bin/python" -m pip install -q -c "$pins" "$@" </dev/null
    fi
}

install_project() {
    local pins stamp="$VENV/.softtwin-stamp" made="$VENV/.softtwin-way" origin wanted numpy beside=()
    origin="$WAY $("$SYSTEM_PYTHON" -V), isolated"
    pins=$(constraints)
    [ "$pins" != /dev/null ] || say "virtual environment: there are no pins for the way $WAY, taking the newest versions"
    wanted=$(fingerprint "$VENV $EXTRAS $origin" pyproject.toml "$pins" ci/setup.sh ci/let_in.py)
    if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ] && "$VENV/bin/python" -c 'import softtwin.meshes' 2>/dev/null; then
        say "virtual environment: .venv is up to date"
        return
    fi
    # Without its stamp it was cut short, or it was made for another folder or way: no installer can be trusted to mend that.
    if [ ! -f "$stamp" ] || [ "$(cat "$made" 2>/dev/null)" != "$origin" ] || ! grep -qsF "$VENV/bin/python" "$VENV/bin/pip" || ! "$VENV/bin/python" -m pip --version >/dev/null 2>&1; then
        say "virtual environment: making .venv"
        rm -rf "$VENV"
        "$SYSTEM_PYTHON" -m venv "$VENV"
        echo "$origin" >"$made"
    fi
    rm -f "$stamp"
    say "virtual environment: installing the project and its dependencies (a minute the first time)"
    # FEniCSx that another Python has is let in by name; what it needs beside, the environment has of its own.
    if [ "$WAY" = wheels ]; then
        announce_torch
    else
        numpy=$(same_numpy) # none where apt still brings it: then there are pins
        beside=(cffi "setuptools<80" ${numpy:+"$numpy"})
    fi
    install --editable ".[$EXTRAS]" "${beside[@]}"
    rm -rf "$ROOT/softtwin.egg-info" # a by-product: seen from this folder, it makes pkg_resources warn
    if [ -n "$BEHIND" ]; then wait_for_packages; fi
    if [ "$WAY" != wheels ]; then "$SYSTEM_PYTHON" ci/let_in.py "$VENV"; fi
    # Before the stamp says that all is well; PyPI's DOLFINx wants its solvers first, which this module knows.
    "$VENV/bin/python" -c 'import torch, softtwin.meshes, softtwin.reference.fem.fenicsx'
    echo "$wanted" >"$stamp"
}

# mypy does not follow editable installs: it finds the top-level folders under one name here.
link_types() {
    mkdir -p "$VENV/types/softtwin"
    local folder
    for folder in meshes reference surrogate registration app; do
        ln -sfn "../../../$folder" "$VENV/types/softtwin/$folder"
    done
}

# wait_for_packages: until those of the system are there; what apt said is shown where it failed.
wait_for_packages() {
    if ! wait "$BEHIND"; then
        cat "$ROOT/build/apt.log" >&2
        fail "the system's packages could not be installed"
    fi
    grep -h '^\[softtwin\]' "$ROOT/build/apt.log" || true
    BEHIND=""
}

WAY=$(setup_way)
EXTRAS=${SOFTTWIN_EXTRAS:-torch,mesh,app,dev} # what of the project is installed
BEHIND="" # the process that installs system packages meanwhile
case $WAY in
    apt)
        say "FEniCSx: Debian's packages, by apt"
        install_packages python3-venv python3-dev gcc libc6-dev # crcmod of pyigtl is compiled
        # dpkg and the installer of Python's packages keep a core busy each. Without pins the second has to see the first's NumPy.
        if [ "$(constraints)" != /dev/null ]; then
            mkdir -p "$ROOT/build"
            install_packages "${PACKAGES[@]}" >"$ROOT/build/apt.log" 2>&1 &
            BEHIND=$!
        else
            install_packages "${PACKAGES[@]}"
        fi
        ;;
    wheels)
        SYSTEM_PYTHON=$(wheel_python)
        EXTRAS=fenicsx,$EXTRAS
        say "FEniCSx: wheels from PyPI for $SYSTEM_PYTHON"
        check_machine "$SYSTEM_PYTHON"
        ;;
    present)
        has_fenicsx "$SYSTEM_PYTHON" || fail "SOFTTWIN_PYTHON: $SYSTEM_PYTHON has no FEniCSx"
        say "FEniCSx: $SYSTEM_PYTHON has it"
        ;;
esac
install_project
[ -z "$BEHIND" ] || wait_for_packages
link_types
say "ready: .venv/bin/softtwin --help"
