"""The benchmark's tasks: dm_control's names, dimensions and V-D4RL's conventions, in one place."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from vd4rl_pomdp.errors import UserError

FRAME_SIZE = 84
FRAME_STACK = 3
ACTION_REPEAT = 2
EPISODE_TRANSITIONS = 500
"""Decisions an episode: 1000 simulator steps at action repeat 2; an episode has one row more."""
MOST_EPISODES = 10**6
"""Most episodes that any command makes or plays at once."""
SCORE_DIVISOR = 10.0
"""V-D4RL's normalised score is return / 10."""
Quality = Literal["random", "medium_replay", "medium", "medium_expert", "expert"]
QUALITIES: tuple[Quality, ...] = get_args(Quality)
"""V-D4RL's."""
NoisyQuality = Literal["expert_noisy", "medium_expert_noisy"]
NOISY_QUALITIES: tuple[NoisyQuality, ...] = get_args(NoisyQuality)
"""This package's own: where actions are not decided by the state, an inverse model can tell them from what they did."""
SET_QUALITIES = (*QUALITIES, *NOISY_QUALITIES)
"""All that `data collect` makes."""


@dataclass(frozen=True)
class Task:
    """One dm_control task as V-D4RL uses it (camera 0, 84x84, action repeat 2)."""

    name: str
    domain: str
    task: str
    action_dim: int
    state_dim: int
    """Width of dm_control's observations, flattened and concatenated in their own order."""
    positions: int
    """Generalised positions: the first columns of the simulator state, velocities the others."""
    travel: tuple[int, ...]
    """Positions along the ground, which the tracking camera does not show."""
    action_noise: float
    """Standard deviation of the noise in the noisy sets: of 0.2, 0.3, 0.4 and 0.5 the largest that leaves the expert
    more than half of its mean return."""

    def pose(self, physics: np.ndarray) -> np.ndarray:
        """Positions of (..., P) simulator states, without the place on the ground."""
        return np.delete(physics[..., : self.positions], self.travel, axis=-1)

    def velocity(self, physics: np.ndarray) -> np.ndarray:
        """Velocities of (..., P) simulator states."""
        return physics[..., self.positions :]

    def visible_state(self, physics: np.ndarray) -> np.ndarray:
        """(..., P') float32: pose and velocity."""
        return np.concatenate([self.pose(physics), self.velocity(physics)], axis=-1).astype(np.float32)


TASKS = {
    "walker_walk": Task("walker_walk", "walker", "walk", 6, 24, positions=9, travel=(1,), action_noise=0.5),
    "cheetah_run": Task("cheetah_run", "cheetah", "run", 6, 17, positions=9, travel=(0,), action_noise=0.4),
    "humanoid_walk": Task("humanoid_walk", "humanoid", "walk", 21, 67, positions=28, travel=(0, 1), action_noise=0.3),
}


def get_task(name: str) -> Task:
    """Return the task called `name`; raises UserError listing the choices for an unknown one."""
    if name not in TASKS:
        raise UserError(f"unknown task {name!r}: choose one of {', '.join(TASKS)}")
    return TASKS[name]
