"""Collect a data set in V-D4RL's format, with simulator states and a data card, using the shipped actors.

Episode i depends only on (seed, i), not on the number of workers. Shards are written atomically, so re-running the same
command resumes an interrupted collection and produces the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_outside, refuse_unknown
from vd4rl_pomdp.core.streams import episode_seed, stream_seed
from vd4rl_pomdp.core.tasks import (
    FRAME_SIZE,
    FRAME_SIZES,
    MOST_EPISODES,
    NOISY_QUALITIES,
    SET_QUALITIES,
    TASKS,
    NoisyQuality,
    Quality,
    Task,
)
from vd4rl_pomdp.data.card import write_card
from vd4rl_pomdp.data.shards import EpisodeArrays, Shard, collect_set
from vd4rl_pomdp.envs.make import layout_of, make_env
from vd4rl_pomdp.envs.pixels import Render
from vd4rl_pomdp.policies.actor import Actor, Ladder, load_actor, load_ladder, read_actor
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.provenance import versions
from vd4rl_pomdp.runs.workers import run_jobs

Collector = Actor | Ladder | None
"""Policy of a shard: an actor, a ladder of actors, or None for random actions."""
MAX_NOISE = 2.0
"""Largest standard deviation of action noise; beyond this, actions in [-1, 1] would be all noise."""


@dataclass(frozen=True)
class CollectConfig:
    """Collect a dataset with the shipped actors."""

    task: str
    """walker_walk, cheetah_run, humanoid_walk, reacher_jump, point_mass_cue, or a task that you registered."""
    quality: Quality | NoisyQuality
    """Behaviour policy: random, checkpoints up to medium (medium_replay), the medium or expert actor, or half of each.
    The noisy qualities (not in V-D4RL) add the task's noise to every action."""
    out: Path
    """Folder to write the dataset to."""
    episodes: int = 200
    """Number of episodes, of 501 rows each in the benchmark's tasks (V-D4RL's datasets have 200)."""
    seed: int = 0
    """Seed of initial states and actions."""
    workers: int = 0
    """Number of processes that simulate and render; 0: one per core."""
    render: Render = "fast"
    """exact: dm_control's default; fast: a smaller shadow map, with a mean difference of 0.03 of 255."""
    frame_size: int = FRAME_SIZE
    """Height and width of the frames in pixels."""
    episodes_per_shard: int = 50
    """Episodes per shard. An interrupted collection keeps its finished shards."""
    actor: Path | None = None
    """An actor file to use instead of the shipped one (for medium or expert)."""
    action_noise: float | None = None
    """Standard deviation of Gaussian noise added to every action, executed and stored. It becomes part of the name.
    Default: none, or the task's noise for the noisy qualities."""


@dataclass(frozen=True)
class _Job:
    """One episode to roll out."""

    task: Task
    episode: int
    seed: int
    actor: Actor | None
    render: Render
    size: int | None  # None: no rendering
    length: int | None
    noise: float


def collect(config: CollectConfig, length: int | None = None) -> list[Path]:
    """Collect a data set, or its missing shards; returns all shards.

    `length` is the time limit in decisions, for tests and demos; None: the task's.
    """
    check_config(config)
    refuse_inside(config.out)
    plan = list(_plan(config))
    noise = _noise(config)
    shards = [
        Shard(
            path,
            [_job(config, collector, episode, length) for episode in episodes],
            {
                "task": config.task,
                "set": set_quality(config),
                "policy": path.stem.split("_", 1)[1].removeprefix(f"{config.task}_"),
                "seed": config.seed,
                "render": config.render,
                "actor_sha256": collector.sha256 if collector else None,
                **({"action_noise": noise} if noise else {}),
                "versions": {k: v for k, v in versions().items() if k in ("mujoco", "dm-control", "vd4rl-pomdp")},
            },
        )
        for path, episodes, collector in plan
    ]
    settings = collection(config) | {"actors": actor_hashes(config)}
    collect_set(config.out, settings, shards, _roll_out, config.workers, ("collect", "episodes"), config.task)
    write_card(config.out)
    return [shard.path for shard in shards]


def collection(config: CollectConfig) -> dict[str, Any]:
    """Settings that identify a data set; its collection.json holds them together with its actors' hashes."""
    settings = {name: value for name, value in jsonable(asdict(config)).items() if name not in ("out", "workers")}
    if config.frame_size == FRAME_SIZE:
        settings["frame_size"] = None  # as in older files, which do not state it
    return settings


def actor_hashes(config: CollectConfig) -> list[str]:
    """Sorted SHA-256 of the actor files that collect the data set."""
    return sorted({collector.sha256 for _, _, collector in _plan(config) if collector is not None})


def check_config(config: CollectConfig) -> None:
    """Raise UserError for invalid settings."""
    task = TASKS.named(config.task)
    refuse_outside(config, episodes=(1, MOST_EPISODES), episodes_per_shard=1, seed=(0, MAX_SEED), workers=0)
    refuse_outside(config, action_noise=(0, MAX_NOISE), frame_size=FRAME_SIZES)
    refuse_unknown("quality to collect", config.quality, SET_QUALITIES)
    base = config.quality.removesuffix("_noisy")
    layout = layout_of(task)  # also refuses an environment that cannot be built
    if not layout.state_dim and base != "random":
        raise UserError(f"{config.task} has no states for an actor to read: use --quality random, or your own dataset")
    if base == "medium_expert" and config.episodes < 2:
        raise UserError(f"--episodes must be at least 2 for {config.quality}, which is half medium and half expert")
    if config.actor is not None and base not in ("medium", "expert"):
        raise UserError(
            f"--actor is for medium or expert datasets, not {config.quality}: leave it out or change --quality"
        )
    if config.action_noise is not None and config.quality in NOISY_QUALITIES:
        raise UserError(
            f"{config.quality} has its own noise: leave --action-noise out, or use it with --quality {base}"
        )
    if config.quality in NOISY_QUALITIES and task.action_noise is None:
        raise UserError(f"{config.task} has no action_noise: use --quality {base} with --action-noise")


def _noise(config: CollectConfig) -> float:
    own = TASKS.named(config.task).action_noise if config.quality in NOISY_QUALITIES else None
    return own or config.action_noise or 0.0


def set_quality(config: CollectConfig) -> str:
    """The quality recorded in the data set and in runs on it, including noise: "medium_noise0.3"."""
    return config.quality + (f"_noise{config.action_noise:g}" if config.action_noise else "")


def play(config: CollectConfig, length: int | None = None) -> Iterator[EpisodeArrays]:
    """Yield the episodes of `collect` without rendering or writing: the same seeds, actions and rewards."""
    jobs = [
        replace(_job(config, collector, episode, length), size=None)
        for _, episodes, collector in _plan(config)
        for episode in episodes
    ]
    with ProgressLine(f"play {config.task} {config.quality}", config.episodes, "episodes") as progress:
        for rollout in run_jobs(_roll_out, jobs, config.workers):
            progress.advance(1, ret=float(rollout["reward"].sum()))
            yield rollout


def _plan(config: CollectConfig) -> Iterator[tuple[Path, range, Collector]]:
    """Yield each shard's file, episode numbers and policy; for medium_expert all medium shards come first."""
    base = config.quality.removesuffix("_noisy")
    halves = ["medium", "expert"] if base == "medium_expert" else [base]
    suffix = set_quality(config).removeprefix(base)
    first = 0
    for number, quality in enumerate(halves):
        stop = config.episodes * (number + 1) // len(halves)
        collector: Collector = None
        if quality == "medium_replay":
            collector = load_ladder(config.task)
        elif quality != "random":
            collector = read_actor(config.actor, config.task) if config.actor else load_actor(config.task, quality)
        for shard, start in enumerate(range(first, stop, config.episodes_per_shard)):
            episodes = range(start, min(start + config.episodes_per_shard, stop))
            yield config.out / f"{shard}_{config.task}_{quality}{suffix}.hdf5", episodes, collector
        first = stop


def _job(config: CollectConfig, collector: Collector, episode: int, length: int | None = None) -> _Job:
    """Job of one episode. With a ladder, episode i of n uses the actor at (i + 0.5) / n of its training run."""
    actor = collector.actor_at((episode + 0.5) / config.episodes) if isinstance(collector, Ladder) else collector
    task, size = TASKS.named(config.task), config.frame_size
    return _Job(task, episode, config.seed, actor, config.render, size, length, _noise(config))


def _roll_out(job: _Job) -> EpisodeArrays:
    env = _environment(job.task, job.render, job.size, job.length)
    rng = np.random.default_rng([job.seed, job.episode])
    # A separate stream, so that the actor's samples are the same with and without noise.
    noise = np.random.default_rng(stream_seed(job.seed, "action noise", job.episode))
    now = env.reset(episode_seed(job.seed, job.episode))
    action = np.zeros(env.action_dim, np.float32)
    steps = [(now, action)]
    while not now.last:
        if job.actor is None:
            action = rng.uniform(-1.0, 1.0, env.action_dim).astype(np.float32)
        else:
            action = job.actor.act(now.state, rng)
        if job.noise:
            shaken = action + job.noise * noise.standard_normal(action.shape)
            action = shaken.clip(-1.0, 1.0).astype(np.float32)
        now = env.step(action)
        steps.append((now, action))
    frames = {} if job.size is None else {"observation": np.stack([step.frame for step, _ in steps])}
    states = {"physics": np.stack([step.physics for step, _ in steps])} if now.physics.size else {}
    return frames | {
        "action": np.stack([action for _, action in steps]),
        "reward": np.array([step.reward for step, _ in steps]),
        "discount": np.array([step.discount for step, _ in steps]),
        "step_type": np.array([int(step.step_type) for step, _ in steps]),
        **states,
    }


_environment: Callable[..., Any] = cache(make_env)
"""Per process, so that all its episodes share one GL context."""
