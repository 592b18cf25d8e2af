"""Conformance checks of tasks: reproducible episodes, layout, rewards, episode ends and discounts, replay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.envs.make import layout_of, make_env
from vd4rl_pomdp.envs.pixels import PixelEnv, TimeStep
from vd4rl_pomdp.testing.contract import Check, claim, run_checks

SIZE = 32
DECISIONS = 12


def check_task(name: str) -> None:
    """Run all checks on a task of `vd4rl_pomdp.core.tasks.TASKS` by playing a few short episodes.

    UserError also if its environment cannot be built or returns no images or numeric rewards.
    """
    TASKS.named(name)
    run_checks("task", CHECKS, name)


def make(name: str, size: int | None = None, length: int = DECISIONS) -> PixelEnv:
    """A task's environment with short episodes."""
    return make_env(TASKS.named(name), size=size, length=length)


def play(env: PixelEnv, seed: int) -> tuple[list[TimeStep], np.ndarray]:
    """Play one episode with fixed random actions; returns its rows and the actions (T, A) float32."""
    rng = np.random.default_rng(0)
    rows: list[TimeStep] = [env.reset(seed)]
    actions: list[np.ndarray] = []
    while not rows[-1].last:
        claim(len(actions) < DECISIONS, f"an episode of {DECISIONS} decisions does not end")
        actions.append(rng.uniform(-1, 1, env.action_dim).astype(np.float32))
        rows.append(env.step(actions[-1]))
    return rows, np.stack(actions)


def episodes_repeat_from_their_seeds(name: str) -> None:
    """Seed and actions determine an episode, in a used and in a new environment."""
    env = make(name, SIZE)
    first, _ = play(env, 3)
    play(env, 4)
    for again in (play(env, 3)[0], play(make(name, SIZE), 3)[0]):
        claim(len(again) == len(first), f"it had {len(first)} rows and has {len(again)}")
        for t, (one, other) in enumerate(zip(first, again, strict=True)):
            same = (np.array_equal(getattr(one, part), getattr(other, part)) for part in ("frame", "state", "physics"))
            claim(all(same), f"row {t} differs in frame or state: draw from the seed passed to reset")
            claim(one.reward == other.reward, f"row {t} has the rewards {one.reward} and {other.reward}")


def rows_have_the_declared_widths(name: str) -> None:
    """States match the declared layout; rewards are finite, and 0 in the first row."""
    task = TASKS.named(name)
    found = layout_of(replace(task, layout=None))
    claim(layout_of(task) == found, f"its layout says {task.layout}, the environment has {found}")
    rows, actions = play(make(name), 0)
    claim(actions.shape[1] == found.action_dim, f"{actions.shape[1]} action dimensions, not {found.action_dim}")
    claim(rows[0].reward == 0, f"the first row has the reward {rows[0].reward}")
    width = rows[0].physics.size
    for row in rows:
        claim(row.frame is None, "a frame is rendered that was not requested")
        claim((row.state.shape, row.state.dtype) == ((found.state_dim,), np.float32), f"a state is {row.state!r}")
        claim((row.physics.shape, row.physics.dtype) == ((width,), np.float64), f"a simulator state is {row.physics!r}")
        claim(np.isfinite(row.reward), f"a reward is {row.reward}")


def episodes_end_once(name: str) -> None:
    """Step types are FIRST, MID, LAST; a time limit ends an episode with discount 1, the task itself with 0 or 1."""
    rows, _ = play(make(name), 0)
    kinds = [row.step_type for row in rows]
    middle = [StepType.MID] * (len(rows) - 2)
    claim(kinds == [StepType.FIRST, *middle, StepType.LAST], f"they are {[kind.name for kind in kinds]}")
    claim(all(row.discount == 1 for row in rows[:-1]), "a row before the last has another discount than 1")
    claim(rows[-1].discount in (0, 1), f"the last row has the discount {rows[-1].discount}")
    claim(rows[-1].terminated == (rows[-1].discount == 0), "`terminated` contradicts the discount")
    limited, _ = play(make(name, length=1), 0)
    claim(len(limited) == 2 and limited[1].last, "a limit of one decision does not end an episode")


def rewards_replay(name: str) -> None:
    """Rewards replay exactly from the first simulator state, where it is stored and determines the episode."""
    from vd4rl_pomdp.envs.dmc import replay_rewards, replays

    task = TASKS.named(name)
    if not isinstance(task, DMCTask) or not replays(task):
        return
    env = make(name)
    for seed in (3, 4):  # the second episode starts in a used simulator
        rows, actions = play(env, seed)
        found, paid = replay_rewards(name, rows[0].physics, actions), [row.reward for row in rows[1:]]
        claim(np.array_equal(found, paid), f"the rewards were {paid} and replay as {found.tolist()}")


CHECKS: tuple[Check, ...] = (
    episodes_repeat_from_their_seeds,
    rows_have_the_declared_widths,
    episodes_end_once,
    rewards_replay,
)
