#!/usr/bin/env bash
# Set-up, the small demo and the reference's tests in a bare Debian 13 of its own, made by debootstrap: Python 3.13, and
# FEniCSx by apt (DOLFINx 0.9, Open MPI 5) or by wheels alone (0.11, MPICH), which stands for any other Linux. By hand,
# as root: it is no part of ci/test.sh. Arguments: apt or wheels, and the folder of the tree (kept for the next time).
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
WAY=${1:-}
[[ "$WAY" =~ ^(apt|wheels)$ ]] || fail "expected apt or wheels, got '$WAY'"
TREE=${2:-$ROOT/build/debian13-$WAY}
[ "$(id -u)" = 0 ] || fail "a tree of Debian 13 needs root: run as root"
command -v debootstrap >/dev/null || apt-get -q install -y --no-install-recommends debootstrap

# What the way of wheels asks of a system at its door; by apt set-up brings all that it needs.
WANTED=(python3-venv python3-dev gcc libc6-dev libgl1 libglu1-mesa libxrender1 libxcursor1 libxfixes3 libxft2 libxinerama1 libegl1)

inside() {
    chroot "$TREE" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
        https_proxy="${https_proxy:-}" http_proxy="${http_proxy:-}" PIP_CERT=/etc/ssl/certs/ca-certificates.crt \
        PIP_EXTRA_INDEX_URL="${PIP_EXTRA_INDEX_URL:-}" SOFTTWIN_SETUP="$WAY" \
        OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 OPENBLAS_NUM_THREADS=1 "$@"
}
leave() { umount -l "$TREE/proc" "$TREE/dev" "$TREE/sys" 2>/dev/null || true; }

if [ ! -f "$TREE/.softtwin-stamp" ]; then
    say "making Debian 13 in $TREE"
    mkdir -p "$TREE"
    debootstrap --variant=minbase --include=ca-certificates trixie "$TREE" >/dev/null
    touch "$TREE/.softtwin-stamp"
fi
cp /etc/resolv.conf "$TREE/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$TREE/etc/ssl/certs/" # with what this machine trusts besides
trap leave EXIT
for folder in proc dev sys; do mount --bind "/$folder" "$TREE/$folder"; done
if [ "$WAY" = wheels ]; then
    inside apt-get -q update
    inside apt-get -q install -y --no-install-recommends "${WANTED[@]}"
fi

mkdir -p "$TREE/softtwin" # its .venv stays
find "$TREE/softtwin" -mindepth 1 -maxdepth 1 ! -name .venv -exec rm -rf {} +
tar -c --exclude='./.*' --exclude=./build . | tar -x -C "$TREE/softtwin"
inside bash -euc '
    cd /softtwin
    rm -rf softtwin-quickstart
    bash ci/demo.sh --small
    export PATH=/softtwin/.venv/bin:$PATH
    softtwin doctor
    pytest -q -m "not liver" tests/reference
'
