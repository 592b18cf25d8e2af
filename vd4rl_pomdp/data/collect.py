"""Collect a set in V-D4RL's format, with simulator states and a data card, from the actors that ship with the package.

Episode i depends on (seed, i) alone, whatever the number of workers. Shards are written whole, so the same command goes
on after an interruption and ends in the same files.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd4rl_pomdp.data.format import PLAN, RECORD, write_shard
from vd4rl_pomdp.errors import MAX_SEED, UserError, disk_error, refuse_outside
from vd4rl_pomdp.policies.actor import Actor, Ladder, load_actor, load_ladder, read_actor
from vd4rl_pomdp.runs.folder import jsonable, read_json, write_json
from vd4rl_pomdp.runs.memory import CPU, require_memory
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.provenance import command, git_commit, versions
from vd4rl_pomdp.runs.workers import count_workers, run_jobs
from vd4rl_pomdp.tasks import EPISODE_TRANSITIONS, FRAME_SIZE, MOST_EPISODES, QUALITIES, Quality, get_task

Policy = Actor | Ladder | None
"""Who acts in a shard: an actor, a ladder of them, or nobody (random actions)."""
_RUNTIME_FIELDS = ("out", "workers")


@dataclass(frozen=True)
class CollectConfig:
    """Settings of `vd4rl-pomdp data collect`."""

    task: str
    """walker_walk, cheetah_run or humanoid_walk."""
    quality: Quality
    """Whose episodes: random actions, actors saved on the way to the medium one, the medium actor, half of medium and
    expert each, or the expert actor."""
    out: Path
    """Folder of the set."""
    episodes: int = 200
    """Episodes in all, 501 rows each (V-D4RL's sets have 200)."""
    seed: int = 0
    """Seed of initial states and actions."""
    workers: int = 0
    """Processes that simulate and render; 0 uses every core."""
    render: Literal["fast", "exact"] = "fast"
    """fast: a smaller shadow map, 0.03 of 255 away from exact; exact: dm_control's default."""
    episodes_per_shard: int = 50
    """Episodes in a shard."""
    actor: Path | None = None
    """An actor file to use instead of the shipped one (for medium or expert)."""


@dataclass(frozen=True)
class _Job:
    """One episode to roll out."""

    task: str
    episode: int
    seed: int
    actor: Actor | None
    render: Literal["fast", "exact"] | None
    """None: physics alone, no frames."""
    length: int


def collect(config: CollectConfig, length: int = EPISODE_TRANSITIONS) -> list[Path]:
    """Collect the set, or what is missing of it; returns its shards.

    Args:
        config: what to collect.
        length: decisions an episode; everything but tests keeps the benchmark's.
    """
    _check(config)
    plan = list(_plan(config))
    _claim(config, _hashes(plan))
    started, frames = time.monotonic(), 0
    with ProgressLine("collect", config.episodes, "episodes") as progress:
        for path, episodes, policy in plan:
            if path.exists():
                progress.advance(len(episodes))
                continue
            jobs = [_job(config, policy, episode, length) for episode in episodes]
            rollouts = []
            for rollout in run_jobs(_roll_out, jobs, config.workers):
                rollouts.append(rollout)
                frames += len(rollout["reward"])
                speed = frames / (time.monotonic() - started)
                progress.advance(1, ret=float(rollout["reward"].sum()), frames_per_s=speed)
            write_shard(path, join_rollouts(rollouts), _attributes(config, path, policy))
    seconds = time.monotonic() - started
    record_set(config.out, seconds, frames, config.workers)
    from vd4rl_pomdp.data.card import write_card  # draws; the processes that render need it not

    write_card(config.out)
    return [path for path, _, _ in plan]


def _check(config: CollectConfig) -> None:
    """Refuse settings that make no set."""
    get_task(config.task)
    refuse_outside(config, episodes=(1, MOST_EPISODES), episodes_per_shard=1, seed=(0, MAX_SEED), workers=0)
    shard = min(config.episodes, config.episodes_per_shard) * (EPISODE_TRANSITIONS + 1)
    require_memory(shard * 3 * FRAME_SIZE**2, CPU, config, "episodes", "episodes_per_shard")
    if config.quality not in QUALITIES:
        raise UserError(f"cannot collect quality {config.quality!r}: choose one of {', '.join(QUALITIES)}")
    if config.quality == "medium_expert" and config.episodes < 2:
        raise UserError("--episodes must be at least 2 for medium_expert, which is half medium and half expert")
    if config.actor is not None and config.quality not in ("medium", "expert"):
        raise UserError(f"--actor is for medium or expert sets, not {config.quality}: leave it out or change --quality")


def actor_hashes(config: CollectConfig) -> list[str]:
    """SHA-256 of the files whose actors make the set, sorted."""
    return _hashes(_plan(config))


def _hashes(plan: Iterable[tuple[Path, range, Policy]]) -> list[str]:
    return sorted({policy.sha256 for _, _, policy in plan if policy is not None})


def replay_returns(config: CollectConfig) -> list[float]:
    """Returns of all episodes that `collect` would render, by physics alone: the same seeds, actions and rewards."""
    jobs = [
        replace(_job(config, policy, episode, EPISODE_TRANSITIONS), render=None)
        for _, episodes, policy in _plan(config)
        for episode in episodes
    ]
    with ProgressLine(f"play {config.task} {config.quality}", config.episodes, "episodes") as progress:
        returns = []
        for rollout in run_jobs(_roll_out, jobs, config.workers):
            returns.append(float(rollout["reward"].sum()))
            progress.advance(1, ret=returns[-1])
    return returns


def episode_seed(seed: int, episode: int) -> int:
    """Environment seed of an episode of a set."""
    digest = hashlib.blake2b(f"{seed}/{episode}".encode(), digest_size=4).digest()
    return int.from_bytes(digest, "little") & 0x7FFFFFFF


def _plan(config: CollectConfig) -> Iterator[tuple[Path, range, Policy]]:
    """Shards to write: file, episode numbers, policy. medium_expert is all medium shards, then all expert ones."""
    halves = ["medium", "expert"] if config.quality == "medium_expert" else [config.quality]
    first = 0
    for number, quality in enumerate(halves):
        stop = config.episodes * (number + 1) // len(halves)
        policy = _policy(config, quality)
        for shard, start in enumerate(range(first, stop, config.episodes_per_shard)):
            episodes = range(start, min(start + config.episodes_per_shard, stop))
            yield config.out / f"{shard}_{config.task}_{quality}.hdf5", episodes, policy
        first = stop


def _policy(config: CollectConfig, quality: str) -> Policy:
    if quality == "random":
        return None
    if quality == "medium_replay":
        return load_ladder(config.task)
    if config.actor is None:
        return load_actor(config.task, quality)
    return read_actor(config.actor, get_task(config.task))


def _job(config: CollectConfig, policy: Policy, episode: int, length: int) -> _Job:
    """One episode; with a ladder, by who acted at the moment of training that the episode stands for."""
    actor = policy.actor_at((episode + 0.5) / config.episodes) if isinstance(policy, Ladder) else policy
    return _Job(config.task, episode, config.seed, actor, config.render, length)


def _roll_out(job: _Job) -> dict[str, np.ndarray]:
    """Rows of one episode, by key."""
    env = _environment(job.task, job.render, job.length)
    rng = np.random.default_rng([job.seed, job.episode])
    row = env.reset(episode_seed(job.seed, job.episode))
    action = np.zeros(env.task.action_dim, np.float32)
    rows = [(row, action)]
    while not row.last:
        if job.actor is None:
            action = rng.uniform(-1.0, 1.0, env.task.action_dim).astype(np.float32)
        else:
            action = job.actor.act(row.state, rng)
        row = env.step(action)
        rows.append((row, action))
    frames = {} if job.render is None else {"observation": np.stack([r.frame for r, _ in rows])}
    return frames | {
        "action": np.stack([a for _, a in rows]),
        "reward": np.array([r.reward for r, _ in rows]),
        "discount": np.array([r.discount for r, _ in rows]),
        "step_type": np.array([int(r.step_type) for r, _ in rows]),
        "physics": np.stack([r.physics for r, _ in rows]),
    }


_ENVIRONMENTS: dict[tuple, Any] = {}


def _environment(*arguments: Any) -> Any:
    """The process's environment for these arguments: one GL context serves all its episodes."""
    from vd4rl_pomdp.envs.dmc import PixelEnv

    if arguments not in _ENVIRONMENTS:
        task, render, length = arguments
        pixels = render is not None
        _ENVIRONMENTS[arguments] = PixelEnv(task, render or "fast", pixels, length)
    return _ENVIRONMENTS[arguments]


def join_rollouts(rollouts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Rows of several episodes, in order."""
    return {key: np.concatenate([rollout[key] for rollout in rollouts]) for key in rollouts[0]}


def _attributes(config: CollectConfig, path: Path, policy: Policy) -> dict[str, Any]:
    return {
        "task": config.task,
        "set": config.quality,
        "policy": path.stem.split("_", 1)[1].removeprefix(f"{config.task}_"),
        "seed": config.seed,
        "render": config.render,
        "actor_sha256": policy.sha256 if policy else None,
        "versions": {k: v for k, v in versions().items() if k in ("mujoco", "dm-control", "vd4rl-pomdp")},
    }


def _claim(config: CollectConfig, actors: list[str]) -> None:
    settings = {k: v for k, v in jsonable(asdict(config)).items() if k not in _RUNTIME_FIELDS}
    settings["actors"] = actors
    claim_set(config.out, settings)


def claim_set(out: Path, settings: dict[str, Any]) -> None:
    """Write collection.json, or check that the folder holds the same collection."""
    path = out / PLAN
    if path.exists():
        stored = read_json(path)
        differing = sorted(k for k in settings if stored.get(k) != settings[k])
        if differing:
            raise UserError(f"{out}: holds a set collected with another {', '.join(differing)}; choose another --out")
        return
    if out.exists() and any(not file.name.startswith(".") for file in out.iterdir()):
        raise UserError(f"{out}: is not empty and holds no collected set; choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(out, error) from error
    _write_json(path, settings)


def record_set(out: Path, seconds: float, frames: int, workers: int) -> None:
    """Keep what a repeated collection would not reproduce."""
    path = out / RECORD
    if not frames and path.exists():
        return
    from vd4rl_pomdp.envs.parity import render_info

    facts = {"seconds": round(seconds, 1), "frames": frames, "workers": count_workers(workers)}
    origin = {"command": command(), "git_commit": git_commit(), "versions": versions()}
    _write_json(path, facts | origin | {"render": render_info()})


def _write_json(path: Path, value: dict[str, Any]) -> None:
    try:
        write_json(path, value)
    except OSError as error:
        raise disk_error(path, error) from error
