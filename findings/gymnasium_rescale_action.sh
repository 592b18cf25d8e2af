#!/usr/bin/env bash
# One would guess: gymnasium's RescaleAction maps its own extremes to the environment's, so actions stay within bounds.
# What happens: it computes (action - intercept) / gradient, and rounding puts one extreme in six just outside, in
# float32 and in float64 alike: 1.3700001 for a bound of 1.37.
# For this field: an environment that asserts `action_space.contains(action)`, as several do, fails only once a policy
# saturates, thousands of steps into an evaluation. Clip after rescaling.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import gymnasium
import numpy as np
from gymnasium.wrappers import RescaleAction

print("gymnasium", gymnasium.__version__, "numpy", np.__version__)


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self, low, high, dtype):
        self.action_space = gymnasium.spaces.Box(np.array([low], dtype), np.array([high], dtype), dtype=dtype)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.got = action
        return np.zeros(1, np.float32), 0.0, False, False, {}


for dtype in (np.float32, np.float64):
    draw, outside, tried, example = np.random.default_rng(0), 0, 0, None
    for _ in range(500):
        low, high = np.sort(np.round(draw.uniform(-5, 5, 2), 2))
        if low == high:
            continue
        env = Env(low, high, dtype)
        rescaled = RescaleAction(env, dtype(-1), dtype(1))
        rescaled.reset()
        for extreme in (-1, 1):
            rescaled.step(np.full(1, extreme, dtype))
            tried += 1
            if not env.action_space.contains(env.got):
                outside += 1
                example = example or f"{env.got[0]!r} in [{low}, {high}]"
    print(f"{dtype.__name__}: {outside} of {tried} extremes land outside, such as {example}")
    assert outside > tried / 20, "extremes stay within the bounds"
PY
