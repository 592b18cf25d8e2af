#!/usr/bin/env bash
# One would guess: cpprb's n-step buffer shortens the last returns of an episode and pairs them with its last
# observation.
# What happens: `on_episode_end` shortens the returns, but the last n - 1 rows get a next observation of ones, which no
# episode holds. Their `done` is 0 if a time limit ended the episode.
# For this field: dm_control's episodes all end by time limit, so at the end of each one critics bootstrap from the
# value of an observation that does not exist. Drop the last n - 1 rows.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -c "import sys; sys.exit(sys.version_info >= (3, 13))" || { echo "needs Python 3.11 or 3.12" >&2; exit 77; }
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet cpprb==11.0.0 numpy==2.4.6
"$tmp/venv/bin/python" - << 'PY'
from importlib.metadata import version
from itertools import pairwise

import numpy as np
from cpprb import ReplayBuffer

print("cpprb", version("cpprb"), "numpy", np.__version__)
LENGTH, STEPS, EPISODES = 6, 3, 2
fields = {"obs": {"shape": (2,)}, "act": {}, "rew": {}, "next_obs": {"shape": (2,)}, "done": {}}
buffer = ReplayBuffer(100, fields, Nstep={"size": STEPS, "gamma": 0.5, "rew": "rew", "next": "next_obs"})
for episode in range(1, EPISODES + 1):
    frames = [np.array([episode, step]) for step in range(10, 11 + LENGTH)]
    for now, later in pairwise(frames):
        buffer.add(obs=now, act=0, rew=1, next_obs=later, done=0)  # a time limit ends the episode
    buffer.on_episode_end()
rows = buffer.get_all_transitions()
wrong = 0
for now, reward, later, done in zip(rows["obs"], rows["rew"], rows["next_obs"], rows["done"]):
    right = [float(now[0]), min(float(now[1]) + STEPS, 10.0 + LENGTH)]
    mistaken = later.tolist() != right
    wrong += mistaken
    print(f"obs {now.tolist()} reward {reward[0]} done {done[0]} next {later.tolist()}", f"not {right}" * mistaken)
assert wrong == EPISODES * (STEPS - 1), "next observations are right"
PY
