"""A Gymnasium environment whose pictures, rewards and end are known."""

import gymnasium
import numpy as np


class Counter(gymnasium.Env):
    """Shows the number of steps as a grey level; rewards are 1, 2, 3, ... or `pays`; `end` is the last step."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self, shape=(20, 30), end=1000, truncates=False, low=-1.0, high=1.0, render_mode=None, space=None, pays=()
    ):
        self.shape, self.end, self.truncates, self.render_mode, self.pays = shape, end, truncates, render_mode, pays
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = space or gymnasium.spaces.Box(low, high, (2, 1), np.float64)
        self.actions = []

    def picture(self):
        return np.full(self.shape, self.steps, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.picture(), {}

    def step(self, action):
        self.steps += 1
        self.actions.append(action)
        ends, reward = self.steps >= self.end, self.pays[self.steps - 1] if self.pays else self.steps
        return self.picture(), reward, ends and not self.truncates, ends and self.truncates, {}

    def render(self):
        return self.picture()
