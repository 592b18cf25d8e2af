#!/usr/bin/env bash
# One would guess: a collector of data copies each observation when it is recorded.
# What happens: Minari's keeps the array itself until the episode ends. An environment that draws into one buffer and
# returns it (simulators do) gives a data set in which every row is the episode's last picture; nothing
# is raised.
# For this field: the set has the right shapes, actions and returns, and no visual information. Return copies.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "minari[hdf5,create]==0.5.4" \
    gymnasium==1.4.0 numpy==2.4.6 h5py==3.16.0 pillow==13.0.0
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import sys

os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import gymnasium
import minari
import numpy as np

print("minari", minari.__version__, "gymnasium", gymnasium.__version__)


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (3, 8, 8), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, copy):
        self.screen, self.copy = np.zeros((3, 8, 8), np.uint8), copy

    def reset(self, *, seed=None, options=None):
        self.screen[:] = 0
        return self.picture(), {}

    def picture(self):
        return self.screen.copy() if self.copy else self.screen

    def step(self, action):
        self.screen += 1
        return self.picture(), 0.0, False, bool(self.screen[0, 0, 0] == 4), {}


rows = {}
for copy in (True, False):
    collector = minari.DataCollector(Env(copy))
    collector.reset(seed=0)
    while not collector.step(np.zeros(2, np.float32))[3]:
        pass
    author = {"author": "a", "author_email": "a@example.org", "code_permalink": "none", "algorithm_name": "none"}
    collector.create_dataset(f"copy{copy}-v0", **author)
    episode = next(iter(minari.load_dataset(f"copy{copy}-v0").iterate_episodes()))
    rows[copy] = np.asarray(episode.observations)[:, 0, 0, 0].tolist()
    print("environment returns", "copies:" if copy else "its buffer:", rows[copy])
assert rows[True] == [0, 1, 2, 3, 4] and rows[False] == [4] * 5, "observations are copied"
PY
