#!/usr/bin/env bash
# All set-up, then checks and tests. All groups run; one line each at the end says what ran, and the exit code is 1
# when any failed.
#
#   bash ci/test.sh          what CI runs, at most a quarter of an hour on two cores
#   bash ci/test.sh --all    what one runs before a release: also tests marked slow, the suites of meshes, surrogate and
#                            registration without FEniCSx, and those of the reference on a second DOLFINx
#   bash ci/test.sh GROUP... some groups alone: format lint layers docs tests liver ranks browser types contract, and of
#                            --all slow slow-apart no-fenicsx dolfinx-0.11
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
unset PYTHONDONTWRITEBYTECODE # images set it: each of the many programs that tests start would compile torch anew
export OMP_NUM_THREADS=1 # torch's networks here are small: on cores that others use, its threads wait for each other
export PATH="$VENV/bin:$PATH" PYTHONUNBUFFERED=1 # unbuffered, or a test that forks prints the lines before it twice
LOGS="$ROOT/build/ci"
rm -rf "$LOGS" && mkdir -p "$LOGS"
SKIPPED=77
ALL=0
if [ "${1:-}" = --all ]; then
    ALL=1
    shift
fi
ASKED=("$@")
NAMES=()
WORKERS=${SOFTTWIN_TEST_WORKERS:-2}

asked() { [ ${#ASKED[@]} = 0 ] || [[ " ${ASKED[*]} " == *" $1 "* ]]; }

# outcome NAME STATUS: writes down how a group ended, with the last line it printed; 77 means skipped.
outcome() {
    local word
    case $2 in
        0) word=passed ;;
        "$SKIPPED") word=skipped ;;
        *) word=FAILED ;;
    esac
    printf '%-8s %-14s %s\n' "$word" "$1" "$(grep -v '^\s*$' "$LOGS/$1.log" | tail -n 1)" >"$LOGS/$1.outcome"
}

# begin NAME: a group that is begun and says no more has failed.
begin() {
    NAMES+=("$1")
    printf '%-8s %-14s %s\n' FAILED "$1" "it did not end" >"$LOGS/$1.outcome"
}

# group NAME COMMAND...: runs the command.
group() {
    local name=$1
    shift
    asked "$name" || return 0
    begin "$name"
    printf '\n== %s\n' "$name"
    "$@" 2>&1 | tee "$LOGS/$name.log"
    outcome "$name" "${PIPESTATUS[0]}"
}

# lane NAME...: those that are asked for, one after the other, beside the groups that follow until `join`.
lane() {
    local name
    BESIDE=()
    for name in "$@"; do
        if asked "$name"; then
            begin "$name"
            BESIDE+=("$name")
        fi
    done
    set -m # a process group of its own, that an interrupt ends whole
    for name in "${BESIDE[@]}"; do
        "$name" >"$LOGS/$name.log" 2>&1
        outcome "$name" $?
    done &
    LANE=$!
    set +m
    trap 'kill -- -"$LANE" 2>/dev/null' EXIT
}

# join: waits for the groups of the lane and shows what they said.
join() {
    local name
    wait "$LANE"
    trap - EXIT
    for name in "${BESIDE[@]}"; do
        printf '\n== %s\n' "$name"
        cat "$LOGS/$name.log"
    done
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
tests() {
    local apart="mpi or browser or slow"
    # The group contract runs these in an environment that has no FEniCSx, for this Python alone.
    "$SYSTEM_PYTHON" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' && apart+=" or contract"
    run_tests tests "${parallel[@]}" -m "not ($apart)" tests
}
# marked NAME: the files with such tests. Only these are imported: all of them take a quarter of a minute.
marked() { grep -rl --include='*.py' "mark\.$1\b" tests; }
# One after the other: each starts ranks for both cores, or a browser.
ranks() { run_tests ranks -m "mpi and not slow" $(marked mpi); }
browser() { run_tests browser -m "browser and not slow" $(marked browser); }
contract() { bash ci/no-fenicsx.sh contract "$LOGS/contract.xml"; }
slow() { run_tests slow "${parallel[@]}" -m "slow and not mpi and not browser" tests; }
slow_apart() { run_tests slow-apart -m "slow and (mpi or browser)" tests; }

group format format
group lint lint
group layers layers
group docs docs
if [ -f build/site/index.html ] && grep -qs ^passed "$LOGS/docs.outcome"; then
    export SOFTTWIN_SITE="$ROOT/build/site" # the tests of the site read this one
fi
lane types contract browser # they wait for the disk, a page or one another, and fill what the tests leave of two cores
group tests tests
join
if [ ! -d ../shared/data/liver ]; then
    asked liver && NAMES+=(liver)
    echo "skipped: the real liver is not there (../shared/data/liver, seen from the repository's root)" >"$LOGS/liver.log"
    outcome liver $SKIPPED
elif [ ${#ASKED[@]} != 0 ]; then # else among the tests
    group liver run_tests liver "${parallel[@]}" -m "liver and not slow" tests
fi
group ranks ranks
if [ $ALL = 1 ] || [ ${#ASKED[@]} != 0 ]; then
    group slow slow
    group slow-apart slow_apart
    group no-fenicsx bash ci/no-fenicsx.sh suites "$LOGS/no-fenicsx.xml"
    group dolfinx-0.11 bash ci/dolfinx011.sh "$LOGS/dolfinx-0.11.xml"
fi

[ ${#NAMES[@]} != 0 ] || fail "no such group: ${ASKED[*]}"
printf '\n== what ran\n'
for name in "${NAMES[@]}"; do cat "$LOGS/$name.outcome"; done
python ci/tally.py --total "$LOGS"/*.xml
! grep -qs ^FAILED "$LOGS"/*.outcome
