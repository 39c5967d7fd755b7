#!/usr/bin/env bash
# A fresh clone of the last commit in a bare Debian of its own (debootstrap's smallest), and a command in it. By hand, as
# root: it is no part of ci/test.sh.
#
#   bash ci/bare_debian.sh 12 apt                          the README's test command, as anybody would run it there
#   bash ci/bare_debian.sh 12 apt bash ci/demo.sh
#   WITH='python3-matplotlib python3-pandas' bash ci/bare_debian.sh 12 apt     with these installed system-wide before
#   bash ci/bare_debian.sh 13 wheels bash ci/demo.sh --small
#
# `wheels` stands for any other Linux: FEniCSx from PyPI. TREE names the folder of the tree; one that is there is kept, so
# that a second run finds the system's packages, and everything in it but the clone. FRESH=1 makes it anew.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$ROOT"
RELEASE=${1:-} WAY=${2:-}
[[ "$RELEASE" =~ ^(12|13)$ ]] || fail "expected 12 or 13, got '$RELEASE'"
[[ "$WAY" =~ ^(apt|wheels)$ ]] || fail "expected apt or wheels, got '$WAY'"
shift 2
[ $# != 0 ] || set -- bash ci/test.sh
TREE=${TREE:-$ROOT/build/debian$RELEASE-$WAY}
[ "$(id -u)" = 0 ] || fail "a tree of Debian needs root: run as root"
command -v debootstrap >/dev/null || apt-get -q install -y --no-install-recommends debootstrap
WANTED=()
declare -A NAMES=([12]=bookworm [13]=trixie)

# What the way of wheels asks of a system at its door; by apt set-up brings all that it needs.
WHEELS=(python3-venv python3-dev gcc libc6-dev libgl1 libglu1-mesa libxrender1 libxcursor1 libxfixes3 libxft2 libxinerama1 libegl1)

inside() {
    chroot "$TREE" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
        https_proxy="${https_proxy:-}" http_proxy="${http_proxy:-}" PIP_CERT=/etc/ssl/certs/ca-certificates.crt \
        PIP_EXTRA_INDEX_URL="${PIP_EXTRA_INDEX_URL:-}" PIP_FIND_LINKS="${PIP_FIND_LINKS:-}" SOFTTWIN_SETUP="$WAY" "$@"
}
leave() {
    local folder
    for folder in "${BOUND[@]}"; do umount -l "$TREE$folder" 2>/dev/null || true; done
}

[ "${FRESH:-0}" = 0 ] || rm -rf "$TREE"
if [ ! -f "$TREE/.softtwin-stamp" ]; then
    say "making Debian $RELEASE in $TREE"
    mkdir -p "$TREE"
    debootstrap --variant=minbase --include=ca-certificates,git,make "${NAMES[$RELEASE]}" "$TREE" >/dev/null
    touch "$TREE/.softtwin-stamp"
fi
cp /etc/resolv.conf "$TREE/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$TREE/etc/ssl/certs/" # with what this machine trusts besides
printf '127.0.0.1 localhost %s\n' "$(hostname)" >"$TREE/etc/hosts" # debootstrap writes none, and torch's processes ask
BOUND=(/proc /dev /sys)
for folder in ${PIP_FIND_LINKS:-}; do # wheels that lie on this machine's disk
    [ -d "$folder" ] && BOUND+=("$folder")
done
trap leave EXIT
for folder in "${BOUND[@]}"; do
    mkdir -p "$TREE$folder"
    mount --bind "$folder" "$TREE$folder"
done
# shellcheck disable=SC2086
for wanted in ${WITH:-}; do WANTED+=("$wanted"); done
[ "$WAY" = apt ] || WANTED+=("${WHEELS[@]}")
if [ ${#WANTED[@]} != 0 ]; then
    inside apt-get -q update
    inside apt-get -q install -y --no-install-recommends "${WANTED[@]}"
fi

rm -rf "$TREE/src" && mkdir -p "$TREE/src"
git clone -q --no-hardlinks "$ROOT" "$TREE/src/softtwin"
if [ -d ../shared ]; then cp -r ../shared "$TREE/src/shared"; fi
began=$(date +%s)
status=0
inside bash -c 'cd /src/softtwin && exec "$@"' bash "$@" || status=$?
say "Debian $RELEASE by $WAY${WITH:+ with $WITH}: '$*' ended with $status after $(($(date +%s) - began)) s"
exit $status
