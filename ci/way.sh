# Sourced by ci/setup.sh and by tests: the way on which FEniCSx comes here, and the Python that it is for.
#
#   apt      Debian 12 and 13: Debian's packages, for Debian's own Python
#   wheels   any other Linux with glibc and a Python >= 3.12: from PyPI alone, without root
#   present  a Python named by SOFTTWIN_PYTHON has FEniCSx already (conda, a cluster's module)
#
# SOFTTWIN_SETUP names a way and ends the search.
OS_RELEASE=${SOFTTWIN_OS_RELEASE:-/etc/os-release}
OLDEST_FOR_WHEELS=3.12

# os_field NAME: a field of os-release, empty where there is none.
os_field() { (unset "$1"; . "$OS_RELEASE" 2>/dev/null; printf '%s' "${!1:-}"); }

has_fenicsx() { "$1" -c 'import dolfinx, petsc4py, slepc4py, mpi4py' 2>/dev/null; }

# The way for this machine, on standard output; ends with a reason where there is none.
setup_way() {
    case ${SOFTTWIN_SETUP:-} in
        apt | wheels | present) printf '%s\n' "$SOFTTWIN_SETUP" && return ;;
        '') ;;
        *) fail "SOFTTWIN_SETUP: expected apt, wheels or present, got '$SOFTTWIN_SETUP'" ;;
    esac
    if [ "${SOFTTWIN_PYTHON:-/usr/bin/python3}" != /usr/bin/python3 ] && has_fenicsx "$SOFTTWIN_PYTHON"; then
        echo present
    elif [ "$(os_field ID)" = debian ] && [[ "$(os_field VERSION_ID)" =~ ^(12|13)$ ]]; then
        echo apt
    elif [ "$(uname -s)" != Linux ]; then
        fail "set-up is for Linux, this is $(uname -s). With conda: docs/installation.md"
    elif [ "$(os_field ID)" = alpine ] || compgen -G '/lib/ld-musl-*' >/dev/null; then
        fail "the wheels of FEniCSx, VTK and gmsh are built for glibc, and $(os_field PRETTY_NAME) has musl.
  Take a container of Debian, or conda: docs/installation.md"
    else
        echo wheels
    fi
}

# What may be a Python new enough for the wheels, the one that the pins were resolved for first.
candidates() {
    if [ -n "${SOFTTWIN_PYTHON:-}" ]; then
        printf '%s\n' "$SOFTTWIN_PYTHON"
    else
        printf '%s\n' python3.12 python3.13 python3.14 python3 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.1[234]*/bin/python3
    fi
}

# describe PYTHON: its real path and its version, in one line; nothing where it does not run.
describe() { "$1" -c 'import sys; print(sys.executable, "%d.%d" % sys.version_info[:2])' 2>/dev/null; }

# The real path of a Python for the wheels, on standard output; ends with what was found, and what to do.
wheel_python() {
    local candidate path version found=""
    while read -r candidate; do
        read -r path version < <(describe "$candidate") || continue
        if [ "$(printf '%s\n' "$OLDEST_FOR_WHEELS" "$version" | sort -V | head -n 1)" = "$OLDEST_FOR_WHEELS" ]; then
            printf '%s\n' "$path"
            return
        fi
        found+=" $path ($version)"
    done < <(candidates)
    fail "FEniCSx's wheels need a Python >= $OLDEST_FOR_WHEELS; found:${found:- none}.
  Install one (Fedora, openSUSE, Arch, Ubuntu 24.04 and newer have it), name it by SOFTTWIN_PYTHON=/path/to/python3.12,
  or go on without FEniCSx, to train and register only:  pip install 'softtwin[torch,mesh,app]'"
}

# The real path of a Python 3.12 (the pins are for it): on PATH, or kept by pyenv, whose shim may point nowhere.
second_python() {
    local candidate
    for candidate in python3.12 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python3.12; do
        if "$candidate" -c 'import sys, venv; print(sys.executable)' 2>/dev/null; then return; fi
    done
}
