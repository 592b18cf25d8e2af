#!/usr/bin/env bash
# One would guess: `frame_skip=4` of EnvPool's dm_control tasks is the usual action repeat: the rewards of the four
# steps are summed, and an episode of 1000 steps takes 250 actions.
# What happens: the states are those of four steps, but the reward is the last step's alone (0.0195 of 0.0501), and an
# episode takes 1000 actions, 4000 steps. Nothing is said; returns still seem to be on the usual scale up to 1000.
# For this field: DrQ-v2 and V-D4RL repeat actions twice. The same policy gets another return here, over a longer
# horizon, and a reward that lies between two actions is never seen. Repeat the action outside.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet envpool==1.2.5 gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
import envpool
import numpy as np

print("envpool", envpool.__version__)
one = envpool.make_dm("CheetahRun-v1", num_envs=1, seed=0)
four = envpool.make_dm("CheetahRun-v1", num_envs=1, seed=0, frame_skip=4)
step, skip = one.reset(), four.reset()
draw = np.random.default_rng(0)
for _ in range(5):
    action = draw.uniform(-1, 1, (1, 6))
    rewards = []
    for _ in range(4):
        step = one.step(action)
        rewards.append(step.reward.item())
    skip = four.step(action)
    assert np.array_equal(step.observation.position, skip.observation.position), "the states differ"
    print(f"four steps: {np.round(rewards, 4)}, sum {sum(rewards):.4f}; frame_skip=4: {skip.reward.item():.4f}")
    assert skip.reward.item() == rewards[-1], "rewards are not the last step's"
assert sum(rewards) > 2 * rewards[-1], "too small to tell"
count = 5
while not skip.last():
    skip = four.step(action)
    count += 1
print(f"an episode with frame_skip=4 has {count} actions")
assert count == 1000, "the episode is shorter"
PY
