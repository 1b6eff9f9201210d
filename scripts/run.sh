#!/usr/bin/env bash
# The main job, a visual search. Arguments are settings: bash scripts/run.sh scene=cans seed=1
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec .venv/bin/torchfovea search "$@"
