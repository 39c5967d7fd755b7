#!/usr/bin/env bash
# All set-up, idempotent: system packages (Debian), the virtual environment .venv, the project in it.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
exec 9<"$ROOT"
flock 9 # two set-ups at once would break each other's virtual environment

PACKAGES=(
    # FEniCSx with PETSc, SLEPc and MPI, and a BLAS that does not make MUMPS 4 times slower
    python3-dolfinx-real python3-petsc4py-real python3-slepc4py-real python3-mpi4py python3-scipy
    libopenblas0-pthread openmpi-bin
    # a virtual environment, and the C compiler and headers that FFCx needs at run time
    python3-venv python3-dev gcc libc6-dev make
    # what the wheels of gmsh and VTK load: OpenGL (also without a screen, by EGL) and X
    libgl1 libegl1 libglu1-mesa libopengl0 libglx0 libx11-6 libxext6 libxcursor1 libxfixes3 libxft2 libxinerama1
    libxrender1 libfontconfig1 libgomp1
)

missing_packages() {
    local installed
    installed=$(dpkg-query -W -f='${Package} ${db:Status-Status}\n' "${PACKAGES[@]}" 2>/dev/null | awk '$2 == "installed" { print $1 }') || true
    comm -23 <(printf '%s\n' "${PACKAGES[@]}" | sort) <(printf '%s\n' "$installed" | sort)
}

install_packages() {
    local wanted
    mapfile -t wanted < <(missing_packages)
    if [ ${#wanted[@]} = 0 ]; then
        say "system packages: all ${#PACKAGES[@]} are there"
        return
    fi
    say "system packages: ${#wanted[@]} of ${#PACKAGES[@]} are missing: ${wanted[*]}"
    if [ "$(id -u)" != 0 ] && ! command -v sudo >/dev/null; then
        fail "they need root. Run as root, or ask for: apt-get install ${wanted[*]}"
    fi
    local lock=(-o DPkg::Lock::Timeout=600)
    # An installation that was cut short leaves packages half configured, and apt-get would stop there.
    if [ -n "$(dpkg --audit 2>/dev/null)" ]; then as_root dpkg --configure -a </dev/null; fi
    as_root apt-get "${lock[@]}" -q update </dev/null || fail "apt-get update did not work; wanted: ${wanted[*]}"
    as_root apt-get "${lock[@]}" -q install -y --no-install-recommends "${wanted[@]}" </dev/null ||
        fail "apt-get could not install: ${wanted[*]}"
}

check_system_without_apt() {
    if "$SYSTEM_PYTHON" -c 'import venv, dolfinx, petsc4py, slepc4py, mpi4py' 2>/dev/null; then
        say "no apt-get here, but $SYSTEM_PYTHON has FEniCSx: going on"
        return
    fi
    fail "no apt-get here, and $SYSTEM_PYTHON has no FEniCSx. Needed, by their names in Debian 12:
  ${PACKAGES[*]}
Install them by other means (SOFTTWIN_PYTHON names another interpreter), or take the part without FEniCSx:
  pip install '.[torch,mesh,app]'   (Python 3.12 and later: '.[torch,mesh,app,fenicsx]' brings FEniCSx too)"
}

# The pins were resolved for Debian 12's Python; on another one the newest versions that fit are taken.
constraints() {
    if "$SYSTEM_PYTHON" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then
        echo ci/constraints.txt
    else
        echo /dev/null
    fi
}

install_project() {
    local pins stamp="$VENV/.softtwin-stamp" wanted
    pins=$(constraints)
    [ "$pins" != /dev/null ] || say "virtual environment: ci/constraints.txt is for Python 3.11, taking unpinned versions"
    wanted=$(fingerprint "$VENV $("$SYSTEM_PYTHON" -V)" pyproject.toml "$pins")
    if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ] && "$VENV/bin/python" -c 'import softtwin.meshes' 2>/dev/null; then
        say "virtual environment: .venv is up to date"
        return
    fi
    # Without its stamp it was cut short, or it was made for another folder: pip cannot be trusted to mend that.
    if [ ! -f "$stamp" ] || ! grep -qsF "$VENV/bin/python" "$VENV/bin/pip" || ! "$VENV/bin/python" -m pip --version >/dev/null 2>&1; then
        say "virtual environment: making .venv"
        rm -rf "$VENV"
        "$SYSTEM_PYTHON" -m venv --system-site-packages "$VENV"
    fi
    rm -f "$stamp"
    say "virtual environment: installing the project and its pinned dependencies (about 3 minutes the first time)"
    "$VENV/bin/python" -m pip install -q -c "$pins" --editable '.[torch,mesh,app,dev]' </dev/null
    rm -rf "$ROOT/softtwin.egg-info" # a by-product: seen from this folder, it makes pkg_resources warn
    "$VENV/bin/python" -c 'import dolfinx, torch, softtwin.meshes' # before the stamp says that all is well
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

if command -v apt-get >/dev/null; then install_packages; else check_system_without_apt; fi
install_project
link_types
say "ready: .venv/bin/softtwin --help"
