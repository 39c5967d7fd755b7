#!/usr/bin/env bash
# In a virtual environment that sees no FEniCSx: the wheel is whole, a machine that only registers (softtwin[register])
# stays small, every module of the fast path imports, and its tests pass. Argument: where to put pytest's JUnit file.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
BARE="$ROOT/.venv-bare"
JUNIT=${1:-$ROOT/build/ci/no-fenicsx.xml}
STAMP="$BARE/.softtwin-stamp"
WANTED=$(fingerprint "$BARE $("$SYSTEM_PYTHON" -V)" pyproject.toml ci/constraints.txt ci/no-fenicsx.sh)

MOST_BYTES=1500000000 # of a machine that only registers, where torch is the build for the CPU

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
    say "making .venv-bare: pip install --no-compile 'softtwin[register]' without the system's packages"
    rm -rf "$BARE"
    "$SYSTEM_PYTHON" -m venv "$BARE"
    # All pins but VTK's: register asks for a smaller one.
    "$BARE/bin/python" -m pip install -q --no-compile -c <(grep -v '^vtk==' ci/constraints.txt) "$WHEEL[register]"
    check_size
    (cd / && "$BARE/bin/python" "$ROOT/ci/import_fast_path.py" --register)
    "$BARE/bin/python" -m pip install -q -c ci/constraints.txt "$WHEEL[torch,mesh,app,onnx,test]"
    echo "$WANTED" >"$STAMP"
fi
"$BARE/bin/python" -m pip install -q --no-deps --force-reinstall "$WHEEL"
"$BARE/bin/python" -m pip check
(cd / && "$BARE/bin/python" "$ROOT/ci/import_fast_path.py")
mkdir -p "$(dirname "$JUNIT")"
mapfile -t FOLDERS < <(find tests/meshes tests/surrogate tests/registration -name 'test_*.py' -printf '%h\n' 2>/dev/null | sort -u)
[ ${#FOLDERS[@]} != 0 ] || fail "no tests in tests/meshes, tests/surrogate, tests/registration"
"$BARE/bin/pytest" -q -m "not fenicsx and not mpi and not liver" -o junit_family=xunit1 -o cache_dir="$BARE/.pytest_cache" \
    --junitxml="$JUNIT" "${FOLDERS[@]}"
"$BARE/bin/python" ci/tally.py "$JUNIT"
