"""Rendering of dm_control tasks and of mazes, against the defaults."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

from vd4rl_pomdp.bench.timing import rate
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.data.parity import canary_frames, compare
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.mazes import PICTURE_SIZE
from vd4rl_pomdp.envs.pixels import PixelEnv
from vd4rl_pomdp.runs.workers import run_jobs

ROUNDS = 5
"""Times that two ways of rendering take turns."""


def collection(frames: int) -> dict[str, float]:
    """Frames per CPU-second of the fast rendering against dm_control's default, and two workers against one."""
    rounds = [[_render_speed(render, frames // ROUNDS) for render in ("exact", "fast")] for _ in range(ROUNDS)]
    exact, fast = (statistics.median(column) for column in zip(*rounds, strict=True))
    difference = compare(canary_frames("walker_walk", "fast"), canary_frames("walker_walk", "exact"))
    alone = frames / next(iter(run_jobs(_render_wall, [("fast", frames)], 1)))
    together = sum(frames / seconds for seconds in run_jobs(_render_wall, [("fast", 4 * frames)] * 2, 2)) * 4
    return {
        "exact_frames_per_cpu_s": exact,
        "fast_frames_per_cpu_s": fast,
        "fast_over_exact": fast / exact,
        "fast_mean_difference_of_255": difference["mean_difference"],
        "two_workers_over_one": together / alone,
    }


def _render_speed(render: Any, frames: int) -> float:
    """Frames per CPU-second of one process."""
    env, action = _warm_environment(render)
    return rate(lambda: env.step(action), frames)


def _render_wall(job: tuple[Any, int]) -> float:
    """Wall-clock seconds of one job, without the process's start."""
    env, action = _warm_environment(job[0])
    start = time.perf_counter()
    for _ in range(job[1]):
        env.step(action)
    return time.perf_counter() - start


def _warm_environment(render: Any) -> tuple[PixelEnv, np.ndarray]:
    env = make_env(TASKS["walker_walk"], render)
    env.reset(0)
    action = np.zeros(env.action_dim, np.float32)
    env.step(action)
    return env, action


def maze_pictures(frames: int) -> dict[str, float]:
    """Pictures per CPU-second of the mazes, against PointMaze's own `render()` at the same size."""
    import gymnasium

    from vd4rl_pomdp.envs.maze import MazeEnv, gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    default: Any = gymnasium.make(
        "PointMaze_UMaze-v3", render_mode="rgb_array", width=PICTURE_SIZE, height=PICTURE_SIZE
    )
    default.reset(seed=0)
    speeds = {"default_frames_per_cpu_s": rate(default.render, frames)}
    for name, maze in (("fast", "no_curtain"), ("first_person", "first_person")):
        env = MazeEnv(maze)
        env.reset(seed=0, options={"state": np.array([1.0, 1.0] + [0.0] * (4 if maze == "first_person" else 2))})
        speeds[f"{name}_frames_per_cpu_s"] = rate(env.draw, frames)
    default.close()
    for name in ("fast", "first_person"):
        speeds[f"{name}_over_default"] = speeds[f"{name}_frames_per_cpu_s"] / speeds["default_frames_per_cpu_s"]
    return speeds
