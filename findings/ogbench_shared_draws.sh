#!/usr/bin/env bash
# One would guess: `env.reset(seed=0)` of a Gymnasium environment determines the episode, and the environments of an
# AsyncVectorEnv play different ones.
# What happens: OGBench draws task, start and goal from numpy's global state, whatever the seed. Three resets with one
# seed give three episodes. AsyncVectorEnv's processes are forks with the same global state, so all of them play the
# same episode, although each got another seed.
# For this field: success rates do not repeat, and a mean over eight parallel environments is a mean over one. Call
# `np.random.seed` before each reset, in the process that plays.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet ogbench==1.2.2 gymnasium==1.4.0 mujoco==3.11.0 dm-control==1.0.44 numpy==2.4.6
MUJOCO_GL=disabled "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
import ogbench  # noqa: F401, registers the environments

print("ogbench", version("ogbench"), "gymnasium", gymnasium.__version__)


def make():
    return gymnasium.make("pointmaze-medium-v0")


env = make()
again = np.stack([env.reset(seed=0)[0] for _ in range(3)])
print("one environment, seed 0 three times, start:", again.round(2).tolist())
found = []
for _ in range(2):
    np.random.seed(0)
    found.append(env.reset(seed=0)[0])
print("numpy's global seed 0 twice:", np.round(found, 2).tolist())
forked = gymnasium.vector.AsyncVectorEnv([make] * 4, context="fork")
starts, infos = forked.reset(seed=[10, 20, 30, 40])
forked.close()
print("four processes, seeds 10, 20, 30, 40, start:", starts.round(2).tolist())
print("goal:", infos["goal"].round(2).tolist())
assert np.ptp(again, axis=0).max() > 0.1, "the seed determines the episode"
assert np.array_equal(*found), "numpy's global state does not determine the episode"
assert np.ptp(starts, axis=0).max() == 0 and np.ptp(infos["goal"], axis=0).max() == 0, "the processes differ"
PY
