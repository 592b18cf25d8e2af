"""The evaluation environment: stacked frames, corrupted at every step by the same class that corrupts the data."""

from __future__ import annotations

import os
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK, Task
from vd4rl_pomdp.core.types import row_key
from vd4rl_pomdp.corruptions import CorruptionConfig, derive_keys, make_corruption
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.pixels import Render, TimeStep

if hasattr(os, "register_at_fork"):  # a forked child lacks torch's thread pool and would wait for it forever
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


@dataclass(frozen=True)
class Observation:
    """Observation of one step."""

    obs: Tensor
    """(C, S, S) uint8, the corrupted stack, which is all that the agent may see; (0,) without rendering."""
    clean: Tensor
    """(C, S, S) uint8, the stack before corruption, with zeros for frames that were not rendered; (0,) without any."""
    time_step: TimeStep
    """Reward, step type and simulator state."""
    key: Tensor
    """(1,) int64 corruption key; a function of (seed, episode, t), so it is the same on every machine."""


_AHEAD = 32
"""Number of rows for which `_seen_from` looks ahead at once."""
Drawn = Literal["all", "seen", "nothing"]
"""Which frames to render: all, only those that will be visible in some stack, or none."""


class CorruptedEnv:
    """A task with stacked, corrupted frames. Row t is corrupted with a key derived from (seed, episode, t)."""

    def __init__(
        self,
        task: Task,
        corruption: CorruptionConfig,
        render: Render = "fast",
        length: int | None = None,
        size: int = FRAME_SIZE,
        draws: Drawn = "all",
    ) -> None:
        self.env = make_env(task, render, None if draws == "nothing" else size, length)
        self._corruption = make_corruption(corruption)
        self._frames: deque[np.ndarray] = deque(maxlen=FRAME_STACK)
        self._seed, self._episode, self._t = 0, 0, 0
        self._draws, self._undrawn = draws, np.zeros((3, size, size), np.uint8)

    def reset(self, environment_seed: int, corruption_seed: int = 0, episode: int = 0) -> Observation:
        """Start an episode, whose corruption is determined by (corruption_seed, episode)."""
        self._seed, self._episode, self._t = corruption_seed, episode, 0
        self._choose_whether_to_draw()
        first = self.env.reset(environment_seed)
        # Fill the whole stack: the first frame is repeated for the missing earlier ones, as in `Dataset.stack_rows`.
        self._frames.extend([self._frame(first)] * FRAME_STACK)
        return self._observation(first)

    def step(self, action: np.ndarray) -> Observation:
        """Apply an (A,) float32 action."""
        self._t += 1
        self._choose_whether_to_draw()
        time_step = self.env.step(action)
        self._frames.append(self._frame(time_step))
        return self._observation(time_step)

    def _frame(self, time_step: TimeStep) -> np.ndarray:
        return self._undrawn if time_step.frame is None else time_step.frame

    def _choose_whether_to_draw(self) -> None:
        """Skip rendering a frame that zero_frames or truncate will drop from every stack; the keys tell in advance."""
        if self._draws == "seen":
            if self._t % _AHEAD == 0:
                self._seen = self._seen_from(self._t)
            self.env.drawing = self._seen[self._t % _AHEAD]

    def _seen_from(self, t: int) -> list[bool]:
        """Whether the frame of each row t..t+_AHEAD-1 will be visible in some stack."""
        kept = self._corruption.kept(self._keys(torch.arange(t, t + _AHEAD + FRAME_STACK - 1)), FRAME_STACK)
        # a frame is the newest in its own row's stack, and moves one place back in each following stack
        newest = [(row, FRAME_STACK - 1 - row) for row in range(FRAME_STACK)]
        seen = torch.stack([(kept[row : row + _AHEAD] == place).any(1) for row, place in newest]).any(0).tolist()
        if t == 0:  # the first frame also fills all earlier places of its stack
            seen[0] = any(bool((kept[row] <= place).any()) for row, place in newest)
        return seen

    def _keys(self, t: Tensor) -> Tensor:
        """Corruption keys (T,) int64 of rows t (T,)."""
        return derive_keys(self._seed, row_key(torch.full_like(t, self._episode), t))

    def _observation(self, time_step: TimeStep) -> Observation:
        key = self._keys(torch.tensor([self._t]))
        if self._draws == "nothing":
            return Observation(torch.empty(0), torch.empty(0), time_step, key)
        clean = torch.from_numpy(np.concatenate(self._frames))
        return Observation(self._corruption(clean[None], key)[0], clean, time_step, key)
