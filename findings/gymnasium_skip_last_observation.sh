#!/usr/bin/env bash
# One would guess: when an episode ends within skipped frames, `MaxAndSkipObservation` returns the last frame.
# What happens: it fills its two buffers only at the last two of the `skip` inner steps. If the episode ends before
# them, it returns the observation of the decision before, as the final one, together with the new reward.
# For this field: the last transition of an episode shows no change. Where a time limit ends it, its value is
# bootstrapped from the wrong image, and an inverse model learns that the last action does nothing.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" - << 'PY'
import gymnasium
import numpy as np
from gymnasium.wrappers import MaxAndSkipObservation, TimeLimit

print("gymnasium", gymnasium.__version__)


class Clock(gymnasium.Env):
    """The image shows the number of steps taken."""

    observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def _image(self):
        return np.full((8, 8, 3), self.time, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self._image(), {}

    def step(self, action):
        self.time += 1
        return self._image(), 1.0, False, False, {}


ends = {}
for limit in (5, 6, 7, 8):
    env = MaxAndSkipObservation(TimeLimit(Clock(), limit), skip=4)
    env.reset()
    before = int(env.step(env.action_space.sample())[0].max())
    image, reward, _, truncated, _ = env.step(env.action_space.sample())
    assert truncated
    ends[limit] = int(image.max())
    print(f"time limit {limit}: image after one decision {before}, final image {ends[limit]}, reward {reward:.0f}")
assert ends == {5: 4, 6: 4, 7: 7, 8: 8}, "the last image is returned"
PY
