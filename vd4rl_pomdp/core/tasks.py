"""Tasks by name: the benchmark's three with V-D4RL's conventions, memory tasks, and those added by users or packages.

A task is a dm_control task (`DMCTask`) or any Gymnasium environment with pixels (`GymnasiumTask`). A name fixes all of
a task's parameters; no flag changes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from vd4rl_pomdp.core.errors import MOST, MOST_ROWS, UserError, refuse_unknown
from vd4rl_pomdp.core.registry import Registry

FRAME_SIZE = 84
"""Height and width of the benchmark's frames in pixels."""
FRAME_SIZES = (16, 480)
"""Smallest and largest frame size that can be collected."""
FRAME_STACK = 3
ACTION_REPEAT = 2
EPISODE_TRANSITIONS = 500
"""Decisions per benchmark episode: 1000 simulator steps at action repeat 2. An episode has one more row than
decisions."""
MOST_EPISODES = 10**6
"""Maximum episodes that a command collects or plays."""
SCORE_DIVISOR = 10.0
"""V-D4RL's normalised score is return / 10."""
Quality = Literal["random", "medium_replay", "medium", "medium_expert", "expert"]
QUALITIES: tuple[Quality, ...] = get_args(Quality)
"""V-D4RL's dataset qualities."""
NoisyQuality = Literal["medium_noisy", "medium_expert_noisy", "expert_noisy"]
NOISY_QUALITIES: tuple[NoisyQuality, ...] = get_args(NoisyQuality)
"""This package's own. With action noise, the state does not determine the action, so an inverse model must infer it
from its effects."""
SET_QUALITIES = (*QUALITIES, *NOISY_QUALITIES)
"""All qualities that `data collect` can make."""
UNKNOWN_QUALITY = "unknown"
"""Placeholder for a quality that neither the files nor the folder names of a dataset reveal."""


@dataclass(frozen=True)
class Layout:
    """Dimensions of a task's rows."""

    action_dim: int
    state_dim: int = 0
    """Width of dm_control's observations, flattened and concatenated in their own order; 0: no states."""
    positions: int = 0
    """Number of generalised positions, the first columns of the simulator state; the rest are velocities."""
    travel: tuple[int, ...] = ()
    """Positions along the ground, invisible to a tracking camera."""
    turning: tuple[int, ...] = ()
    """Unlimited angles: a full turn looks the same."""
    quaternions: tuple[int, ...] = ()
    """First index of each unit quaternion's four positions; q and -q look the same."""
    beside: tuple[int, ...] = ()
    """First of two ground positions of each other body, seen by the camera relative to the travelling one."""
    unseen: tuple[int, ...] = ()
    """Positions of invisible bodies, which encode upcoming events of the episode."""

    def pose(self, physics: np.ndarray) -> np.ndarray:
        """Visible pose of (..., P) simulator states, equal for states that look equal.

        Columns: limited positions, sine and cosine of turning angles, then two columns of every quaternion's rotation
        matrix (Zhou et al. 2019, arXiv 1812.07035). Other bodies' ground positions are relative to the travelling body.
        """
        positions, turning = physics[..., : self.positions].copy(), physics[..., list(self.turning)]
        for first in self.beside:
            positions[..., first : first + 2] -= positions[..., list(self.travel)]
        rotations = []
        for first in self.quaternions:  # unit quaternions, real part first
            w, x, y, z = np.moveaxis(positions[..., first : first + 4], -1, 0)
            rotations += [
                np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
                np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
            ]
        replaced = [column for first in self.quaternions for column in range(first, first + 4)]
        plain = np.delete(positions, [*self.travel, *self.turning, *replaced, *self.unseen], axis=-1)
        return np.concatenate([plain, np.sin(turning), np.cos(turning), *rotations], axis=-1)

    def velocity(self, physics: np.ndarray) -> np.ndarray:
        """Velocities of (..., P) simulator states."""
        return physics[..., self.positions :]

    def visible_state(self, physics: np.ndarray) -> np.ndarray:
        """(..., P') float32: pose and velocity."""
        return np.concatenate([self.pose(physics), self.velocity(physics)], axis=-1).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Task:
    """Settings common to all tasks."""

    action_repeat: int
    """Simulator steps per action; their rewards are summed."""
    decisions: int = EPISODE_TRANSITIONS
    """Decisions after which an episode is truncated."""
    score_divisor: float = SCORE_DIVISOR
    """score = return / score_divisor."""
    action_noise: float | None = None
    """Standard deviation of the action noise in noisy datasets; None: the task has none."""
    layout: Layout | None = None
    """Dimensions of its rows. None: found by building the environment (see `envs.make.layout_of`)."""

    @property
    def summary(self) -> str:
        return f"action repeat {self.action_repeat}, {self.decisions} decisions per episode"


@dataclass(frozen=True)
class DMCTask(Task):
    """A dm_control task. Its simulator states are stored, and its rewards can be recomputed from them."""

    domain: str
    """Domain of dm_control's suite, or the dotted name of a module written like one: its `SUITE` maps task names to
    functions of `random` and `time_limit`."""
    task: str
    camera: int = 0
    """Number of the rendering camera."""
    action_repeat: int = field(default=ACTION_REPEAT, kw_only=True)
    """Simulator steps per action; their rewards are summed."""

    @property
    def summary(self) -> str:
        own = "." in self.domain
        title = f"{self.task} of {self.domain}" if own else f"dm_control's {self.domain} {self.task}"
        return f"{title}, camera {self.camera}, {super().summary}"


@dataclass(frozen=True)
class GymnasiumTask(Task):
    """A Gymnasium environment with pixels and bounded Box actions, rescaled to [-1, 1]. It has no simulator states."""

    environment: str | Callable[..., Any]
    """Environment id, or a class or module-level function that makes it."""
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Keyword arguments of the environment."""
    pixels: Literal["render", "observation"] = "render"
    """Source of the frames: `render()` with render_mode "rgb_array", or the observation itself."""
    action_repeat: int = field(default=1, kw_only=True)
    """Environment steps per action; their rewards are summed. Stops early when an episode ends."""

    @property
    def name(self) -> str:
        """Environment id, or the name of the class or function that makes it."""
        if isinstance(self.environment, str):
            return self.environment
        return getattr(self.environment, "__name__", repr(self.environment))

    @property
    def summary(self) -> str:
        return f"Gymnasium's {self.name}, {super().summary}"


def _refuse(name: str, task: Task) -> None:
    """Raise UserError for invalid task settings."""
    for what, most in (("decisions", MOST_ROWS - 1), ("action_repeat", MOST)):
        number = getattr(task, what)
        if not isinstance(number, int) or not 1 <= number <= most:
            raise UserError(f"its {what} is {number!r}: it must be an integer from 1 to {most}")
    if not (isinstance(task.score_divisor, int | float) and 0 < task.score_divisor < math.inf):
        raise UserError(f"its score_divisor is {task.score_divisor!r}: it must be a positive number")
    noise = 0.0 if task.action_noise is None else task.action_noise
    if not (isinstance(noise, int | float) and 0 <= noise < math.inf):
        raise UserError(f"its action_noise is {noise!r}: it must be 0 or a positive number, or None")
    if isinstance(task, DMCTask) and not isinstance(task.camera, int):
        raise UserError(f"its camera is {task.camera!r}: it must be the camera's number")
    if isinstance(task, GymnasiumTask):
        refuse_unknown("pixels", task.pixels, ("render", "observation"))


TASKS: Registry[Task] = Registry(
    "task",
    {
        "walker_walk": DMCTask("walker", "walk", layout=Layout(6, 24, 9, travel=(1,), turning=(2,)), action_noise=0.5),
        "cheetah_run": DMCTask("cheetah", "run", layout=Layout(6, 17, 9, travel=(0,), turning=(2,)), action_noise=0.4),
        "humanoid_walk": DMCTask(
            "humanoid", "walk", layout=Layout(21, 67, 28, travel=(0, 1), quaternions=(3,)), action_noise=0.3
        ),
        "reacher_jump": DMCTask(
            "vd4rl_pomdp.envs.glimpses", "reacher_jump", layout=Layout(2, 7, 7, turning=(0,), unseen=(5, 6))
        ),
        "point_mass_cue": DMCTask("vd4rl_pomdp.envs.glimpses", "point_mass_cue", layout=Layout(2, 6, 7, unseen=(5, 6))),
    },
    lambda part: isinstance(part, DMCTask | GymnasiumTask),
    "a vd4rl_pomdp.core.tasks.DMCTask or GymnasiumTask",
    _refuse,
)
"""All tasks. Packages add theirs through the entry-point group `vd4rl_pomdp.tasks`. The noise of the benchmark tasks is
the largest of 0.2, 0.3, 0.4 and 0.5 that leaves the expert more than half of its mean return."""
