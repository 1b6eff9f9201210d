#!/usr/bin/env bash
# Thousands of damaged files, and runs killed, out of space and meeting in one folder; how many it says at the end:
# bash scripts/faults.sh [how often each, 20]
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" FAULTS="${1:-20}"
.venv/bin/python -m pytest -q --timeout 3000 tests/faults
