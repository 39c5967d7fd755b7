#!/usr/bin/env bash
# Resolves all dependencies anew and writes ci/constraints.txt and, where a Python 3.12 is found, ci/constraints-011.txt.
# Run it by hand when a dependency is added or is to be renewed; then run ci/test.sh.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
source "$ROOT/ci/way.sh"
cd "$ROOT"
TEMPORARY=$(mktemp -d)
trap 'rm -rf "$TEMPORARY"' EXIT
PINS="$TEMPORARY/pins.txt"

# What is not free: Debian's modules are built for numpy 1.x, and its ufl imports pkg_resources.
printf '%s\n' torch==2.13.0 numpy==1.26.4 setuptools==79.0.1 >"$PINS"

# frozen PYTHON: what pip put there, as pins without local version labels (2.13.0+cpu) and without the project.
frozen() { "$1" -m pip freeze --all --local --exclude-editable | grep -E "^[A-Za-z0-9._-]+==" | grep -v "^pip==" | sed "s/+.*//"; }

resolve() { # EXTRAS: adds to the pins what a virtual environment with the extras holds
    rm -rf "$TEMPORARY/venv"
    "$SYSTEM_PYTHON" -m venv "$TEMPORARY/venv"
    "$TEMPORARY/venv/bin/python" -m pip install -q -c "$PINS" --editable ".[$1]" uv cffi setuptools
    { cat "$PINS"; frozen "$TEMPORARY/venv/bin/python"; } | sort -fu >"$TEMPORARY/more.txt"
    mv "$TEMPORARY/more.txt" "$PINS"
}

write() { # FILE SOURCE PYTHON: the pins under two lines that say what they are
    { printf '# Exact versions for Python %s. Written by ci/pin.sh.\n' "$3"; cat "$2"; } >"$1"
    say "$1: $(wc -l <"$2") pins"
}

resolve torch,mesh,app,dev,benchmark
echo torch-fem==0.14.0 >>"$PINS" # installed without its dependencies
write ci/constraints.txt "$PINS" 3.11
SECOND_PYTHON=$(second_python)
if [ -n "$SECOND_PYTHON" ]; then
    rm -rf "$TEMPORARY/venv"
    "$SECOND_PYTHON" -m venv "$TEMPORARY/venv"
    "$TEMPORARY/venv/bin/python" -m pip install -q --dry-run --report "$TEMPORARY/report.json" '.[fenicsx,torch,mesh,app,dev]'
    # Without the parts of torch's CUDA build: the build for the CPU is to fit the same pins.
    "$SECOND_PYTHON" - "$TEMPORARY/report.json" >"$TEMPORARY/second.txt" <<'EOF'
import json, re, sys
found = (part["metadata"] for part in json.load(open(sys.argv[1]))["install"])
pins = {part["name"]: part["version"].partition("+")[0] for part in found if part["name"] != "softtwin"}
kept = {name: version for name, version in pins.items() if not re.match("nvidia-|cuda-|triton$", name)}
print(*(f"{name}=={kept[name]}" for name in sorted(kept, key=str.lower)), sep="\n")
EOF
    write ci/constraints-011.txt "$TEMPORARY/second.txt" "3.12 and 3.13, by way of wheels"
fi
rm -rf softtwin.egg-info
