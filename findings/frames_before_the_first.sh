#!/usr/bin/env bash
# One would guess: wrappers that stack frames agree on what stands before the first frame of an episode.
# What happens: stable-baselines3's VecFrameStack fills with zeros, Gymnasium's FrameStackObservation repeats the first
# frame (as DrQ and V-D4RL do) and adds an axis, where SB3 joins channels.
# For this field: a policy trained with one and played with the other sees pictures at each reset that it never saw.
# Where zeros also mean "hidden" (corrupted frames), SB3's start of an episode looks like a corruption.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" stable-baselines3==2.9.2 gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
from gymnasium.wrappers import FrameStackObservation
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

print("stable-baselines3", version("stable-baselines3"), "gymnasium", gymnasium.__version__)


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (3, 8, 8), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        return np.full((3, 8, 8), 50, np.uint8), {}


sb3 = VecFrameStack(DummyVecEnv([Env]), 3).reset()[0]
own, _ = FrameStackObservation(Env(), 3).reset()
print("stable-baselines3:", sb3.shape, "oldest to newest", sb3[::3, 0, 0].tolist())
print("gymnasium:        ", own.shape, "oldest to newest", own[:, 0, 0, 0].tolist())
assert sb3.shape == (9, 8, 8) and sb3[::3, 0, 0].tolist() == [0, 0, 50], "SB3 fills otherwise"
assert own.shape == (3, 3, 8, 8) and own[:, 0, 0, 0].tolist() == [50, 50, 50], "gymnasium fills otherwise"
PY
