"""Do the shards of a folder form one set, and its rows whole episodes? What does not fit is named by file and row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.format import PLAN, read_plan, shard_number


def join_shards(path: Path, shards: Sequence[Path], parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate the rows of all shards into those of the set.

    Args:
        path: the set, or a single shard.
        shards: its files, as `shard_paths` gives them.
        parts: their rows, as `read_rows` gives them.

    Raises:
        UserError: the shards differ in width or keys, an episode's beginning is missing, or a collected set has not
            as many episodes as its collection.json says.
    """
    for shard, part in zip(shards, parts, strict=True):
        _agree(shards[0], parts[0], shard, part)
    starts = np.cumsum([0, *(len(part["reward"]) for part in parts)])
    rows = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    _check_order(shards, starts, rows["step_type"])
    check_count(path, int((rows["step_type"] == StepType.FIRST).sum()))
    return rows


def episode_returns(reward: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Undiscounted returns of all episodes.

    Args:
        reward: (N,) float64 of all rows; that of an episode's first row, which no action led to, does not count.
        starts: (E,) int64, first row of every episode.

    Returns:
        (E,) float64.
    """
    paid = reward.copy()
    paid[starts] = 0.0
    return np.add.reduceat(paid, starts)


def _agree(first: Path, expected: Mapping[str, np.ndarray], shard: Path, part: Mapping[str, np.ndarray]) -> None:
    if expected.keys() != part.keys():
        key = min(expected.keys() ^ part.keys())
        having, lacking = (shard, first) if key in part else (first, shard)
        raise UserError(f"{having}: has {key!r}, {lacking.name} has not; keep one set in a folder")
    for key, value in part.items():
        if value.shape[1:] != expected[key].shape[1:]:
            widths = f"{value.shape[1]} dimensions, in {first.name} {expected[key].shape[1]}"
            raise UserError(f"{shard}: {key!r} has {widths}; keep one set in a folder")


def check_count(path: Path, episodes: int) -> None:
    """Refuse a collected set that lacks episodes; a set of other makers says nothing of their number."""
    plan = read_plan(path)
    planned = plan.get("episodes", plan.get("trajectories", episodes))  # as its command calls them
    if episodes != planned:
        raise UserError(
            f"{path}: holds {episodes} episodes, its {PLAN} says {planned}: is a shard missing or of another set? "
            "collect or download it again"
        )


def _check_order(shards: Sequence[Path], starts: np.ndarray, step_type: np.ndarray) -> None:
    """Every row that does not begin an episode must continue the one of the row before it."""

    def fail(row: int, what: str) -> None:
        shard = int(np.searchsorted(starts, row, side="right")) - 1
        raise UserError(f"{shards[shard]}: row {row - starts[shard]} {what}")

    missing = "; is a shard before this one missing or renamed?"
    if step_type[0] != StepType.FIRST:
        fail(0, f"has step_type {step_type[0]}, but the first row of a set begins an episode{missing}")
    astray = np.flatnonzero((step_type[:-1] == StepType.LAST) & (step_type[1:] != StepType.FIRST)) + 1
    if len(astray):
        fail(int(astray[0]), f"follows an episode's last row without beginning a new one{missing}")
    for previous, shard, row in zip(shards[:-1], shards[1:], starts[1:-1], strict=True):
        if step_type[row] != StepType.FIRST and not _adjacent(previous, shard):
            fail(int(row), f"continues an episode, but not that of {previous.name}{missing}")


def _adjacent(previous: Path, shard: Path) -> bool:
    """Whether a shard can be the one right after another: unless both are numbered, their order is all we know."""
    (previous_rest, before), (rest, number) = shard_number(previous), shard_number(shard)
    return before is None or number is None or (rest == previous_rest and number == before + 1)
