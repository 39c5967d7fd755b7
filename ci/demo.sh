#!/usr/bin/env bash
# All set-up, then the main job on a liver phantom; arguments go to `softtwin quickstart`.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
bash "$ROOT/ci/setup.sh"
export PATH="$VENV/bin:$PATH"
say "softtwin quickstart $*"
exec softtwin quickstart "$@"
