"""Finite worlds as Gymnasium environments, and as training batches of their exact sequences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, refuse_unknown
from vd4rl_pomdp.core.types import Windows, previous, row_key
from vd4rl_pomdp.envs import Info
from vd4rl_pomdp.studies.theory.law import joint_law
from vd4rl_pomdp.studies.theory.world import WORLDS, World


class FiniteEnv(gymnasium.Env[np.ndarray, np.int64]):
    """A finite world as an environment, without rewards and termination; registered ids add the time limit.

    Observations: (C, 1, 1) uint8, one channel per symbol, 255 for the observed one, as in `ExactWindows`. Actions:
    index into `world.actions`. `info` holds `state` and `exogenous`, hidden from the agent.
    """

    metadata = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own name and type)

    def __init__(self, world: str, render_mode: str | None = None) -> None:
        refuse_unknown("world", world, WORLDS)
        self.world = WORLDS[world]()
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0, 255, (len(self.world.symbols), 1, 1), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(len(self.world.actions))
        self._pair: tuple[Any, Any] = (self.world.states[0], self.world.exogenous[0])
        self._symbol = self.world.symbols[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Draw the first pair from the world's initial distribution."""
        super().reset(seed=seed)
        self._pair = self._draw(self.world.initial)
        return self._show()

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Apply an action and advance the exogenous chain; UserError for an invalid action."""
        if not self.action_space.contains(action):
            last = len(self.world.actions) - 1
            raise UserError(f"action {action}: give the index of one in {list(self.world.actions)}, 0 to {last}")
        state, noise = self._pair
        after = self.world.step[state, self.world.actions[int(action)]]
        self._pair = after, self._draw(self.world.drift[noise])
        obs, info = self._show()
        return obs, 0.0, False, False, info

    def render(self) -> str:
        """State, exogenous state and observation as text."""
        return f"state {self._pair[0]}, exogenous {self._pair[1]}: shows {self._symbol}"

    def _draw(self, law: Mapping[Any, Fraction]) -> Any:
        items = list(law)
        return items[self.np_random.choice(len(items), p=[float(p) for p in law.values()])]

    def _show(self) -> tuple[np.ndarray, Info]:
        self._symbol = self._draw(self.world.emission[self._pair])
        obs = np.zeros(self.observation_space.shape or (), np.uint8)
        obs[self.world.symbols.index(self._symbol)] = 255
        return obs, {"state": self._pair[0], "exogenous": self._pair[1]}


@dataclass(frozen=True)
class ExactWindows:
    """All sequences of `rows` rows in a world, once each, with their probabilities."""

    windows: Windows
    """obs (N, T, C, 1, 1) uint8, one channel per symbol, 0 or 255; actions (N, T, A) float32, one-hot."""
    probability: Tensor
    """(N,) float64."""
    state: Tensor
    """(N, T) int64: index of s_j in the world's states."""

    def draw(self, count: int, generator: torch.Generator) -> Windows:
        """A batch of `count` windows, drawn by probability."""
        index = torch.multinomial(self.probability, count, replacement=True, generator=generator)
        return self.windows.replace(**{name: self.windows[name][index] for name in self.windows})


def exact_windows(world: World, rows: int) -> ExactWindows:
    """All sequences from a world's initial distribution; windows end within their episode, as in training."""
    law = joint_law(world, [(kind, j) for kind in ("s", "o", "a") for j in range(rows)])
    symbol, choice, state = (np.stack([law.column((kind, j)) for j in range(rows)], axis=1) for kind in ("o", "a", "s"))
    obs = torch.from_numpy(255 * np.eye(len(world.symbols), dtype=np.uint8)[symbol])
    action = torch.from_numpy(np.eye(len(world.actions), dtype=np.float32)[choice])
    count = len(law.counts)
    windows = Windows(
        obs=obs[..., None, None],
        prev_action=previous(action),
        action=action,
        has_action=torch.ones(count, rows, dtype=torch.bool),
        length=torch.full((count,), rows),
        key=row_key(torch.arange(count)[:, None], torch.arange(rows)),
    )
    weights = law.counts.astype(object)
    probability = torch.tensor([float(p) for p in weights / sum(weights)], dtype=torch.float64)
    return ExactWindows(windows, probability, torch.from_numpy(state))
