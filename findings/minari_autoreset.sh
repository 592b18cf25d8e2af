#!/usr/bin/env bash
# One would guess: an episode in a Minari set begins where the environment was reset.
# What happens: under Gymnasium's `Autoreset` the step behind an episode's end resets the environment. Minari's collector
# has begun the next episode by then, with the last observation of the one before: each episode but the first begins
# with a step from an end to a start, with reward 0 and an action that did nothing. Nothing is raised.
# For this field: inverse models train on a jump between episodes, once in each. Reset the collector yourself.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "minari[hdf5,create]==0.5.4" \
    gymnasium==1.4.0 numpy==2.4.6 h5py==3.16.0 pillow==13.0.0
"$tmp/venv/bin/python" -W ignore - "$tmp" << 'PY'
import os
import sys

os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import gymnasium
import minari
import numpy as np

print("minari", minari.__version__, "gymnasium", gymnasium.__version__)


class Env(gymnasium.Env):
    """Observes 100 times the episode, and the step."""

    observation_space = gymnasium.spaces.Box(0, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    episode = -1

    def reset(self, *, seed=None, options=None):
        self.episode, self.t = self.episode + 1, 0
        return np.array([100.0 * self.episode]), {}

    def step(self, action):
        self.t += 1
        return np.array([100.0 * self.episode + self.t]), 1.0, False, self.t == 3, {}


collector = minari.DataCollector(gymnasium.wrappers.Autoreset(Env()))
collector.reset(seed=0)
for _ in range(7):
    collector.step(np.zeros(1, np.float32))
collector.create_dataset("auto-v0")
episodes = [(one.observations.ravel().tolist(), one.rewards.tolist()) for one in minari.load_dataset("auto-v0")]
for observations, rewards in episodes:
    print("observations", observations, "rewards", rewards)
assert episodes[0][0] == [0, 1, 2, 3] and episodes[1] == ([3, 100, 101, 102, 103], [0, 1, 1, 1]), "episodes stay apart"
PY
