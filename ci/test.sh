#!/usr/bin/env bash
# All set-up, then checks and tests. All groups run; one line each at the end says what ran, and the exit code is 1
# when any failed.
#
#   bash ci/test.sh          what CI runs, at most a quarter of an hour on two cores
#   bash ci/test.sh --all    what one runs before a release: also tests marked slow, the suites of meshes, surrogate and
#                            registration without FEniCSx, and those of the reference on a second DOLFINx
#   bash ci/test.sh GROUP... some groups alone: format lint types layers docs tests apart liver contract, and of --all
#                            slow no-fenicsx dolfinx-0.11
set -uo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
bash ci/setup.sh || exit 1
# The tests of the live page drive a browser, which nothing else needs; where there is none they say that they skip.
if [ ! -x /usr/bin/chromium ] && command -v apt-get >/dev/null; then
    { as_root apt-get -o DPkg::Lock::Timeout=600 -q update && as_root apt-get -o DPkg::Lock::Timeout=600 -q install -y \
        --no-install-recommends chromium; } </dev/null ||
        say "chromium could not be installed: the page is tried in no browser"
fi
export OMP_NUM_THREADS=1 # torch's networks here are small: on cores that others use, its threads wait for each other
export PATH="$VENV/bin:$PATH" PYTHONUNBUFFERED=1 # unbuffered, or a test that forks prints the lines before it twice
LOGS="$ROOT/build/ci"
rm -rf "$LOGS" && mkdir -p "$LOGS"
SKIPPED=77
TABLE=()
FAILED=0
ALL=0
if [ "${1:-}" = --all ]; then
    ALL=1
    shift
fi
ASKED=("$@")
WORKERS=${SOFTTWIN_TEST_WORKERS:-2}

# group NAME COMMAND...: runs the command and keeps its outcome with the last line it printed; 77 means skipped.
group() {
    local name=$1 outcome
    shift
    if [ ${#ASKED[@]} != 0 ] && [[ " ${ASKED[*]} " != *" $name "* ]]; then return; fi
    printf '\n== %s\n' "$name"
    "$@" 2>&1 | tee "$LOGS/$name.log"
    case ${PIPESTATUS[0]} in
        0) outcome=passed ;;
        "$SKIPPED") outcome=skipped ;;
        *) outcome=FAILED FAILED=1 ;;
    esac
    TABLE+=("$(printf '%-8s %-14s %s' "$outcome" "$name" "$(grep -v '^\s*$' "$LOGS/$name.log" | tail -n 1)")")
}

format() { ruff format --check .; }
lint() {
    local script
    for script in .ci/run ci/*.sh; do bash -n "$script" || return 1; done
    ruff check .
}
types() { mypy | sed 's#^\.venv/types/softtwin/##'; } # the links' names mean nothing to a reader
layers() { lint-imports --no-logo; }

docs() {
    rm -rf build/site
    NO_MKDOCS_2_WARNING=1 mkdocs build --strict && echo "site: build/site/index.html, $(find build/site -name '*.html' | wc -l) pages"
}

# run_tests NAME ARGUMENTS...: pytest, then the count by folder, which fails when a folder that can run was all skipped.
run_tests() {
    local name=$1 status
    shift
    pytest -q -o junit_family=xunit1 --durations=20 --durations-min=1 --junitxml="$LOGS/$name.xml" "$@"
    status=$?
    python ci/tally.py "$LOGS/$name.xml" || status=1
    return $status
}
# Each worker is one process with one thread; one that has nothing left takes tests from the other.
parallel=(-n "$WORKERS" --dist worksteal)
tests() { run_tests tests "${parallel[@]}" -m "not liver and not mpi and not browser and not slow" tests; }
# Ranks of MPI and a browser want the cores for themselves.
apart() { run_tests apart -m "(mpi or browser) and not liver and not slow" tests; }
have_liver() {
    [ -d ../shared/data/liver ] && return
    echo "skipped: the real liver is not there (../shared/data/liver, seen from the repository's root)"
    return $SKIPPED
}
liver() { have_liver || return; run_tests liver "${parallel[@]}" -m "liver and not slow" tests; }
slow() { run_tests slow "${parallel[@]}" -m "slow and not mpi" tests; }

group format format
group lint lint
group types types
group layers layers
group docs docs
if [ -f build/site/index.html ] && [[ " ${TABLE[*]} " == *"passed   docs"* ]]; then
    export SOFTTWIN_SITE="$ROOT/build/site" # the tests of the site read this one
fi
group tests tests
group apart apart
group liver liver
group contract bash ci/no-fenicsx.sh contract "$LOGS/contract.xml"
if [ $ALL = 1 ] || [ ${#ASKED[@]} != 0 ]; then
    group slow slow
    group no-fenicsx bash ci/no-fenicsx.sh suites "$LOGS/no-fenicsx.xml"
    group dolfinx-0.11 bash ci/dolfinx011.sh "$LOGS/dolfinx-0.11.xml"
fi

[ ${#TABLE[@]} != 0 ] || fail "no such group: ${ASKED[*]}"
printf '\n== what ran\n'
printf '%s\n' "${TABLE[@]}"
python ci/tally.py --total "$LOGS"/*.xml
exit $FAILED
