"""How exact a state must an actor have? It plays on its observations with white noise, drawn anew each time.

    python tools/noisy_states.py --tasks walker_walk cheetah_run --actors expert medium --out noisy_states.csv

The noise is a share of each coordinate's deviation in episodes of the same actor with noise on its actions, as the
noisy sets hold them; the mean action is played, in the episodes of every evaluation. Nothing is learnt, so that what
is lost is lost to the errors. Columns: what was asked for, the episode and its return.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from export_actor import StateEnv
from script import run_script

from finetune.evaluation import EVALUATION_SEED
from vd4rl_pomdp.core.errors import UserError, refuse_outside
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.tasks import MOST_EPISODES, TASKS
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.policies.actor import Actor, load_actor
from vd4rl_pomdp.runs.files import write_csv
from vd4rl_pomdp.runs.outputs import refuse_inside


@dataclass(frozen=True)
class Config:
    """Settings of the measurement."""

    tasks: tuple[str, ...] = ("walker_walk", "cheetah_run")
    """Tasks whose observations are positions and velocities."""
    actors: tuple[Literal["medium", "expert"], ...] = ("expert", "medium")
    """Whose states: the actors that ship."""
    pose_noises: tuple[float, ...] = (0, 5, 10, 23, 34)
    """Mean errors of the positions, in percent of a deviation."""
    velocity_noises: tuple[float, ...] = (0, 7, 14, 31, 49)
    """Mean errors of the velocities, one for each of the positions'."""
    episodes: int = 20
    """Episodes of each, and of those that the deviations are taken from."""
    out: Path = Path("noisy_states.csv")
    """CSV file to write."""


def play(actor: Actor, env: StateEnv, seed: int, std: np.ndarray, action_std: float) -> tuple[float, np.ndarray]:
    """Return and true states (rows, D) of one episode.

    Args:
        actor: who acts.
        env: where.
        seed: of the episode and of its noise.
        std: (D,) noise on what the actor sees.
        action_std: noise on what it does.
    """
    rng = np.random.default_rng(seed)
    states, total, ended = [env.reset(seed=seed)[0]], 0.0, False
    while not ended:
        action = actor.act((states[-1] + std * rng.standard_normal(len(std))).astype(np.float32))
        action = np.clip(action + action_std * rng.standard_normal(len(action)), -1, 1).astype(np.float32)
        state, reward, terminated, truncated, _ = env.step(action)
        states.append(state)
        total, ended = total + reward, terminated or truncated
    return total, np.stack(states)


def measure(name: str, who: str, config: Config) -> list[dict[str, Any]]:
    """The rows of an actor of a task, which are told as they come."""
    task, actor = TASKS.named(name), load_actor(name, who)
    env, layout = StateEnv(task), layout_of(task)
    if layout.quaternions:
        raise UserError(f"--tasks {name}: its observations are not positions and velocities; choose a planar task")
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + config.episodes)
    for noise in (0.0, task.action_noise or 0.0):
        played = [play(actor, env, seed, np.zeros(layout.state_dim), noise)[1] for seed in seeds]
        scale = StateScale.fit(torch.from_numpy(np.concatenate(played)), layout.state_dim - layout.positions)
        print(
            f"{name} {who}, deviations under noise {noise}:",
            *(f"{value:.3g}" for value in scale.std.tolist()),
            flush=True,
        )
    rows: list[dict[str, Any]] = []
    for pose, velocity in zip(config.pose_noises, config.velocity_noises, strict=True):
        std = scale.noise(pose, velocity).numpy()
        returns = [play(actor, env, seed, std, 0.0)[0] for seed in seeds]
        named = {"task": name, "actor": who, "pose_noise": pose, "velocity_noise": velocity}
        rows += [named | {"episode": n, "return": round(value, 4)} for n, value in enumerate(returns)]
        told = f"{np.mean(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
        print(f"{name} {who}, {pose} and {velocity}%: {told}", flush=True)
    return rows


def main(config: Config) -> None:
    """Play all episodes and write the table."""
    if len(config.pose_noises) != len(config.velocity_noises):
        raise UserError("--pose-noises and --velocity-noises: give as many of one as of the other")
    refuse_outside(config, episodes=(1, MOST_EPISODES))
    refuse_inside(config.out)
    rows = [row for name in config.tasks for who in config.actors for row in measure(name, who, config)]
    write_csv(config.out, list(rows[0]), rows)


if __name__ == "__main__":
    run_script(main, Config)
