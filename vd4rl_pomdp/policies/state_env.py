"""A dm_control task as a Gymnasium environment of simulator states, for training the data-collecting policies."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from dm_control import suite

from vd4rl_pomdp.tasks import ACTION_REPEAT, EPISODE_TRANSITIONS, Task


class StateEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """States in, actions out, action repeat 2, a time limit of 500 decisions that truncates.

    Observations: (D,) float32, dm_control's observations flattened in order. Actions: (A,) float32 in [-1, 1].
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._random = np.random.RandomState(0)
        self._env = suite.load(task.domain, task.task, task_kwargs={"random": self._random})
        self._decisions = 0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (task.state_dim,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (task.action_dim,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode; a seed fixes its initial state and those that follow."""
        super().reset(seed=seed)
        if seed is not None:
            self._random.seed(seed)
        self._decisions = 0
        return flat_state(self._env.reset().observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply one action for two simulator steps; the reward is their sum."""
        reward = 0.0
        for _ in range(ACTION_REPEAT):
            step = self._env.step(action)
            reward += step.reward
        self._decisions += 1
        return flat_state(step.observation), reward, False, self._decisions == EPISODE_TRANSITIONS, {}


def flat_state(observation: dict[str, np.ndarray]) -> np.ndarray:
    """dm_control's observations as one (D,) float32 vector, in their own order."""
    return np.concatenate([np.ravel(value) for value in observation.values()]).astype(np.float32)
