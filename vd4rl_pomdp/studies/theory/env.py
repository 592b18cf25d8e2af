"""Finite worlds as Gymnasium environments: the paper's counterexample to walk through, under actions of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import gymnasium
import numpy as np

from vd4rl_pomdp.core.errors import UserError, refuse_unknown
from vd4rl_pomdp.envs import Info
from vd4rl_pomdp.studies.theory.gallery import WORLDS


class FiniteEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One world of the gallery; nothing terminates or is rewarded, and the registered ids add the time limit.

    Observations: (C, 1, 1) uint8, one channel a symbol, 255 for the one that is shown, as in `theory.windows`. Actions:
    the place of an action in `world.actions`. `info` holds `state` and `exogenous`, which an agent may not read.
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
        """Draw a first pair from the world's initial law."""
        super().reset(seed=seed)
        self._pair = self._draw(self.world.initial)
        return self._show()

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Apply one action and let the exogenous part run; raises UserError for a place that holds none."""
        if not self.action_space.contains(action):
            last = len(self.world.actions) - 1
            raise UserError(f"action {action}: give the place of one in {list(self.world.actions)}, 0 to {last}")
        state, noise = self._pair
        after = self.world.step[state, self.world.actions[int(action)]]
        self._pair = after, self._draw(self.world.drift[noise])
        obs, info = self._show()
        return obs, 0.0, False, False, info

    def render(self) -> str:
        """State, exogenous part and observation as text."""
        return f"state {self._pair[0]}, exogenous {self._pair[1]}: shows {self._symbol}"

    def _draw(self, law: Mapping[Any, Fraction]) -> Any:
        items = list(law)
        return items[self.np_random.choice(len(items), p=[float(p) for p in law.values()])]

    def _show(self) -> tuple[np.ndarray, Info]:
        self._symbol = self._draw(self.world.emission[self._pair])
        obs = np.zeros(self.observation_space.shape or (), np.uint8)
        obs[self.world.symbols.index(self._symbol)] = 255
        return obs, self._info()

    def _info(self) -> Info:
        return {"state": self._pair[0], "exogenous": self._pair[1]}
