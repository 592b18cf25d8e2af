#!/usr/bin/env bash
# One would guess: the first stack of an episode holds nothing of the episode before.
# What happens: `FrameStackingWrapper` empties its stack in `reset` only. By dm_env's rules a `step` after the last one
# begins the next episode, and loops of dm_env programs use that: then the first stacks hold frames of the old episode.
# For this field: the start of an episode shows how the one before ended, and a policy that sees zeros there in an
# evaluation with `reset` sees old frames in training. Call `reset` after each last step.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet dm-env-wrappers==0.0.13 dm-env==1.6 dm-tree==0.1.10 dm-control==1.0.44 \
    mujoco==3.11.0 numpy==2.4.6
MUJOCO_GL=disabled "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import numpy as np
from dm_control import suite
from dm_env_wrappers import FrameStackingWrapper

print("dm-env-wrappers", version("dm-env-wrappers"), "dm-control", version("dm-control"))
task = suite.load("point_mass", "easy", task_kwargs={"random": 0, "time_limit": 0.1})
env = FrameStackingWrapper(task, num_frames=3)
action = np.ones(2)
last = env.reset()
while not last.last():
    last = env.step(action)
first = env.step(action)  # begins an episode
assert first.first()
old, new = (one.observation["position"][0].round(4).tolist() for one in (last, first))
print("x in the last stack:", old)
print("x in the next episode's first stack, after step: ", new)
again = env.reset().observation["position"][0].round(4).tolist()
print("x in the first stack of another episode, after reset:", again)
assert new[:2] == old[1:] and new[2] != old[2], "the stack begins anew"
assert again[:2] == [0, 0], "reset keeps frames"
PY
