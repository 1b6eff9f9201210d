#!/usr/bin/env bash
# Ten thousand and more random calls of the public functions: bash scripts/fuzz.sh [examples a function, 400]
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" FUZZ_EXAMPLES="${1:-400}"
.venv/bin/python -m pytest -n 2 -q --timeout 3000 --hypothesis-show-statistics tests/test_fuzz.py
# every override of every setting by what it cannot be, and every option of every group
FUZZ_OVERRIDES=0 FUZZ_OPTIONS=0 .venv/bin/python -m pytest -n 2 -q --timeout 3000 tests/test_config_fuzz.py
