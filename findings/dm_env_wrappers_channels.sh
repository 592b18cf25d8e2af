#!/usr/bin/env bash
# One would guess: a stack of three RGB frames in nine channels holds one frame behind the other, so that `[..., -3:]`
# is the newest, as in DrQ-v2 and stable-baselines3.
# What happens: `FrameStackingWrapper(flatten=True)` stacks along a new last axis and merges it into the channels: three
# times red, three times green, three times blue. `[..., -3:]` is the blue of all three frames (13, 23, 33 in the run).
# For this field: a display shows grey ghosts, a frozen encoder that gets the stack as three images sees time as colour,
# and weights trained on the other order load without an error. Reshape the unflattened stack yourself.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet dm-env-wrappers==0.0.13 dm-env==1.6 dm-tree==0.1.10 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import dm_env
import numpy as np
from dm_env import specs
from dm_env_wrappers import FrameStackingWrapper

print("dm-env-wrappers", version("dm-env-wrappers"))


class Env(dm_env.Environment):
    """Frame t has the colours 10 t + 1 (red), 10 t + 2 (green) and 10 t + 3 (blue)."""

    def frame(self):
        return np.full((4, 4, 3), 10 * self.t + np.array([1, 2, 3]), np.uint8)

    def reset(self):
        self.t = 1
        return dm_env.restart(self.frame())

    def step(self, action):
        self.t += 1
        return dm_env.transition(0.0, self.frame())

    def observation_spec(self):
        return specs.BoundedArray((4, 4, 3), np.uint8, 0, 255)

    def action_spec(self):
        return specs.BoundedArray((1,), np.float32, -1, 1)


env = FrameStackingWrapper(Env(), num_frames=3, flatten=True)
env.reset()
env.step(0)
stack = env.step(0).observation
print("shape", stack.shape, "one pixel:", stack[0, 0].tolist(), "last three channels:", stack[0, 0, -3:].tolist())
assert stack[0, 0].tolist() == [11, 21, 31, 12, 22, 32, 13, 23, 33], "frames lie one behind the other"
PY
