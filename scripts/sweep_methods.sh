#!/usr/bin/env bash
# Every method at one CPU-sized budget on walker_walk expert: the runs behind results/methods. Finished runs are skipped, a
# run that was cut goes on.    bash scripts/sweep_methods.sh "none patch+zero_frames" "0 1 2"
set -euo pipefail
cd "$(dirname "$0")/.."

read -ra corruptions <<<"${1:-none patch+zero_frames}"
read -ra seeds <<<"${2:-0}"
export MUJOCO_GL="${MUJOCO_GL:-egl}" LP_NUM_THREADS="${LP_NUM_THREADS:-1}" OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"

run=.venv/bin/vd4rl-pomdp
data=runs/evidence/data/walker_walk/expert
frozen=(mik+a acro random ah+a no_history mik state ah fj+a one_step_inverse curl homer driml fj)
sweep=(sweep --data "$data" --out runs/methods --preset cpu --corruptions "${corruptions[@]}" --seeds "${seeds[@]}")
evaluation="--eval-episodes 5 --workers 1"

if [ ! -f "$data/provenance.json" ]; then
    $run data collect --task walker_walk --quality expert --out "$data" --episodes 50 --episodes-per-shard 10
fi
$run "${sweep[@]}" --methods "${frozen[@]}" --pretrain="--steps 1000" --finetune="--updates 10000 --views 1 $evaluation"
$run "${sweep[@]}" --methods bc drq_bc --finetune="--updates 1000 $evaluation"
$run report runs/methods --out runs/methods-report
cp runs/methods-report/{runs,episodes,summary}.csv results/methods/
