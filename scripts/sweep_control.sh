#!/usr/bin/env bash
# The cells of results/control: does memory pay when pixels are hidden? Finished runs are skipped, a run that was cut goes on.
#     bash scripts/sweep_control.sh "walker_walk cheetah_run" "0 1 2"
set -euo pipefail
cd "$(dirname "$0")/.."

read -ra tasks <<<"${1:-walker_walk cheetah_run}"
read -ra seeds <<<"${2:-0 1 2}"
export MUJOCO_GL="${MUJOCO_GL:-egl}" LP_NUM_THREADS="${LP_NUM_THREADS:-1}" OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"

run=.venv/bin/vd4rl-pomdp
finetune="--updates 20000 --update-precision bf16 --eval-every 20000 --eval-episodes 20"
hidden=(--corruptions patch+zero_frames --seeds "${seeds[@]}")
clean=(--corruptions none --seeds "${seeds[@]}")

for task in "${tasks[@]}"; do
    data=runs/evidence/data/$task/expert_noisy out=runs/control/$task
    if [ ! -f "$data/provenance.json" ]; then
        $run data collect --task "$task" --quality expert_noisy --out "$data" --episodes 100 --episodes-per-shard 10
    fi
    sweep() { $run sweep --data "$data" --preset cpu --out "$out/$1" "${@:2}"; }
    sweep cells "${clean[@]}" --methods state acro mik+a mik --finetune="$finetune"
    sweep cells "${hidden[@]}" --methods mik+a acro random mik supervised+a supervised ah+a --finetune="$finetune"
    sweep gru "${hidden[@]}" --methods acro random --pretrain="--history gru" --finetune="$finetune"
    sweep random_histories "${hidden[@]}" --methods mik+a --finetune="$finetune --random-histories 0.5"
    sweep frame "${hidden[@]}" --methods mik+a --finetune="$finetune --readout frame"
    sweep both "${hidden[@]}" --methods mik+a --finetune="$finetune --readout frame+state"
done
$run report runs/control --out runs/control-report
