#!/usr/bin/env bash
# One would guess: after an episode ends, `auto_reset=True` starts the next one from a newly drawn initial state.
# What happens: Brax's wrapper keeps the first initial state of each environment and returns to it after every episode.
# Only another call of `reset` with another key draws again.
# For this field: a dataset or an evaluation of N episodes in each of B environments has B initial states, not N x B,
# and its intervals are too narrow. Call `reset` for each batch of episodes.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet brax==0.14.2 jax==0.10.2 mujoco==3.11.0 mujoco-mjx==3.11.0 flax==0.12.8 \
    numpy==2.4.6
JAX_PLATFORMS=cpu "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import jax
import numpy as np
from brax import envs

print("brax", version("brax"), "jax", jax.__version__)
env = envs.create("inverted_pendulum", episode_length=5, batch_size=3, auto_reset=True)
step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
starts = [np.asarray(state.obs)]
draw = np.random.default_rng(0)
for _ in range(4):
    for _ in range(5):
        state = step(state, draw.uniform(-0.1, 0.1, (3, env.action_size)))
    assert np.asarray(state.done).all()
    starts.append(np.asarray(state.obs))
distinct = len(np.unique(np.concatenate(starts), axis=0))
print(f"5 episodes in each of 3 environments: {distinct} distinct initial states")
print("angle at the start of each episode, first environment:", np.round([obs[0, 1] for obs in starts], 5).tolist())
assert distinct == 3, "initial states are drawn anew"
PY
