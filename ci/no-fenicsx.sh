#!/usr/bin/env bash
# In virtual environments that see no FEniCSx.
#
#   ci/no-fenicsx.sh contract [JUNIT]   the wheel is whole; a machine that only registers (softtwin[register]) stays small,
#                                       imports the fast path, predicts and registers: tests/contract
#   ci/no-fenicsx.sh suites [JUNIT]     softtwin[torch,mesh,app,onnx] and all tests of meshes, surrogate and registration
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
WHAT=${1:-contract}
[[ $WHAT = contract || $WHAT = suites ]] || fail "no-fenicsx: expected contract or suites, got '$WHAT'"
BARE="$ROOT/.venv-bare-$WHAT"
JUNIT=${2:-$ROOT/build/ci/$WHAT.xml}
STAMP="$BARE/.softtwin-stamp"
WANTED=$(fingerprint "$BARE $("$SYSTEM_PYTHON" -V)" pyproject.toml ci/constraints.txt ci/no-fenicsx.sh)
MOST_BYTES=1500000000 # of a machine that only registers, where torch is the build for the CPU

# install PINS WORDS...: into the bare environment, by the uv of the other one.
install() {
    local pins=$1
    shift
    eval "$("$VENV/bin/python" -m pip config list | "$VENV/bin/python" ci/uv_settings.py)"
    if [ -x "$VENV/bin/uv" ]; then
        UV_LINK_MODE=${UV_LINK_MODE:-copy} "$VENV/bin/uv" pip install -q --python "$BARE/bin/python" -c "$pins" "$@"
    else
        "$BARE/bin/python" -m pip install -q --no-compile -c "$pins" "$@"
    fi
}

# As installed: what Python compiles and writes down in use, unless PYTHONDONTWRITEBYTECODE is set, adds 70 MB.
check_size() {
    local size
    size=$(du -sB1 "$BARE" | cut -f1)
    say "softtwin[register]: $((size / 1000000)) MB on disk, of $((MOST_BYTES / 1000000)) at most"
    if ! "$BARE/bin/python" -Bc 'import sys, torch; sys.exit(torch.version.cuda is not None)'; then
        say "this torch is the build for CUDA, whose size is not softtwin's: not held against the bound"
    elif [ "$size" -gt "$MOST_BYTES" ]; then
        fail "softtwin[register] takes more than $((MOST_BYTES / 1000000)) MB; the largest parts:
$(du -sm "$BARE"/lib/python3*/site-packages/* | sort -rn | head -n 6)"
    fi
}

say "building the wheel"
rm -rf build/lib build/bdist.* build/wheel # setuptools would pack files that are gone from the tree
"$SYSTEM_PYTHON" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { echo "skipped: the pins are for Python 3.11"; exit 77; }
"$VENV/bin/python" -m pip wheel -q --no-deps -w build/wheel .
rm -rf build/lib build/bdist.* softtwin.egg-info
WHEEL=$(echo build/wheel/softtwin-*.whl)
"$VENV/bin/python" ci/check_wheel.py "$WHEEL"

if [ ! -f "$STAMP" ] || [ "$(cat "$STAMP")" != "$WANTED" ]; then
    rm -rf "$BARE"
    "$SYSTEM_PYTHON" -m venv "$BARE"
    if [ "$WHAT" = contract ]; then
        say "making ${BARE##*/}: softtwin[register] without the system's packages"
        grep -v '^vtk==' ci/constraints.txt >build/wheel/pins.txt # register asks for a smaller VTK
        install build/wheel/pins.txt "$WHEEL[register]"
        check_size
        install build/wheel/pins.txt pytest
    else
        say "making ${BARE##*/}: softtwin[torch,mesh,app,onnx] without the system's packages"
        install ci/constraints.txt "$WHEEL[torch,mesh,app,onnx,test]"
    fi
    echo "$WANTED" >"$STAMP"
fi
"$BARE/bin/python" -m pip install -q --no-deps --force-reinstall "$WHEEL"
"$BARE/bin/python" -m pip check
mkdir -p "$(dirname "$JUNIT")"
if [ "$WHAT" = contract ]; then
    (cd / && "$BARE/bin/python" "$ROOT/ci/import_fast_path.py" --register)
    "$BARE/bin/python" -m pytest -q -o junit_family=xunit1 -o cache_dir="$BARE/.pytest_cache" --junitxml="$JUNIT" tests/contract
else
    (cd / && "$BARE/bin/python" "$ROOT/ci/import_fast_path.py")
    "$BARE/bin/python" -m pytest -q -n "${SOFTTWIN_TEST_WORKERS:-2}" --dist worksteal -m "not fenicsx and not mpi and not liver" \
        -o junit_family=xunit1 -o cache_dir="$BARE/.pytest_cache" --junitxml="$JUNIT" \
        tests/contract tests/meshes tests/surrogate tests/registration
fi
"$BARE/bin/python" ci/tally.py "$JUNIT"
