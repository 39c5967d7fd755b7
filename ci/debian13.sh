#!/usr/bin/env bash
# The reference's tests on Debian 13's DOLFINx 0.9, Open MPI 5 and Python 3.13, in a tree of its own made by
# debootstrap. By hand, as root: it is no part of ci/test.sh. Argument: the folder of the tree (kept for the next time).
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
TREE=${1:-$ROOT/build/debian13}
[ "$(id -u)" = 0 ] || fail "a tree of Debian 13 needs root: run as root"
command -v debootstrap >/dev/null || apt-get -q install -y --no-install-recommends debootstrap

inside() {
    chroot "$TREE" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
        https_proxy="${https_proxy:-}" http_proxy="${http_proxy:-}" OPENBLAS_NUM_THREADS=1 "$@"
}
leave() { umount -l "$TREE/proc" "$TREE/dev" 2>/dev/null || true; }

if [ ! -f "$TREE/.softtwin-stamp" ]; then
    say "making Debian 13 in $TREE"
    mkdir -p "$TREE"
    debootstrap --variant=minbase --include=ca-certificates trixie "$TREE" >/dev/null
    inside apt-get -q update
    inside apt-get -q install -y --no-install-recommends python3-dolfinx-real python3-petsc4py-real \
        python3-slepc4py-real libopenblas0-pthread openmpi-bin gcc libc6-dev libpython3-dev python3-cffi python3-venv \
        libgl1 libglu1-mesa libxrender1 libxcursor1 libxft2 libxinerama1
    touch "$TREE/.softtwin-stamp"
fi
cp /etc/resolv.conf "$TREE/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$TREE/etc/ssl/certs/" # with what this machine trusts besides
trap leave EXIT
mount --bind /proc "$TREE/proc"
mount --bind /dev "$TREE/dev"

rm -rf "$TREE/softtwin" && mkdir "$TREE/softtwin"
tar -c --exclude='./.*' --exclude=./build . | tar -x -C "$TREE/softtwin"
inside bash -euc '
    cd /softtwin
    [ -d /venv ] || python3 -m venv --system-site-packages /venv
    PIP_CERT=/etc/ssl/certs/ca-certificates.crt /venv/bin/python -m pip install -q --editable ".[mesh,app,test]"
    export PATH=/venv/bin:$PATH
    python -c "import dolfinx; print(\"DOLFINx\", dolfinx.__version__)"
    pytest -q -m "not liver" tests/reference
'
