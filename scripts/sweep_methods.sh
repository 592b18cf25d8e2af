#!/usr/bin/env bash
# The runs behind results/methods, and their report. Finished runs are skipped, a run that was cut goes on.
#     bash scripts/sweep_methods.sh --jobs 2 --only corruption=none
set -euo pipefail
cd "$(dirname "$0")/.."

.venv/bin/vd4rl-pomdp sweep run methods --out runs/methods "$@"
.venv/bin/vd4rl-pomdp report runs/methods --out runs/methods-report
