# Sourced by every script here: where things are, and the environment the runs are pinned to.
ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
VENV="$ROOT/.venv"
SYSTEM_PYTHON=${SOFTTWIN_PYTHON:-/usr/bin/python3} # Debian's FEniCSx is built for this one

# MPI ranks are the parallelism: threads of BLAS below them only fight for the same cores.
export OPENBLAS_NUM_THREADS=1
# Containers and CI are root; Open MPI refuses that unless told twice.
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1 PYTHONNOUSERSITE=1

say() { printf '%s\n' "[softtwin] $*"; }
fail() {
    printf '%s\n' "[softtwin] error: $*" >&2
    exit 1
}

# Changes when a virtual environment that lives in folder $1 and was made from the files $2... has to be made anew.
fingerprint() {
    local folder=$1
    shift
    { printf '%s\n' "$folder"; cat "$@"; } | sha256sum | cut -d' ' -f1
}

as_root() {
    if [ "$(id -u)" = 0 ]; then env DEBIAN_FRONTEND=noninteractive "$@"; else sudo env DEBIAN_FRONTEND=noninteractive "$@"; fi
}
