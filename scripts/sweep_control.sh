#!/usr/bin/env bash
# The runs behind results/control, and their report. Finished runs are skipped, a run that was cut goes on.
#     bash scripts/sweep_control.sh --jobs 2 --only seed=0
set -euo pipefail
cd "$(dirname "$0")/.."

.venv/bin/vd4rl-pomdp sweep run control --out runs/control "$@"
.venv/bin/vd4rl-pomdp report runs/control --out runs/control-report
