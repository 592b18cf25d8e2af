"""Validate a data set: counts, statistics, checksums, and a replay of its actions in the simulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.data.dataset import Dataset, open_dataset
from vd4rl_pomdp.data.store import verify_store
from vd4rl_pomdp.envs.mazes import MAZES


def check_dataset(path: Path | str, cache: Path | None = None) -> dict[str, Any]:
    """Validate a data set of a task or a maze, and describe it; arguments as `open_dataset`.

    Returns:
        JSON values: `rows`, `episodes`, `transitions`, `incomplete_episodes`, `episodes_of_one_row` (not used in
        training), `action_dim`, `return_mean`, `return_min` and `return_max` over all episodes, incomplete ones
        included, `replay_max_error` (largest absolute difference between stored and replayed rewards, or states in a
        maze; None if replay is impossible), `replay` (what was replayed, or why not), `frame_size`, `task`, `quality`,
        `shards` (names in order).

    Raises:
        UserError: the data set or its cached form is damaged.
    """
    dataset = open_dataset(path, cache)
    verify_store(dataset.store)
    _check_actions(dataset)
    returns = dataset.returns.numpy()
    replayed, reason = _replayed(dataset)
    return {
        "rows": dataset.num_rows,
        "episodes": dataset.num_episodes,
        "transitions": dataset.num_transitions,
        "incomplete_episodes": dataset.incomplete_episodes,
        "episodes_of_one_row": int((dataset.episode_end - dataset.episode_start == 1).sum()),
        "action_dim": dataset.action_dim,
        "return_mean": float(returns.mean()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "replay_max_error": replayed,
        "replay": reason,
        "frame_size": dataset.frame_size,
        "task": dataset.task,
        "quality": dataset.quality,
        "shards": dataset.store.meta["shards"],
    }


def _check_actions(dataset: Dataset) -> None:
    """Raise UserError for actions outside [-1, 1], or misaligned ones: first rows have no action and no reward."""
    action, reward = dataset.store.array("action"), dataset.store.array("reward")
    first = dataset.episode_start.numpy()
    if action[first].any() or reward[first].any():
        raise UserError(
            f"{dataset.path}: an episode's first row has a nonzero action or reward: store each with the frame that "
            "follows it, and zeros in the first row"
        )
    if (most := np.abs(action).max()) > 1:
        raise UserError(f"{dataset.path}: has actions of up to {most!s}: scale them to [-1, 1], the range of policies")


def _replayed(dataset: Dataset) -> tuple[float | None, str]:
    """`replay_max_error` and `replay` of `check_dataset`."""
    attributes, physics = dataset.store.meta["attributes"][0], dataset.physics
    if physics is None:
        return None, "impossible: the set stores no simulator states"
    replay: Callable[[np.ndarray, np.ndarray], np.ndarray]
    if (maze := attributes.get("task")) in MAZES:
        if "action_repeat" not in attributes:  # imported or written by others
            return None, "impossible: its shards do not state the action repeat"
        from vd4rl_pomdp.envs.maze import replay_states

        stored, replay = physics, partial(replay_states, maze, action_repeat=attributes["action_repeat"])
    else:
        from vd4rl_pomdp.envs import dmc

        _, name = dataset.require_states()
        task = TASKS.named(name)
        if not isinstance(task, DMCTask):
            return None, f"impossible: {name} is not a task of dm_control"
        if not dmc.replays(task):
            return None, f"impossible: {name} draws more than the simulator state for each episode"
        stored, replay = dataset.store.array("reward"), partial(dmc.replay_rewards, name)
    action, worst = dataset.store.array("action"), 0.0
    for start, end in zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True):
        if end - start == 1:
            continue
        try:
            replayed = replay(physics[start], action[start + 1 : end])
        except UserError:
            raise
        except (RuntimeError, ValueError) as error:  # from dm_control, for example if the simulation diverges
            raise UserError(
                f"{dataset.path}: the episode of row {start} cannot be replayed in {dataset.task} "
                f"({first_line(error)}); put the dataset in a folder named after its task, or collect it again"
            ) from error
        worst = np.maximum(worst, np.abs(replayed - stored[start + 1 : end]).max())  # unlike max(), propagates NaN
    return float(worst), "every episode, from its first simulator state"
