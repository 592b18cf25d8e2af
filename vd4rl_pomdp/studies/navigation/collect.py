"""Collect a maze's dataset: shards in V-D4RL's format with frames of 100x100 and the true state of every row.

Trajectory i depends only on (seed, i), not on the number of workers. A trajectory has no resets; goals are uniform in
the free space and move when reached. Shards are written atomically: re-running the same command resumes an interrupted
collection with identical files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from vd4rl_pomdp.core.errors import MAX_SEED, MOST_ROWS, refuse_outside, refuse_unknown
from vd4rl_pomdp.core.options import StageConfig
from vd4rl_pomdp.core.streams import episode_seed
from vd4rl_pomdp.core.tasks import MOST_EPISODES
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.shards import EpisodeArrays, Shard, collect_set
from vd4rl_pomdp.envs.mazes import ACTION_REPEAT, MAZES, MOST_STEPS, Style, get_maze
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.provenance import versions
from vd4rl_pomdp.studies.navigation.pictures import TEXTURES, ExogenousNoise, to_grey50

if TYPE_CHECKING:
    from vd4rl_pomdp.envs.maze import MazeEnv

SAMPLES = 6
"""Sample observations per maze."""
_FIRST_SAMPLE, _SAMPLE_STEP = 20, 12


@dataclass(frozen=True, kw_only=True)
class MazeCollectConfig(StageConfig):
    """Settings of `vd4rl-pomdp navigation collect`."""

    maze: str = ""
    """no_curtain, one_curtain, three_curtains or first_person, these with the prefix hard_, or compass_first_person."""
    out: Path = Path()
    """Folder of the dataset."""
    trajectories: int = 500
    """Total trajectories; the last tenth is held out from training."""
    trajectory_rows: int = 1000
    """Rows per trajectory."""
    action_repeat: int = ACTION_REPEAT
    """Simulator steps of 0.01 s per action."""
    seed: int = 0
    """Seed of starts, goals and action noise."""
    workers: int = 0
    """Worker processes; 0 uses every core."""
    trajectories_per_shard: int = 5
    """Trajectories per shard."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {},
        "cpu": {"trajectories": 100},
        "smoke": {"trajectories": 10, "trajectory_rows": 120},
    }
    """500k rows as in the paper, 100k, and 1,200 rows."""

    def check(self) -> None:
        """Raise UserError for invalid settings."""
        super().check()
        refuse_unknown("--maze", self.maze, MAZES)
        refuse_outside(
            self, trajectories=(1, MOST_EPISODES), trajectory_rows=(2, MOST_ROWS), action_repeat=(1, MOST_STEPS),
            seed=(0, MAX_SEED), trajectories_per_shard=1, workers=0,
        )  # fmt: skip


def collect(config: MazeCollectConfig) -> list[Path]:
    """Collect the dataset, or what is missing of it; returns its shards."""
    config.check()
    refuse_inside(config.out)
    maze, packages = get_maze(config.maze), ("mujoco", "gymnasium-robotics", "vd4rl-pomdp")
    attributes = {
        "task": config.maze,
        "policy": maze.driver,
        "seed": config.seed,
        "action_repeat": config.action_repeat,
        "noise": maze.style.noise,
        "zero_share": maze.style.zero_share,
        "random_share": maze.style.random_share,
        "versions": {k: v for k, v in versions().items() if k in packages},
    }
    shape, step = (config.seed, config.trajectory_rows, config.action_repeat), config.trajectories_per_shard
    jobs = [(config.maze, number, *shape) for number in range(config.trajectories)]
    shards = [
        Shard(config.out / f"{number}_{config.maze}.hdf5", jobs[start : start + step], attributes)
        for number, start in enumerate(range(0, len(jobs), step))
    ]
    title = f"collect {config.maze}", "trajectories"
    collect_set(config.out, collection(config), shards, _roll_out, config.workers, title, config.maze)
    return [shard.path for shard in shards]


def collection(config: MazeCollectConfig) -> dict[str, Any]:
    """Settings that identify a dataset, as in its collection.json."""
    runtime = ("out", "workers", "preset")
    return {name: value for name, value in jsonable(asdict(config)).items() if name not in runtime}


def _roll_out(job: tuple[str, int, int, int, int]) -> EpisodeArrays:
    """Roll out one trajectory, by maze, number, seed, rows and action repeat; returns its arrays by key."""
    maze, trajectory, seed, length, action_repeat = job
    env, rng = _environment(maze, action_repeat), np.random.default_rng([seed, trajectory])
    act = _controller(env, rng)
    frame, info = env.reset(seed=episode_seed(seed, trajectory))
    rows: list[tuple[Any, ...]] = [(frame, np.zeros(2, np.float32), 0.0, info["state"])]
    while len(rows) < length:
        action = _explore(act(info["state"], info["goal"]), env.maze_spec.style, rng)
        frame, reward, _, _, info = env.step(action)
        rows.append((frame, action, reward, info["state"]))
    frames, actions, rewards, states = zip(*rows, strict=True)
    step_type = np.full(len(rows), StepType.MID)
    step_type[0], step_type[-1] = StepType.FIRST, StepType.LAST
    return {
        "observation": np.stack(frames),
        "action": np.stack(actions),
        "reward": np.array(rewards),
        "discount": np.ones(len(rows)),
        "step_type": step_type,
        "physics": np.stack(states),
    }


def _explore(action: np.ndarray, style: Style, rng: np.random.Generator) -> np.ndarray:
    """The executed (2,) float32 action: a controller's action with noise."""
    if style.noise:
        action = action + rng.normal(0, style.noise, 2)
    if style.zero_share + style.random_share > 0:
        kind = rng.random()
        if kind < style.zero_share:
            action = np.zeros(2)
        elif kind < style.zero_share + style.random_share:
            action = rng.uniform(-1, 1, 2)
    return np.clip(action, -1, 1).astype(np.float32)


def _controller(env: MazeEnv, rng: np.random.Generator) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The maze's controller, a function of state and goal."""
    from vd4rl_pomdp.studies.navigation.drivers import FirstPersonController, Planner, WaypointPlanner

    if env.maze_spec.first_person:
        return FirstPersonController(env).act
    return (WaypointPlanner(env, rng) if env.maze_spec.style.goals_are_cells else Planner(env)).act


@cache
def _environment(maze: str, action_repeat: int) -> MazeEnv:
    """This process's environment, cached so that all trajectories share one GL context."""
    from vd4rl_pomdp.envs.maze import MazeEnv

    return MazeEnv(maze, action_repeat)


def sample_observations() -> dict[str, np.ndarray]:
    """Images along a trajectory in every maze, then in grey and with exogenous noise for one maze.

    Returns:
        (SAMPLES, 3, H, W) uint8 by name.
    """
    rows = _FIRST_SAMPLE + _SAMPLE_STEP * (SAMPLES - 1) + 1
    drives = {maze: _roll_out((maze, 0, 0, rows, ACTION_REPEAT)) for maze in MAZES}
    samples = {maze: drive["observation"][_FIRST_SAMPLE::_SAMPLE_STEP] for maze, drive in drives.items()}
    pictures = torch.from_numpy(samples["three_curtains"])
    noise = ExogenousNoise(TEXTURES, 0.5, 0)
    samples["three_curtains, grey50"] = to_grey50(pictures).expand(-1, 3, -1, -1).numpy()
    samples[f"three_curtains, exogenous {TEXTURES}"] = noise(pictures, torch.arange(len(pictures))).numpy()
    return samples
