"""Any Gymnasium environment with pixels as a task: images resized to frames, actions rescaled to [-1, 1], no states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

from vd4rl_pomdp.core.errors import UserError, in_one_line
from vd4rl_pomdp.core.tasks import FRAME_SIZE, GymnasiumTask, Layout
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.envs.opengl import close_at_exit, gl_errors, refuse_after_fork, undisturbed
from vd4rl_pomdp.envs.pixels import PixelEnv, TimeStep, between, check_bounds

NOTHING = np.zeros(0)
_REFUSALS = (gymnasium.error.Error, ImportError)
"""Errors by which an environment reports that it cannot run, for example without a package."""


@cache
def _overlaps(old: int, new: int) -> np.ndarray:
    """Resampling weights (new, old) float32: overlap of old and new pixels, scaled to integers with row sum `old`."""
    starts, others = np.arange(new)[:, None] * old, np.arange(old) * new
    return np.maximum(np.minimum(starts + old, others + new) - np.maximum(starts, others), 0).astype(np.float32)


def area_means(picture: np.ndarray, size: int) -> np.ndarray:
    """Resize by area averaging: (H, W, 3) uint8 -> (size, size, 3) uint8, halves rounded up.

    For integer ratios this is Pillow's box filter, which rounds after each axis. For others Pillow uses no fractional
    pixels, and torch's `area` mode lets areas overlap, so the means are computed here. They are exact: all sums are
    integers below 2^24 (float32), or below 2^53 (float64) for images larger than 128x128.
    """
    height, width, _ = picture.shape
    if not (height % size or width % size):
        return np.asarray(Image.fromarray(picture).resize((size, size), Image.Resampling.BOX))
    exact = np.float32 if height * width <= 2**14 else np.float64  # exact even next to a half, where rounding flips
    lines = _overlaps(height, size) @ picture.transpose(2, 0, 1).astype(np.float32, "C")
    sums = lines.astype(exact) @ _overlaps(width, size).T.astype(exact)
    return np.floor(sums / (height * width) + 0.5).astype(np.uint8).transpose(1, 2, 0)


class GymnasiumEnv(PixelEnv):
    """One task. Termination ends an episode with discount 0; truncation and our time limit end it with discount 1."""

    def __init__(self, task: GymnasiumTask, size: int | None = FRAME_SIZE, length: int | None = None) -> None:
        super().__init__(task, size, length)
        self._name = task.name
        self._renders = task.pixels == "render"
        arguments = dict(task.arguments) | ({"render_mode": "rgb_array"} if self._renders else {})
        with self._own_errors("cannot be made", (*_REFUSALS, TypeError, AttributeError, RuntimeError)):
            if isinstance(task.environment, str):
                self.env = gymnasium.make(task.environment, disable_env_checker=True, **arguments)
            else:
                self.env = task.environment(**arguments)
        space = self.env.action_space
        floating = np.issubdtype(space.dtype, np.floating)
        if not isinstance(space, gymnasium.spaces.Box) or not floating or not space.low.size:
            raise UserError(
                f"environment {self._name} has the actions {space}, but a task needs a bounded Box of floating "
                "point: wrap the environment to convert them"
            )
        check_bounds(f"environment {self._name}", space.low, space.high)
        self._space = space
        self._observation: Any = None

    @property
    def layout(self) -> Layout:
        return Layout(int(np.prod(self._space.shape)))

    @property
    def rate(self) -> float:
        """Decisions per second: by dm_control's time step, the environment's `render_fps`, or 30."""
        step = getattr(self.env.unwrapped, "control_timestep", None)  # shimmy's render_fps is in milliseconds
        declared: Any = self.env.metadata.get("render_fps")
        known = isinstance(declared, int | float | np.integer) and 0 < declared < math.inf
        rate = 1 / step() if callable(step) else declared if known else 30
        return rate / self.task.action_repeat

    def close(self) -> None:
        self.env.close()

    @contextmanager
    def _own_errors(self, what: str, refusals: tuple[type[Exception], ...] = _REFUSALS) -> Iterator[None]:
        """Turn an environment's own errors, such as a missing package or OpenGL, into a UserError."""
        try:
            with gl_errors():
                yield
        except refusals as error:
            reason = in_one_line(error)
            raise UserError(
                f"environment {self._name} {what} ({reason}): correct the task's registration, or install what the "
                "environment needs"
            ) from error

    def _begin(self, seed: int) -> None:
        try:
            with self._own_errors("cannot be reset"):
                returned = self.env.reset(seed=seed)
        except TypeError as error:
            if "'seed'" not in str(error):  # a TypeError from inside the environment
                raise
            raise UserError(
                f"environment {self._name} cannot be reset with a seed ({in_one_line(error)}): give it Gymnasium's "
                "`reset(self, *, seed=None, options=None)`, or wrap it"
            ) from error
        self._observation, _ = self._unpacked("reset", returned, 2)

    def _apply(self, action: np.ndarray) -> tuple[float, bool, float]:
        rescaled, total = self._rescaled(action), 0.0
        for _ in range(self.task.action_repeat):
            with self._own_errors("cannot make a step"):
                returned = self.env.step(rescaled.copy())
            self._observation, reward, terminated, truncated, _ = self._unpacked("step", returned, 5)
            try:
                number = float(np.asarray(reward).item())
            except (TypeError, ValueError):
                number = math.nan
            if not math.isfinite(number):
                raise UserError(
                    f"environment {self._name} returns the reward {reward}, expected a number: correct or wrap it"
                )
            total += number
            if terminated or truncated:
                return total, True, 0.0 if terminated else 1.0
        return total, False, 1.0

    def _rescaled(self, action: np.ndarray) -> np.ndarray:
        low, high = self._space.low, self._space.high
        return between(np.reshape(action, low.shape), low, high)

    def _unpacked(self, method: str, returned: Any, length: int) -> Any:
        if not isinstance(returned, tuple) or len(returned) != length:
            found = f"{len(returned)} values" if isinstance(returned, tuple) else f"a {type(returned).__name__}"
            raise UserError(
                f"environment {self._name} returns {found} from {method}, expected {length} as in Gymnasium: wrap it"
            )
        return returned

    def _frame(self, size: int) -> np.ndarray:
        picture = self._picture()
        picture = picture if picture.shape[:2] == (size, size) else area_means(picture, size)
        return np.array(picture.transpose(2, 0, 1), order="C")  # a copy: the environment may reuse its buffer

    def _time_step(self, reward: float, discount: float, step_type: StepType) -> TimeStep:
        frame = self._frame(self.size) if self.size and self.drawing else None
        return TimeStep(frame, NOTHING.astype(np.float32), NOTHING, reward, discount, step_type)

    def _picture(self) -> np.ndarray:
        """Current image as (H, W, 3) uint8; a grey one is repeated to three channels."""
        given = self._rendered() if self._renders else self._observation
        picture = given if isinstance(given, np.ndarray) else np.zeros(0)
        if picture.ndim == 3 and picture.shape[0] in (1, 3) and picture.shape[-1] not in (1, 3):
            picture = picture.transpose(1, 2, 0)
        if picture.ndim == 2:
            picture = picture[..., None]
        if picture.ndim != 3 or picture.shape[-1] not in (1, 3) or picture.dtype != np.uint8 or not picture.size:
            got = f"{picture.dtype} of shape {picture.shape}" if isinstance(given, np.ndarray) else type(given).__name__
            raise UserError(
                f"environment {self._name} returns {got} from its {'render()' if self._renders else 'observation'}, "
                "expected uint8 images (H, W, 3): choose pixels='render' or 'observation', or wrap it"
            )
        return np.repeat(picture, 3, axis=2) if picture.shape[-1] == 1 else picture

    def _rendered(self) -> Any:
        """`render()` of the environment; for a MuJoCo environment its OpenGL context is made current first."""
        renderer = getattr(self.env.unwrapped, "mujoco_renderer", None)
        viewer = getattr(renderer, "viewer", None)  # created at the first render
        if renderer is not None:
            refuse_after_fork()
        with undisturbed(), self._own_errors("cannot render"):
            if viewer is not None:
                viewer.make_context_current()
            picture = self.env.render()
        if renderer is not None and viewer is None:
            close_at_exit(self.env)
        return picture
