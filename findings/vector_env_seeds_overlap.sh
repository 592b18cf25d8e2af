#!/usr/bin/env bash
# One would guess: vectorised environments seeded with 0, 1, 2, ... are independent samples.
# What happens: environment i gets seed + i, in Gymnasium's `reset(seed=...)` as in stable-baselines3's `make_vec_env`
# and `VecEnv.seed`. With eight environments the seeds 0 and 1 share seven initial states, and five "seeds" of one
# method start from 12 states instead of 40.
# For this field: evaluations under neighbouring seeds are correlated, so intervals over seeds are too narrow. Space the
# seeds by at least the number of environments, or pass a list.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" stable-baselines3==2.9.2 gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
from stable_baselines3.common.env_util import make_vec_env

print("gymnasium", gymnasium.__version__, "stable-baselines3", version("stable-baselines3"))
starts = {"gymnasium": [], "stable-baselines3": []}
for seed in range(5):
    starts["gymnasium"].append(gymnasium.make_vec("Pendulum-v1", num_envs=8).reset(seed=seed)[0])
    starts["stable-baselines3"].append(make_vec_env("Pendulum-v1", 8, seed=seed).reset())
for name, found in starts.items():
    distinct = len(np.unique(np.concatenate(found), axis=0))
    shared = np.array_equal(found[0][1:], found[1][:-1])
    print(f"{name}: 5 seeds x 8 environments have {distinct} distinct initial states; 0 and 1 share seven: {shared}")
    assert distinct == 12 and shared, "seeds do not overlap"
PY
