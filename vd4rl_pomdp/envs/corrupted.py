"""The environment a policy meets: stacked frames, corrupted once a step by the class that corrupts the data."""

from __future__ import annotations

import os
from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.corruptions import CorruptionConfig, derive_keys, make_corruption
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.pixels import Render, TimeStep
from vd4rl_pomdp.tasks import FRAME_SIZE, FRAME_STACK, Task
from vd4rl_pomdp.types import row_key

if hasattr(os, "register_at_fork"):  # a forked process would wait for the threads that it did not inherit
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


@dataclass(frozen=True)
class Observation:
    """What one step shows."""

    obs: Tensor
    """(C, S, S) uint8: the corrupted stack, all the agent may see."""
    clean: Tensor
    """(C, S, S) uint8: the stack before corruption."""
    time_step: TimeStep
    """Reward, step type and simulator state."""
    key: Tensor
    """(1,) int64: what the corruption was drawn from, the same for a row of an episode wherever it is played."""


class CorruptedEnv:
    """A task with stacked, corrupted frames. Row t of an episode is corrupted by keys of (seed, episode, t)."""

    def __init__(
        self,
        task: Task,
        corruption: CorruptionConfig,
        render: Render = "fast",
        length: int | None = None,
        size: int = FRAME_SIZE,
    ) -> None:
        self.env = make_env(task, render, size, length)
        self._corruption = make_corruption(corruption)
        self._frames: deque[np.ndarray] = deque(maxlen=FRAME_STACK)
        self._seed, self._episode, self._t = 0, 0, 0

    def reset(self, environment_seed: int, corruption_seed: int = 0, episode: int = 0) -> Observation:
        """Begin an episode; its corruption is drawn from (corruption_seed, episode)."""
        self._seed, self._episode, self._t = corruption_seed, episode, 0
        first = self.env.reset(environment_seed)
        assert first.frame is not None
        self._frames.extend([first.frame] * FRAME_STACK)
        return self._observation(first)

    def step(self, action: np.ndarray) -> Observation:
        """Apply an (A,) float32 action."""
        time_step = self.env.step(action)
        assert time_step.frame is not None
        self._frames.append(time_step.frame)
        self._t += 1
        return self._observation(time_step)

    def _observation(self, time_step: TimeStep) -> Observation:
        clean = torch.from_numpy(np.concatenate(self._frames))
        key = derive_keys(self._seed, row_key(torch.tensor([self._episode]), torch.tensor([self._t])))
        return Observation(self._corruption(clean[None], key)[0], clean, time_step, key)
