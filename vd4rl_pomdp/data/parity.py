"""Check that the environment renders the data's pixels: compare canary with golden frames, and data backgrounds."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.data.dataset import open_dataset
from vd4rl_pomdp.envs.dmc import DMCEnv, start_from
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.pixels import Render
from vd4rl_pomdp.envs.rendering import FrameCamera, frames_hash, gl_strings, mujoco

GOLDEN = Path(__file__).parent / "golden.npz"
CANARY = "walker_walk"
"""Task whose canary frames are used for tasks without golden frames."""
MAX_MEAN_DIFFERENCE = 0.25
"""Largest mean absolute difference (of 255) that counts as equal.

Measured: 0.01 between mujoco 3.1.6 and 3.11.0 with the sky restored, 0.03 with the smaller shadow map, 1.4 to 2.1
without the sky. The margin above 0.03 allows for differences along edges between rasterisers of different vendors.
"""
_OFF_BY = 8
_STATIC_STD = 2.0


def canary_frames(task: str, render: Render = "exact", env: DMCEnv | None = None) -> np.ndarray:
    """The golden states rendered on this machine, in `env` if given: (F, 3, 84, 84) uint8."""
    env = env or _golden_env(task, render)
    camera, frames = FrameCamera(env.physics), []
    for state in _golden()[f"{task}/physics"]:
        start_from(env.simulator, state)
        frames.append(camera.frame())
    return np.stack(frames)


def render_info(task: str = CANARY) -> dict[str, Any]:
    """Describe this machine's rendering: mujoco version, GL vendor and renderer, and the hash of the canary frames.

    For a task without golden frames CANARY's are used; for one that is not dm_control's the result is only Gymnasium's
    version.
    """
    if not isinstance(TASKS.get(task), DMCTask | None):
        return {"gymnasium": gymnasium.__version__}
    task = task if task in golden_tasks() else CANARY
    env = _golden_env(task, "exact")  # its GL context must live while its strings are read
    frames = canary_frames(task, env=env)
    return {"mujoco": mujoco.__version__, **gl_strings(), "canary": frames_hash(frames)}


def compare(rendered: np.ndarray, reference: np.ndarray) -> dict[str, Any]:
    """Mean absolute difference, share of pixels off by more than 8 of 255, and whether they count as equal.

    Pixels are uint8 or, for medians, floating point.
    """
    difference = np.abs(rendered.astype(np.float32) - reference)
    mean = float(difference.mean(dtype=np.float64))
    return {
        "mean_difference": round(mean, 4),
        "share_off_by_8": round(float((difference > _OFF_BY).mean()), 5),
        "equal": mean <= MAX_MEAN_DIFFERENCE,
    }


def check_parity(path: Path | None = None) -> dict[str, Any]:
    """Compare canary frames with golden ones, and the static background of a data set, if any, with the environment's.

    Returns:
        `render`, `canary` (a comparison per task), `background` (a comparison, or None), and `equal`: the background's
        result if there is a data set (which may have been rendered differently from the golden frames), else whether
        all canaries are equal.
    """
    canary = {task: compare(canary_frames(task), _golden()[f"{task}/frames"]) for task in golden_tasks()}
    background = None if path is None else _compare_background(path)
    equal = all(comparison["equal"] for comparison in ([background] if background else canary.values()))
    return {"render": render_info(), "canary": canary, "background": background, "equal": equal}


def _compare_background(path: Path) -> dict[str, Any]:
    """Compare the median frames of data and environment on the pixels that are static in both."""
    dataset = open_dataset(path)
    if dataset.task is None:
        raise UserError(f"{path}: cannot determine the task; put the dataset in a folder named after it (walker_walk/)")
    rows = np.linspace(0, dataset.num_rows - 1, min(dataset.num_rows, 400)).astype(int)
    data, ours = dataset.frames.numpy()[rows], _wandering_frames(dataset.task, dataset.frame_size)
    static = (data.std(0) < _STATIC_STD) & (ours.std(0) < _STATIC_STD)
    if not static.any():
        raise UserError(f"{path}: no pixel is static in both dataset and environment; its frames are not this task's")
    result = compare(np.median(ours, 0)[static], np.median(data, 0)[static])
    return {"task": dataset.task, "static_pixels": int(static.sum()), **result}


def _wandering_frames(task: str, size: int, count: int = 100) -> np.ndarray:
    """Frames of random episodes: (count, 3, size, size) uint8."""
    env = make_env(TASKS.named(task), size=size)
    rng = np.random.default_rng(0)
    steps = [env.reset(0)]
    while len(steps) < count:
        action = rng.uniform(-1, 1, env.action_dim).astype(np.float32)
        steps.append(env.reset(len(steps)) if steps[-1].last else env.step(action))
    return np.stack([step.frame for step in steps if step.frame is not None])


def golden_tasks() -> list[str]:
    """Names of the tasks with golden frames."""
    return [name.partition("/")[0] for name in _golden() if name.endswith("/frames")]


def _golden_env(task: str, render: Render) -> DMCEnv:
    played = TASKS.named(task)
    assert isinstance(played, DMCTask), "Gymnasium environments have no golden frames"
    return DMCEnv(played, render)


@cache
def _golden() -> dict[str, np.ndarray]:
    """`<task>/physics`: states, `<task>/frames`: their frames by mujoco 3.1.6 with Mesa's software renderer."""
    with np.load(GOLDEN) as file:
        return dict(file)
