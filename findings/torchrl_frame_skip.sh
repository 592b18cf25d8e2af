#!/usr/bin/env bash
# One would guess: torchrl's `FrameSkipTransform(3)` repeats an action three times, or until the episode ends, like the
# argument `frame_skip=3` of its environments.
# What happens: the transform goes on after the end and reports only the last repetition's `done`. dm_control restarts
# when stepped after its last step, so an episode of 1000 steps seems not to end: the rollout runs on through the
# restart to 667 actions, two episodes in one, until 3 x 667 = 1000 + 1 + 1000. With `frame_skip=3` it has 334.
# For this field: action repeats of 2, 4 and 8 divide 1000 and hide it; others, other time limits, and tasks that end
# early give returns of several episodes and transitions across a restart that are marked as ordinary.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" torchrl==0.14.1 dm-control==1.0.44 mujoco==3.11.0 numpy==2.4.6
MUJOCO_GL=disabled "$tmp/venv/bin/python" -W ignore - 2> "$tmp/log" << 'PY' || { cat "$tmp/log"; exit 1; }
from importlib.metadata import version

import torch
from torchrl.envs import DMControlEnv, FrameSkipTransform, TransformedEnv

print("torchrl", version("torchrl"), "dm-control", version("dm-control"))
torch.manual_seed(0)
actions, restarts = {}, {}
for repeat in (2, 3, 4):
    for way in ("argument", "transform"):
        if way == "argument":
            env = base = DMControlEnv("cheetah", "run", frame_skip=repeat)
        else:
            base = DMControlEnv("cheetah", "run")
            env = TransformedEnv(base, FrameSkipTransform(repeat))
        clock = []  # simulated time after each action
        rollout = env.rollout(2000, callback=lambda *_, base=base, clock=clock: clock.append(base._env.physics.time()))
        actions[way, repeat] = len(rollout)
        restarts[way, repeat] = sum(late < early for early, late in zip(clock, clock[1:], strict=False))
        print(f"{way} {repeat}: episode of {len(rollout)} actions, of which {restarts[way, repeat]} crossed a restart")
assert all(actions[way, repeat] == 1000 // repeat for way in ("argument", "transform") for repeat in (2, 4))
assert actions["argument", 3] == 334 and restarts["argument", 3] == 0, "the argument differs"
assert actions["transform", 3] == 667 and restarts["transform", 3] == 1, "the transform stops at the end"
PY
