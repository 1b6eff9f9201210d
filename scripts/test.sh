#!/usr/bin/env bash
# Lint, type-check, test. Arguments go to pytest: bash scripts/test.sh -k retina
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
# One thread a worker: two workers with a thread pool each only fight for the cores.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" MKL_NUM_THREADS="${MKL_NUM_THREADS:-1}"

.venv/bin/ruff check .
.venv/bin/ruff format --check .
.venv/bin/mypy
.venv/bin/python -m pytest -n 2 "$@"
