"""A task as a Gymnasium environment of simulator states, for training the policies that collect data."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from vd4rl_pomdp.core.tasks import Task
from vd4rl_pomdp.envs.make import layout_of, make_env


class StateEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """States in, actions out; the task's limit of decisions truncates.

    Observations: (D,) float32, dm_control's observations flattened in order. Actions: (A,) float32 in [-1, 1].
    """

    def __init__(self, task: Task) -> None:
        self._env = make_env(task, size=None)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (layout_of(task).state_dim,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (layout_of(task).action_dim,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the episode of a seed, or of one drawn from the environment's generator."""
        super().reset(seed=seed)
        first = self._env.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        return first.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply one action for the action repeat; the reward is the sum."""
        now = self._env.step(action)
        return now.state, now.reward, now.terminated, now.last and not now.terminated, {}
