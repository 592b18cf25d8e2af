#!/usr/bin/env bash
# The runs of a grid, all its seeds, and their report. Finished runs are skipped, a run that was cut goes on.
#     bash tools/sweep.sh control --jobs 2 --only seed=0
# `vd4rl-pomdp sweep list` names the grids; for those of mazes `navigation report` makes the report.
set -euo pipefail
cd "$(dirname "$0")/.."
grid=${1:?name a grid}
shift

.venv/bin/vd4rl-pomdp sweep run "$grid" --out "runs/$grid" "$@"
.venv/bin/vd4rl-pomdp report "runs/$grid" --out "runs/$grid-report"
