"""dm_control tasks as V-D4RL saw them: camera 0, 84x84, action repeat 2, 500 decisions, and every simulator state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vd4rl_pomdp.envs import rendering
from vd4rl_pomdp.envs.rendering import Render, suite
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.tasks import ACTION_REPEAT, EPISODE_TRANSITIONS, Task, get_task
from vd4rl_pomdp.types import StepType


@dataclass(frozen=True)
class Row:
    """One row of an episode (see the time axis in `types`)."""

    frame: np.ndarray | None
    """(3, 84, 84) uint8; None when rendering is off."""
    state: np.ndarray
    """(D,) float32: dm_control's observations, flattened in their own order."""
    physics: np.ndarray
    """(P,) float64: simulator state."""
    reward: float
    """Reward that led into this row, summed over the action repeat; 0 in the first."""
    discount: float
    step_type: StepType

    @property
    def last(self) -> bool:
        """Whether the episode ends here."""
        return self.step_type == StepType.LAST


class PixelEnv:
    """One task. An episode's first state depends on its seed alone, and its rewards replay from that state exactly."""

    def __init__(self, task: str, render: Render = "fast", pixels: bool = True, length: int | None = None) -> None:
        self.task = get_task(task)
        self._random = np.random.RandomState(0)
        self.simulator = _load(self.task, self._random)
        """The dm_control environment."""
        self._pixels = pixels
        self._length = EPISODE_TRANSITIONS if length is None else length
        if self._length < 1:
            raise UserError(f"an episode of {length} decisions is too short; it needs at least 1")
        self._decisions = 0
        if pixels:
            rendering.prepare(self.physics, render)

    @property
    def physics(self) -> Any:
        """dm_control's physics."""
        return self.simulator.physics

    def reset(self, seed: int) -> Row:
        """Begin the episode of a seed."""
        self._random.seed(seed)
        self.simulator.reset()
        start_from(self.simulator, self.physics.get_state())
        self._decisions = 0
        return self._row(0.0, 1.0, StepType.FIRST)

    def step(self, action: np.ndarray) -> Row:
        """Apply an (A,) float32 action in [-1, 1] for two simulator steps."""
        reward = repeat_action(self.simulator, action)
        self._decisions += 1
        last = self._decisions == self._length
        return self._row(reward, 1.0, StepType.LAST if last else StepType.MID)

    def _row(self, reward: float, discount: float, step_type: StepType) -> Row:
        return Row(
            frame=rendering.frame(self.physics) if self._pixels else None,
            state=flat_state(self.simulator.task.get_observation(self.physics)),
            physics=self.physics.get_state(),
            reward=reward,
            discount=discount,
            step_type=step_type,
        )


def flat_state(observation: dict[str, np.ndarray]) -> np.ndarray:
    """dm_control's observations as one (D,) float32 vector, in their own order."""
    return np.concatenate([np.ravel(value) for value in observation.values()]).astype(np.float32)


def start_from(env: Any, state: np.ndarray) -> None:
    """Put the simulator into a state with nothing left of what was before, the solver's warm start included."""
    with env.physics.reset_context():
        env.physics.set_state(state)


def repeat_action(env: Any, action: np.ndarray) -> float:
    """Apply one action for the action repeat; returns the summed reward."""
    return float(sum(env.step(action).reward for _ in range(ACTION_REPEAT)))


def replay_rewards(task: str, physics: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Rewards of an action sequence from a simulator state.

    Args:
        task: task name.
        physics: (P,) float64 state of the first row.
        actions: (T, A) float32, a_0 first.

    Returns:
        (T,) float64: r_0 .. r_{T-1}.
    """
    env = _load(get_task(task), np.random.RandomState(0))
    env.reset()
    start_from(env, physics)
    return np.array([repeat_action(env, action) for action in actions])


def _load(task: Task, random: np.random.RandomState) -> Any:
    """The dm_control environment; its own time limit never ends an episode, ours does."""
    rendering.check_mujoco()
    return suite.load(task.domain, task.task, task_kwargs={"random": random, "time_limit": float("inf")})
