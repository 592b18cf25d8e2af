"""Train the data-collecting policies: soft actor-critic on simulator states (SBX), resumable, exported as small files.

A run keeps `snapshots/` (an actor and its mean return every `eval_every` decisions), `curve.csv` and `checkpoint/`
(networks, optimisers, replay buffer). At its end the best snapshot becomes `expert.safetensors`, and the one whose
return is nearest to half of the expert's becomes `medium.safetensors`; both are judged on the same 20 episodes.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import load_file, save_file

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.policies.actor import Actor, read_actor
from vd4rl_pomdp.policies.state_env import StateEnv
from vd4rl_pomdp.tasks import Task, get_task

if TYPE_CHECKING:
    from sbx import SAC

CARD_EPISODES = 20
CARD_SEED = 10_000
"""Episode i of an actor's card starts from environment seed CARD_SEED + i."""
REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass(frozen=True)
class PolicyConfig:
    """Settings of one policy training run."""

    task: str
    """walker_walk, cheetah_run or humanoid_walk."""
    out: Path
    """Run folder; the same command continues a run that was cut."""
    decisions: int = 300_000
    """Environment decisions in all (two simulator steps each)."""
    seed: int = 0
    """Seed of the networks, the replay draws and the training episodes."""
    learning_rate: float = 7e-4
    """Adam's learning rate, for actor, critics and temperature."""
    hidden: int = 256
    """Units of each of the two hidden layers."""
    batch_size: int = 256
    """Transitions in a gradient step; one step is made for each decision."""
    eval_every: int = 5_000
    """Decisions between two snapshots."""
    eval_episodes: int = 5
    """Episodes behind each point of the learning curve."""
    stop_at: float = 1000.0
    """End early once a snapshot's mean return reaches this."""


def train_policy(config: PolicyConfig, on_progress: Callable[[int, float], None] | None = None) -> dict[str, Path]:
    """Train, or go on training, and export the expert and the medium actor.

    Args:
        config: the run's settings; an existing run folder must hold the same ones.
        on_progress: called after every evaluation with (decisions made, mean return).

    Returns:
        The exported files by quality.
    """
    task = get_task(config.task)
    _claim(config)
    model = _build(config, task)
    done = _restore(model, config.out)
    while done < config.decisions:
        model.learn(min(config.eval_every, config.decisions - done), reset_num_timesteps=done == 0)
        done = int(model.num_timesteps)
        actor = _export(model, config, done)
        mean = float(np.mean(episode_returns(actor, task, config.eval_episodes, CARD_SEED - config.eval_episodes)))
        _record(config.out, actor, done, mean)
        _save(model, config.out)
        if on_progress is not None:
            on_progress(done, mean)
        if mean >= config.stop_at:
            break
    return _choose(config, task)


def episode_returns(actor: Actor, task: Task, episodes: int, first_seed: int = CARD_SEED) -> list[float]:
    """Returns of the actor's mean action on episodes seeded first_seed, first_seed + 1, ..."""
    env = StateEnv(task)
    returns = []
    for episode in range(episodes):
        state, _ = env.reset(seed=first_seed + episode)
        total, ended = 0.0, False
        while not ended:
            state, reward, _, ended, _ = env.step(actor.act(state))
            total += reward
        returns.append(total)
    return returns


def read_curve(run: Path) -> list[tuple[int, float]]:
    """Learning curve of a run: (decisions, mean return) rows."""
    with (run / "curve.csv").open(newline="") as file:
        return [(int(row["decisions"]), float(row["return_mean"])) for row in csv.DictReader(file)]


def decisions_made(run: Path) -> int:
    """Decisions behind a run's newest checkpoint, 0 for a new run."""
    counters = run / "checkpoint" / "counters.json"
    return int(json.loads(counters.read_text())["decisions"]) if counters.exists() else 0


def _claim(config: PolicyConfig) -> None:
    """Write the run's config, or check that the folder holds the same one (its length may grow)."""
    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "decisions", "stop_at")}
    path = config.out / "config.json"
    if path.exists():
        stored = json.loads(path.read_text())
        differing = [k for k in settings if stored.get(k) != settings[k]]
        if differing:
            raise UserError(f"{config.out}: holds a run with another {', '.join(differing)}; choose another --out")
        return
    (config.out / "snapshots").mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(settings, indent=2) + "\n")


def _build(config: PolicyConfig, task: Task) -> SAC:
    try:
        from sbx import SAC
    except ImportError as error:
        raise UserError("policy training needs SBX: install it with `pip install 'vd4rl-pomdp[policy]'`") from error
    return SAC(
        "MlpPolicy",
        StateEnv(task),
        learning_rate=config.learning_rate,
        buffer_size=1_000_000,
        learning_starts=1_000,
        batch_size=config.batch_size,
        train_freq=4,
        gradient_steps=4,
        policy_kwargs={"net_arch": [config.hidden, config.hidden]},
        seed=config.seed,
    )


def _export(model: SAC, config: PolicyConfig, decisions: int) -> Actor:
    """The SBX actor's parameters as an `Actor`: its dense layers in order are the hidden ones, mean and log_std."""
    layers = model.policy.actor_state.params["params"]
    names = [f"hidden.{i}" for i in range(len(layers) - 2)] + ["mean", "log_std"]
    weights = {}
    for index, name in enumerate(names):
        weights[f"{name}.weight"] = np.asarray(layers[f"Dense_{index}"]["kernel"])
        weights[f"{name}.bias"] = np.asarray(layers[f"Dense_{index}"]["bias"])
    card = {"task": config.task, "decisions": decisions, "algorithm": "SAC", "seed": config.seed}
    return Actor(weights, card)


def _record(run: Path, actor: Actor, decisions: int, mean: float) -> None:
    actor.save(run / "snapshots" / f"{decisions:08d}.safetensors")
    curve = run / "curve.csv"
    new = not curve.exists()
    with curve.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(["decisions", "return_mean"])
        writer.writerow([decisions, f"{mean:.3f}"])


def _leaves(model: SAC) -> tuple[list[Any], Any]:
    """Everything SBX learns, as a flat list of arrays and the structure to rebuild it."""
    import jax

    states = (model.policy.actor_state, model.policy.qf_state, model.ent_coef_state, model.key)
    return jax.tree_util.tree_flatten(states)


def _save(model: SAC, run: Path) -> None:
    """Write the checkpoint beside the old one and exchange the two."""
    fresh, current, old = run / "checkpoint.new", run / "checkpoint", run / "checkpoint.old"
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir()
    leaves, _ = _leaves(model)
    save_file({f"{i:04d}": np.array(leaf) for i, leaf in enumerate(leaves)}, fresh / "model.safetensors")
    buffer: Any = model.replay_buffer
    stop = buffer.buffer_size if buffer.full else buffer.pos
    save_file({k: np.ascontiguousarray(getattr(buffer, k)[:stop]) for k in REPLAY_ARRAYS}, fresh / "replay.safetensors")
    counters = {"decisions": model.num_timesteps, "updates": model._n_updates, "position": buffer.pos}
    (fresh / "counters.json").write_text(json.dumps(counters))
    shutil.rmtree(old, ignore_errors=True)
    if current.exists():
        current.rename(old)
    fresh.rename(current)
    shutil.rmtree(old, ignore_errors=True)


def _restore(model: SAC, run: Path) -> int:
    """Load the newest whole checkpoint; returns the decisions made so far. A new episode begins there."""
    import jax

    folder = run / "checkpoint" if (run / "checkpoint").exists() else run / "checkpoint.old"
    if not folder.exists():
        return 0
    stored = load_file(folder / "model.safetensors")
    leaves, structure = _leaves(model)
    restored = [np.asarray(stored[f"{i:04d}"], dtype=np.asarray(leaf).dtype) for i, leaf in enumerate(leaves)]
    states = jax.tree_util.tree_unflatten(structure, [jax.numpy.asarray(leaf) for leaf in restored])
    model.policy.actor_state, model.policy.qf_state, model.ent_coef_state, model.key = states
    counters = json.loads((folder / "counters.json").read_text())
    replay = load_file(folder / "replay.safetensors")
    stop = len(replay["rewards"])
    buffer: Any = model.replay_buffer
    for name in REPLAY_ARRAYS:
        getattr(buffer, name)[:stop] = replay[name]
    buffer.pos = counters["position"]
    buffer.full = stop == buffer.buffer_size
    model.num_timesteps, model._n_updates = counters["decisions"], counters["updates"]
    _forget_newer(run, counters["decisions"])
    return int(counters["decisions"])


def _forget_newer(run: Path, decisions: int) -> None:
    """Drop curve rows and snapshots that a cut run wrote after its last checkpoint."""
    kept = [row for row in read_curve(run) if row[0] <= decisions]
    (run / "curve.csv").unlink()
    for row, mean in kept:
        _record(run, read_actor(run / "snapshots" / f"{row:08d}.safetensors"), row, mean)


def _choose(config: PolicyConfig, task: Task) -> dict[str, Path]:
    """Export the best snapshot as expert, and the one nearest to half of its return as medium."""
    curve = read_curve(config.out)
    best = sorted(curve, key=lambda row: row[1])[-3:]
    judged = {step: episode_returns(_snapshot(config.out, step), task, CARD_EPISODES) for step, _ in best}
    expert = max(judged, key=lambda step: float(np.mean(judged[step])))
    half = float(np.mean(judged[expert])) / 2
    near = sorted((row for row in curve if row[0] < expert), key=lambda row: abs(row[1] - half))[:3]
    judged |= {step: episode_returns(_snapshot(config.out, step), task, CARD_EPISODES) for step, _ in near}
    medium = min((step for step, _ in near), key=lambda step: abs(float(np.mean(judged[step])) - half), default=expert)
    return {
        quality: _publish(config, quality, step, judged[step], curve)
        for quality, step in (("expert", expert), ("medium", medium))
    }


def _snapshot(run: Path, step: int) -> Actor:
    return read_actor(run / "snapshots" / f"{step:08d}.safetensors")


def _publish(
    config: PolicyConfig, quality: str, step: int, returns: list[float], curve: list[tuple[int, float]]
) -> Path:
    """Write the actor with its card, and beside it the learning curve."""
    settings = {k: v for k, v in asdict(config).items() if k != "out"}
    card = {
        "task": config.task,
        "quality": quality,
        "decisions": step,
        "return_mean": round(float(np.mean(returns)), 3),
        "return_min": round(min(returns), 3),
        "return_max": round(max(returns), 3),
        "returns_seeds": [CARD_SEED, CARD_SEED + CARD_EPISODES - 1],
        "config": settings,
        "versions": {name: version(name) for name in ("sbx-rl", "jax", "dm-control", "mujoco", "numpy")},
    }
    path = config.out / f"{config.task}_{quality}.safetensors"
    Actor(_snapshot(config.out, step).weights, card).save(path)
    path.with_suffix(".json").write_text(json.dumps(card | {"learning_curve": curve}, indent=1) + "\n")
    return path
