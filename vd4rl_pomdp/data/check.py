"""Is a set what it claims to be? Its counts, its statistics, and the proof that its actions lead to its rewards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.data.dataset import Dataset, open_dataset
from vd4rl_pomdp.data.format import read_dtypes
from vd4rl_pomdp.data.store import verify_store
from vd4rl_pomdp.envs.mazes import MAZES

ReplayFn = Callable[[str, np.ndarray, np.ndarray], np.ndarray]
"""(task, physics (P,) of an episode's first row, actions (T, A), a_0 first) -> rewards (T,), r_0 first."""


def check_dataset(path: Path | str, cache: Path | None = None, replay: ReplayFn | None = None) -> dict[str, Any]:
    """Validate a set and describe it.

    Args:
        path: folder (or file) of the shards, of a task or of a maze.
        cache: where decoded sets are kept, as in `open_dataset`.
        replay: what simulates an episode; default `envs.dmc.replay_rewards`.

    Returns:
        JSON values: `rows`, `episodes`, `transitions`, `incomplete_episodes`, `episodes_of_one_row` (on which nothing
        trains), `action_dim`, `return_mean`, `return_min` and `return_max` over all episodes, incomplete ones included,
        `replay_max_error` (largest absolute difference between a stored reward, in a maze a true state, and its replay;
        None where nothing can be replayed), `replay` (how that was found, or why not), `frame_size`, `task`, `quality`,
        `shards` (names in order), `dtypes` (key to the stored dtypes), `store_ok` (True: the decoded files have their
        checksums).

    Raises:
        UserError: the set or its decoded form is damaged.
    """
    path = Path(path)
    dataset = open_dataset(path, cache)
    attributes = dataset.store.meta["attributes"][0]
    is_maze = attributes.get("task") in MAZES
    verify_store(dataset.store)
    _check_actions(dataset)
    returns = dataset.returns.numpy()
    reason = _why_not_replayed(dataset, is_maze)
    replayed = None if reason else _maze_error(dataset, attributes) if is_maze else _replay_error(dataset, replay)
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
        "replay": reason or "every episode, from its first simulator state",
        "frame_size": dataset.frame_size,
        "task": dataset.task,
        "quality": dataset.quality,
        "shards": dataset.store.meta["shards"],
        "dtypes": _dtypes([path] if path.is_file() else [path / name for name in dataset.store.meta["shards"]]),
        "store_ok": True,
    }


def _check_actions(dataset: Dataset) -> None:
    """Raise UserError for actions that cannot be what this format means by them."""
    action, reward = dataset.store.array("action"), dataset.store.array("reward")
    first = dataset.episode_start.numpy()
    if action[first].any() or reward[first].any():
        raise UserError(
            f"{dataset.path}: an episode's first row has an action or a reward, which led to no frame: store each with "
            "the frame that follows it, and zeros in the first row"
        )
    if (most := np.abs(action).max()) > 1:
        raise UserError(f"{dataset.path}: has actions of up to {most!s}: scale them to [-1, 1], as policies act")


def _why_not_replayed(dataset: Dataset, is_maze: bool) -> str:
    """Why a set's actions cannot be replayed to its rewards, "" if they can."""
    if dataset.physics is None:
        return "impossible: the set stores no simulator states"
    if is_maze:
        return ""
    dataset.require_states()
    assert dataset.task is not None
    task = TASKS.named(dataset.task)
    if not isinstance(task, DMCTask):
        return f"impossible: {dataset.task} is no task of dm_control"
    from vd4rl_pomdp.envs.dmc import replays

    return "" if replays(task) else f"impossible: {dataset.task} draws more than the simulator state for each episode"


def _replay_error(dataset: Dataset, replay: ReplayFn | None) -> float:
    assert dataset.physics is not None
    assert dataset.task is not None
    if replay is None:
        from vd4rl_pomdp.envs.dmc import replay_rewards

        replay = replay_rewards
    reward, action = dataset.store.array("reward"), dataset.store.array("action")
    worst = 0.0
    for start, end in zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True):
        if end - start > 1:
            try:
                replayed = replay(dataset.task, dataset.physics[start], action[start + 1 : end])
            except UserError:
                raise
            except (RuntimeError, ValueError) as error:  # dm_control's, also where the simulation diverges
                raise UserError(
                    f"{dataset.path}: the episode of row {start} cannot be replayed in {dataset.task} "
                    f"({first_line(error)}); put the set in a folder called like its task, or collect it again"
                ) from error
            worst = np.maximum(worst, np.abs(replayed - reward[start + 1 : end]).max())  # passes NaN on
    return float(worst)


def _maze_error(dataset: Dataset, attributes: dict[str, Any]) -> float:
    assert dataset.physics is not None
    from vd4rl_pomdp.envs.maze import replay_states

    states, action = dataset.physics, dataset.store.array("action")
    worst = 0.0
    for start, end in zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True):
        replayed = replay_states(
            attributes["task"], states[start], action[start + 1 : end], attributes["action_repeat"]
        )
        worst = np.maximum(worst, np.abs(replayed - states[start + 1 : end]).max(initial=0.0))  # passes NaN on
    return float(worst)


def _dtypes(shards: list[Path]) -> dict[str, list[str]]:
    stored = [read_dtypes(shard) for shard in shards]
    return {key: sorted({dtypes[key] for dtypes in stored}) for key in stored[0]}
