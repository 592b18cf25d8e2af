"""Interface of all tasks: `PixelEnv` with reset and step, and `TimeStep`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs

from vd4rl_pomdp.core.errors import MOST, UserError, refuse_unknown
from vd4rl_pomdp.core.tasks import Layout, Task
from vd4rl_pomdp.core.types import StepType

Render = Literal["fast", "exact"]
"""Rendering mode of dm_control: "fast" uses a smaller shadow map than "exact"."""


def check_render(render: str) -> None:
    """Raise UserError for an unknown rendering mode."""
    refuse_unknown("rendering", render, get_args(Render))


@dataclass(frozen=True)
class TimeStep:
    """An environment's output at one step: a row of a data set without its action (see `core.types`)."""

    frame: np.ndarray | None
    """(3, S, S) uint8; None if rendering is off."""
    state: np.ndarray
    """(D,) float32, dm_control's observations, flattened in their own order; (0,) for a task without states."""
    physics: np.ndarray
    """(P,) float64 simulator state; (0,) for a task without states."""
    reward: float
    """Reward of the action that led here, summed over the action repeat; 0 at the first step."""
    discount: float
    """0 if the task terminated here, else 1."""
    step_type: StepType

    @property
    def last(self) -> bool:
        return self.step_type == StepType.LAST

    @property
    def terminated(self) -> bool:
        """Whether the task terminated here, as opposed to a time limit."""
        return self.last and self.discount == 0


def check_bounds(what: str, low: np.ndarray, high: np.ndarray) -> None:
    """Raise UserError for action bounds, arrays of the same shape, that are infinite or too large to rescale to.

    For unlimited motors dm_control reports MuJoCo's largest number, 1e10, as bounds.
    """
    least, most = low.astype(np.float64), high.astype(np.float64)  # float16 does not hold 1e9
    if not ((least >= -MOST) & (least <= most) & (most <= MOST)).all():
        raise UserError(
            f"{what} has actions from {np.min(low):g} to {np.max(high):g}: only bounds within -{MOST:g} and {MOST:g} "
            "can be rescaled to [-1, 1]; choose another task, or wrap the environment in one that bounds its actions"
        )


def between(action: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Clip an action to [-1, 1] and rescale it to [low, high], in their dtype.

    -1 and 1 map to the bounds exactly, which rounding would miss: for [1.5, 1.86], 1 would give 1.8600000000000003.
    """
    wide = np.result_type(low, np.float64)
    lowest, highest, within = low.astype(wide), high.astype(wide), np.clip(action, -1, 1)
    inner = np.clip(within * ((highest - lowest) / 2) + (highest + lowest) / 2, lowest, highest)
    return np.where(within == -1, low, np.where(within == 1, high, inner)).astype(low.dtype)


def checked_action(action: Any, dimensions: int) -> np.ndarray:
    """A caller's action as an array; UserError unless it is (A,) finite numbers."""
    found = np.asarray(action)
    if found.shape != (dimensions,) or not np.isfinite(found).all():
        raise UserError(f"the action {action!r} is not one of {dimensions} finite numbers, of shape ({dimensions},)")
    return found


class PixelEnv(ABC):
    """One task. An episode's first state depends only on its seed.

    `size` is the height and width S of the frames (None: no rendering), `length` the time limit in decisions (None: the
    task's).
    """

    def __init__(self, task: Task, size: int | None, length: int | None) -> None:
        self.task, self.size = task, size
        self.drawing = size is not None
        """Whether to render the next time steps; may be switched at any time if `size` is given."""
        self._length = task.decisions if length is None else length
        if self._length < 1:
            raise UserError(f"an episode of {self._length} decisions is too short; it needs at least 1")
        self._decisions, self._over = 0, True

    @property
    @abstractmethod
    def layout(self) -> Layout:
        """Dimensions of actions and states."""

    @property
    @abstractmethod
    def rate(self) -> float:
        """Decisions per second of simulated time."""

    @property
    def action_dim(self) -> int:
        return self.layout.action_dim

    def reset(self, seed: int) -> TimeStep:
        """Start an episode; the seed determines its first state."""
        self._begin(seed)
        self._decisions, self._over = 0, False
        return self._time_step(0.0, 1.0, StepType.FIRST)

    def step(self, action: np.ndarray) -> TimeStep:
        """Repeat an (A,) float32 action in [-1, 1]; UserError if no episode is running."""
        if self._over:
            raise UserError("no episode has begun, or it is over: call reset() before the next step()")
        reward, ended, discount = self._apply(action)
        self._decisions += 1
        self._over = ended or self._decisions == self._length
        return self._time_step(reward, discount, StepType.LAST if self._over else StepType.MID)

    @abstractmethod
    def close(self) -> None:
        """Free what the renderer holds; dm_control's tasks can be reset again."""

    @abstractmethod
    def _begin(self, seed: int) -> None:
        """Reset to the first state of the seed's episode."""

    @abstractmethod
    def _apply(self, action: np.ndarray) -> tuple[float, bool, float]:
        """Repeat an action until the episode ends; returns (summed reward, whether it ended, discount)."""

    @abstractmethod
    def _time_step(self, reward: float, discount: float, step_type: StepType) -> TimeStep:
        """Time step of the current state."""


class ResetAfterEnd(gymnasium.Wrapper[np.ndarray, Any, np.ndarray, Any], RecordConstructorArgs):
    """Raises Gymnasium's ResetNeeded for a step between the end of an episode and the next `reset`."""

    def __init__(self, env: gymnasium.Env[np.ndarray, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        self._over = False

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self._over = False
        return self.env.reset(**options)

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        if self._over:
            raise ResetNeeded("the episode is over: call reset() before the next step()")
        result = self.env.step(action)
        self._over = result[2] or result[3]
        return result
