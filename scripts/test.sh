#!/usr/bin/env bash
# Lint, type-check, test; without arguments, measure the lines covered. Arguments go to pytest:
# bash scripts/test.sh -k retina
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
# One thread a worker: two workers with a thread pool each only fight for the cores.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" MKL_NUM_THREADS="${MKL_NUM_THREADS:-1}"

.venv/bin/ruff check .
.venv/bin/ruff format --check .
.venv/bin/mypy
# The floor is for the whole suite: arguments may leave out most of it.
if [ $# -eq 0 ]; then
    set -- --cov=torchfovea --cov-report=term:skip-covered --cov-fail-under=95
fi
.venv/bin/python -m pytest -n 2 "$@"
