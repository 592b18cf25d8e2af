#!/usr/bin/env bash
# One would guess: tianshou's buffer gives the stack that the agent sees next as `obs_next`, whether it stores next
# frames or saves the memory with `ignore_obs_next=True`.
# What happens: neither. With `stack_num=3` the stored next frames are stacked among themselves: after the first step of
# an episode `obs_next` is (1, 1, 1), but the agent sees (0, 0, 1), and after the second (1, 1, 2) instead of (0, 1, 2).
# With `ignore_obs_next=True` these are right, but at a time limit `obs_next` is `obs` itself.
# For this field: targets bootstrap from stacks that never occur, at each start, or from the wrong time, at each end.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" tianshou==2.0.1 gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import numpy as np
from tianshou.data import Batch, ReplayBuffer

print("tianshou", version("tianshou"))
seen = {}
for name, arguments in (("stored", {}), ("ignore_obs_next", {"ignore_obs_next": True})):
    buffer = ReplayBuffer(20, stack_num=3, **arguments)
    for t in range(4):  # the frame is its time; the last step is cut by a time limit
        step = Batch(obs=np.array(t), act=0, rew=1.0, terminated=False, truncated=t == 3, obs_next=np.array(t + 1))
        buffer.add(step)
    rows = buffer[np.arange(4)]
    seen[name] = rows.obs_next.tolist()
    print(f"{name:16} obs {rows.obs.tolist()}\n{'':16} next {seen[name]}")
right = [[0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]]
print(f"{'expected':16} next {right}")
assert seen["stored"] == [[1, 1, 1], [1, 1, 2], *right[2:]], "stored next frames are stacked otherwise"
assert seen["ignore_obs_next"] == [*right[:3], [1, 2, 3]], "the end is handled otherwise"
PY
