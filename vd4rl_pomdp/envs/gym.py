"""The corrupted tasks as Gymnasium environments, usable without the rest of the harness."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np

from vd4rl_pomdp.core.errors import refuse_number
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_SIZES, FRAME_STACK, TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig, check_corruption_fits
from vd4rl_pomdp.envs import Info
from vd4rl_pomdp.envs.corrupted import CorruptedEnv, Observation
from vd4rl_pomdp.envs.pixels import Render, checked_action


class GymEnv(gymnasium.Env[np.ndarray, np.ndarray], gymnasium.utils.EzPickle):
    """A task with corrupted pixels. Episodes end only if the task terminates; the registered ids add a time limit.

    Observations: (9, S, S) uint8, three frames of `frame_size`, oldest first. Actions: (A,) float32 in [-1, 1]. `info`
    holds `clean`, the observation before corruption, and `physics`, the (P,) float64 simulator state (P = 0 for a task
    without states). `reset(seed=...)` determines the initial states and corruptions of all following episodes.
    `corruption_fields` are the corruption's mode and options; UserError for an unknown or invalid one.
    A pickled or copied environment is a new one, before its first `reset`.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium's own name and type)

    def __init__(
        self,
        task: str,
        corruption: str = "none",
        render: Render = "fast",
        render_mode: str | None = None,
        frame_size: int = FRAME_SIZE,
        **corruption_fields: Any,
    ) -> None:
        gymnasium.utils.EzPickle.__init__(self, task, corruption, render, render_mode, frame_size, **corruption_fields)
        refuse_number("frame_size", frame_size, *FRAME_SIZES)
        config = CorruptionConfig.of(corruption, **corruption_fields)
        check_corruption_fits(config, frame_size)
        # No time limit here: Gymnasium's TimeLimit wrapper sets `truncated`.
        self._env = CorruptedEnv(TASKS.named(task), config, render, sys.maxsize, frame_size)
        shape = (3 * FRAME_STACK, frame_size, frame_size)
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self._env.env.action_dim,), np.float32)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(self._env.env.rate))}
        self._corruption_seed: int | None = None
        self._episode = 0
        self._frame = np.zeros((frame_size, frame_size, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Start the next episode; a seed restarts the sequence of episodes."""
        super().reset(seed=seed)
        if seed is not None or self._corruption_seed is None:
            self._corruption_seed, self._episode = self._draw(), 0
        else:
            self._episode += 1
        return self._show(self._env.reset(self._draw(), self._corruption_seed, self._episode))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Repeat an action; returns the summed reward. UserError if the action has another shape or NaN."""
        now = self._env.step(checked_action(action, self._env.env.action_dim))
        obs, info = self._show(now)
        reward, terminated = now.time_step.reward, now.time_step.terminated
        return obs, reward, terminated, now.time_step.last and not terminated, info

    def render(self) -> np.ndarray:
        """The newest frame before corruption: (S, S, 3) uint8."""
        return self._frame.copy()

    def close(self) -> None:
        self._env.env.close()

    def _draw(self) -> int:
        return int(self.np_random.integers(2**31))

    def _show(self, now: Observation) -> tuple[np.ndarray, Info]:
        clean = now.clean.numpy()
        self._frame = np.ascontiguousarray(clean[-3:].transpose(1, 2, 0))
        return now.obs.numpy(), {"clean": clean.copy(), "physics": now.time_step.physics}
