#!/usr/bin/env bash
# The reference's tests on a second DOLFINx: the wheel 0.11 with MPICH, in .venv-011, where a Python 3.12 or later is
# found. Argument: where to put pytest's JUnit file.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
source "$ROOT/ci/way.sh"
cd "$ROOT"
SECOND="$ROOT/.venv-011"
JUNIT=${1:-$ROOT/build/ci/dolfinx-0.11.xml}
STAMP="$SECOND/.softtwin-stamp"

PYTHON=$(second_python)
if [ -z "$PYTHON" ]; then
    echo "skipped: no Python 3.12 found for the wheel of DOLFINx 0.11"
    exit 77
fi
WANTED=$(fingerprint "$SECOND $PYTHON" pyproject.toml ci/constraints-011.txt ci/dolfinx011.sh)
if [ ! -f "$STAMP" ] || [ "$(cat "$STAMP")" != "$WANTED" ]; then
    say "making .venv-011 with $("$PYTHON" -V) and DOLFINx 0.11"
    rm -rf "$SECOND"
    "$PYTHON" -m venv "$SECOND"
    "$SECOND/bin/python" -m pip install -q -c ci/constraints-011.txt --editable '.[fenicsx,mesh,test]'
    rm -rf softtwin.egg-info
    echo "$WANTED" >"$STAMP"
fi
export PATH="$SECOND/bin:$PATH" # its own mpirun: MPICH's, not Debian's Open MPI
python -c 'import dolfinx_solver, dolfinx, mpi4py.MPI as m; print("DOLFINx", dolfinx.__version__, "with", *m.get_vendor())'
[ -d tests/reference ] || fail "no tests in tests/reference"
mkdir -p "$(dirname "$JUNIT")"
pytest -q -m "not liver" -o junit_family=xunit1 -o cache_dir="$SECOND/.pytest_cache" --junitxml="$JUNIT" tests/reference
python ci/tally.py "$JUNIT"
