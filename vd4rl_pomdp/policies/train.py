"""Train the data-collecting policies: soft actor-critic on simulator states (SBX), resumable, exported as small files.

A run keeps `snapshots/` (an actor and its mean return every `eval_every` decisions), `curve.csv`,
`networks.safetensors` (what another machine can start from) and `checkpoints/` (networks, optimisers, replay buffer).
At its end, or with `policy export` at any time, the best snapshot becomes the expert, the one whose return is nearest
to half of the expert's the medium actor, and a ladder of snapshots up to the medium one stands for the replay buffer.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vd4rl_pomdp.core.errors import MAX_SEED, MOST, UserError, refuse_outside
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.policies import learner
from vd4rl_pomdp.policies.actor import Actor
from vd4rl_pomdp.policies.config import PolicyConfig
from vd4rl_pomdp.policies.export import (
    CARD_SEED,
    CURVE,
    CURVE_COLUMNS,
    NETWORKS,
    PROGRESS,
    SETTINGS,
    episode_returns,
    export_run,
    exported_actors,
    read_curve,
    snapshot_path,
)
from vd4rl_pomdp.runs import FORMAT, interrupt
from vd4rl_pomdp.runs.checkpoint import Checkpoints
from vd4rl_pomdp.runs.files import holds_anything, jsonable, read_json, write_csv, write_json
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.ownership import owned

if TYPE_CHECKING:
    from sbx import SAC

MOST_ENVS = 1000
"""Most environments of a run, which live in one process."""


def train_policy(config: PolicyConfig, on_progress: Callable[[int, float], None] | None = None) -> dict[str, Path]:
    """Train, or go on training, and export the actors.

    Args:
        config: the run's settings; an existing run folder must hold the same ones.
        on_progress: called after every evaluation with (decisions made, mean return).

    Returns:
        The exported files by quality.

    Raises:
        UserError: an unknown task or one without states, settings out of range, or a folder of another run.
    """
    task = TASKS.named(config.task)
    refuse_inside(config.out)
    _check(config)
    with owned(config.out):
        _check_folder(config)  # another process may have begun it since
        model = learner.build(config, task)
        if not (config.out / SETTINGS).exists():
            write_json(config.out / SETTINGS, _settings(config))
        _learn(model, config, on_progress)
        return export_run(config.out, config.out)


def _learn(model: SAC, config: PolicyConfig, on_progress: Callable[[int, float], None] | None) -> None:
    """Train to the end, from the newest checkpoint if there is one."""
    done = learner.restore_checkpoint(model, config.out)
    _forget_newer(config.out, done)
    if done == 0 and config.start_from is not None:
        done = _start_from(model, config, config.start_from)
    mean = next((mean for _, mean in reversed(_curve(config.out))), -np.inf)
    while done < config.decisions and mean < config.stop_at:
        with interrupt.deferred():
            mean = _learn_and_evaluate(model, config, done)
            done = int(model.num_timesteps)
            learner.save_checkpoint(model, config.out)
            interrupt.check(f"{config.out} keeps {done} decisions")
        if on_progress is not None:
            on_progress(done, mean)


def _learn_and_evaluate(model: SAC, config: PolicyConfig, done: int) -> float:
    """Learn until the next evaluation, or until a signal asks for the end; the mean return goes to the curve."""
    decisions = min(config.eval_every, config.decisions - done)
    model.learn(decisions, callback=lambda *_: not interrupt.asked(), reset_num_timesteps=done == 0)
    if interrupt.asked():
        return -np.inf
    actor = learner.export_actor(model, config, int(model.num_timesteps))
    first_seed = CARD_SEED - config.eval_episodes
    mean = float(np.mean(episode_returns(actor, TASKS.named(config.task), config.eval_episodes, first_seed)))
    _record(config.out, actor, int(model.num_timesteps), mean)
    learner.save_networks(model, config.out / NETWORKS)
    return mean


def decisions_made(run: Path) -> int:
    """Decisions behind a run's newest checkpoint, 0 for a new run."""
    return max(Checkpoints(run).steps(), default=0)


def _check(config: PolicyConfig) -> None:
    """Raise UserError for settings out of range, or that need too much memory, and for a folder of another run."""
    task = TASKS.named(config.task)
    if not layout_of(task).state_dim:
        raise UserError(f"{config.task} has no states for an actor to read: choose a task of dm_control")
    refuse_outside(
        config, seed=(0, MAX_SEED), decisions=1, learning_rate=0, hidden=1, n_step=(1, task.decisions),
        envs=(1, MOST_ENVS), updates_per_decision=0, batch_size=1, temperature=0, temperature_rate=0,
        target_entropy=(-MOST, MOST), replay_size=1, eval_every=1, eval_episodes=(1, CARD_SEED),
        stop_at=(-MOST, MOST), refill=0, critic_warmup=0,
    )  # fmt: skip
    if config.temperature == 0:
        raise UserError("--temperature is 0; it must be above: it is where a learnt one starts")
    _check_folder(config)


def _settings(config: PolicyConfig) -> dict[str, Any]:
    """What config.json keeps: all settings but the folder and the run's length, which may change."""
    kept = {k: v for k, v in jsonable(asdict(config)).items() if k not in ("out", "decisions", "stop_at")}
    return kept | {"format": FORMAT}


def _check_folder(config: PolicyConfig) -> None:
    """Raise UserError for a folder that holds a run with other settings, or something else."""
    settings, path = _settings(config), config.out / SETTINGS
    if path.exists():
        stored = read_json(path)
        if stored.get("format", 1) != FORMAT:
            raise UserError(
                f"{config.out}: holds a run of format {stored.get('format', 1)}, this version writes format {FORMAT} "
                "and cannot go on with it; choose another --out, to which --start-from may bring its networks"
            )
        differing = [k for k in settings if stored.get(k) != settings[k]]
        if differing:
            raise UserError(f"{config.out}: holds a run with another {', '.join(differing)}; choose another --out")
        return
    if holds_anything(config.out):
        raise UserError(f"{config.out}: is not empty and holds no policy run; choose another --out")
    if config.start_from is not None:
        _check_start(config, config.start_from)


def _check_start(config: PolicyConfig, start: Path) -> None:
    """Raise UserError unless a folder holds a policy run of the task, with an evaluation in its curve."""
    missing = [name for name in PROGRESS if not (start / name).exists()]
    if missing:
        raise UserError(f"{start}: has no {' and no '.join(missing)}; --start-from takes the folder of a policy run")
    task = read_json(start / SETTINGS).get("task")
    if task != config.task:
        raise UserError(f"{start}: is a run of {task}, not of {config.task}")
    if not (curve := read_curve(start)):
        raise UserError(f"{start}: its curve.csv holds no evaluation; --start-from takes a run that got to its first")
    done, mean = curve[-1]
    if done + config.refill >= config.decisions:
        raise UserError(
            f"{start}: has made {done} decisions, and --refill adds {config.refill}: nothing is left of --decisions "
            f"{config.decisions}; give more"
        )
    if mean >= config.stop_at:
        raise UserError(f"{start}: returns {mean} already; give a --stop-at above it")
    if config.refill == 0 and config.critic_warmup > 0:
        raise UserError("--refill 0 leaves no decision for --critic-warmup to learn from; give it 0, too")


def _start_from(model: SAC, config: PolicyConfig, start: Path) -> int:
    """Take over another run's networks, curve and snapshots; its replay is made anew. Returns the decisions so far."""
    learner.start_from_networks(model, start / NETWORKS)
    curve = read_curve(start)
    (config.out / "snapshots").mkdir(exist_ok=True)
    for step, actor in exported_actors(start, config.task):
        actor.save(snapshot_path(config.out, step))
    for step, _ in curve:
        if snapshot_path(start, step).exists():
            shutil.copy(snapshot_path(start, step), snapshot_path(config.out, step))
    _write_curve(config.out, curve)
    model.num_timesteps = curve[-1][0]
    learner.refill(model, config.refill, config.critic_warmup)
    return int(model.num_timesteps)


def _record(run: Path, actor: Actor, decisions: int, mean: float) -> None:
    actor.save(snapshot_path(run, decisions))
    _write_curve(run, [*_curve(run), (decisions, mean)])


def _curve(run: Path) -> list[tuple[int, float]]:
    """What a run has of its curve; empty before the first evaluation."""
    return read_curve(run) if (run / CURVE).exists() else []


def _write_curve(run: Path, curve: list[tuple[int, float]]) -> None:
    rows = ({"decisions": step, "return_mean": f"{mean:.3f}"} for step, mean in curve)
    write_csv(run / CURVE, CURVE_COLUMNS, rows)


def _forget_newer(run: Path, decisions: int) -> None:
    """Drop what a cut run wrote into its curve after its last checkpoint."""
    if (run / CURVE).exists():
        _write_curve(run, [row for row in read_curve(run) if row[0] <= decisions])
