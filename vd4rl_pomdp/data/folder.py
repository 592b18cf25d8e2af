"""Data set folders: find and order their shards, check that none is missing, and determine task and quality."""

from __future__ import annotations

import csv
import os
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import MOST_ROWS, UserError, disk_errors
from vd4rl_pomdp.core.tasks import SET_QUALITIES, TASKS
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.format import read_attributes, read_frame_size, read_rows
from vd4rl_pomdp.runs.files import read_json

PLAN, PROVENANCE = "collection.json", "provenance.json"
"""Files that a collection writes before its first shard, and after its last one."""


@dataclass(frozen=True)
class RemoteFile:
    """One published 84-pixel shard."""

    path: str
    """Path on the mirror: vd4rl/main/{task}/{quality}/84px/{file}."""
    size: int
    """Bytes."""
    sha256: str

    def target(self, destination: Path) -> Path:
        """Local path: destination/{task}/{quality}/84px/{file}."""
        return destination.joinpath(*self.path.split("/")[2:])


@cache
def manifest() -> tuple[RemoteFile, ...]:
    """All 84-pixel shards that V-D4RL publishes."""
    rows = csv.DictReader(_packaged("manifest.tsv"), delimiter="\t")
    return tuple(RemoteFile(row["path"], int(row["bytes"]), row["sha256"]) for row in rows)


def published_scores() -> list[dict[str, str]]:
    """Published scores (return / 10) of methods on fully observed data sets, one row per data set.

    Columns: `env`, `dataset`, then methods. Sources: V-D4RL (Lu et al. 2022, arXiv 2206.04779), and for `rebrac`
    Tarasov et al. 2023 (arXiv 2305.09836).
    """
    return list(csv.DictReader(_packaged("published_scores.csv")))


def _packaged(name: str) -> list[str]:
    return files("vd4rl_pomdp.data").joinpath(name).read_text(encoding="utf-8").splitlines()


def read_plan(folder: Path) -> dict[str, Any]:
    """Contents of a data set's collection.json; empty if it was not collected by this package."""
    return read_json(folder / PLAN) if (folder / PLAN).is_file() else {}


def is_shard_name(name: str) -> bool:
    """Whether a file name is that of a shard; hidden files are not."""
    return not name.startswith(".") and name.lower().endswith((".hdf5", ".h5"))


def shard_files(folder: Path) -> list[Path]:
    """Files in a folder with a shard's name, unordered and unchecked (see `shard_paths`); [] if there is no folder."""
    with disk_errors(folder):
        return [path for path in folder.iterdir() if is_shard_name(path.name)] if folder.is_dir() else []


def shard_paths(folder: Path) -> list[Path]:
    """Shards of a data set in the order of their rows; `folder` may also be a single shard.

    They are sorted by name without the leading number, then by that number, with digits compared as numbers:
    `10_mixed` follows `9_mixed`, and the two halves of a medium_expert folder are not interleaved.

    Raises:
        UserError: there is no such folder or no shard in it, shards of the same name are not numbered 0, 1, 2, ..., its
            collection is unfinished, or it is only part of a published data set.
    """
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; collect or download a dataset there with `vd4rl-pomdp data`")
    if (folder / PLAN).exists() and not (folder / PROVENANCE).exists():
        raise UserError(f"{folder}: the dataset's collection is not finished; re-run the command that collects it")
    shards = shard_files(folder)
    if not shards:
        with disk_errors(folder):
            first = min((path for path in folder.rglob("*") if is_shard_name(path.name)), default=None)
        hint = f"name a folder of shards such as {first.parent}" if first else "collect or download a dataset there"
        raise UserError(f"{folder}: holds no .hdf5 shards; {hint}")
    _refuse_part(folder, shards)
    alike: dict[str, list[Path]] = defaultdict(list)
    for shard in sorted(shards, key=_shard_order):
        alike[_shard_number(shard)[0]].append(shard)
    for group in alike.values():
        numbers = [_shard_number(shard)[1] for shard in group]
        if numbers not in ([-1], list(range(len(group)))):
            raise UserError(
                f"{folder}: {', '.join(shard.name for shard in group)} are not numbered 0, 1, 2, ...; download or "
                "collect what is missing again, remove copies, or renumber your own dataset"
            )
    return sorted(shards, key=_shard_order)


def _shard_number(path: Path) -> tuple[str, int]:
    """Split a shard's name into the rest and its leading number: 10_mixed -> ("_mixed", 10); -1 if there is none."""
    rest = path.stem.lstrip("0123456789")
    return rest, int(path.stem.removesuffix(rest) or -1)


def _shard_order(path: Path) -> tuple[list[tuple[int, str]], int]:
    rest, number = _shard_number(path)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", rest)], number


def _refuse_part(path: Path, shards: Sequence[Path]) -> None:
    """Raise UserError if some shards of a published data set are missing.

    A folder counts as published if its path and its shards are named like that data set's, and the shards have no
    attributes by this package.
    """
    task, quality = task_and_quality(path, [])
    published = [file.path.rpartition("/")[2] for file in manifest() if file.path.split("/")[2:4] == [task, quality]]
    names = {shard.name for shard in shards}
    missing = [name for name in published if name not in names]
    if not missing or not names <= set(published) or read_attributes(shards[0]):
        return
    out = path.parents[2] if path.parts[-3:] == (task, quality, "84px") else "DIR"
    command = f"vd4rl-pomdp data download --task {task} --quality {quality} --out {out}"
    raise UserError(
        f"{path}: contains {len(shards)} of {len(published)} shards of V-D4RL's {task} {quality} ({missing[0]} is "
        f"missing); get the rest with `{command}`, or rename the shards to use only these"
    )


def task_and_quality(path: Path, attributes: list[dict[str, Any]]) -> tuple[str | None, str | None]:
    """Task and quality of a data set, from its shards' attributes, else from the names of its folders.

    Any folder name directly within a task's folder is accepted as a quality.
    """
    whole = Path(os.path.abspath(path))
    qualities = (whole.name,) if whole.parent.name in TASKS else SET_QUALITIES
    return _name(path, attributes, "task", tuple(TASKS)), _name(path, attributes, "set", qualities)


def _name(path: Path, attributes: list[dict[str, Any]], attribute: str, choices: tuple[str, ...]) -> str | None:
    stored = {str(one[attribute]) for one in attributes if one.get(attribute)}
    if len(stored) > 1:
        raise UserError(f"{path}: its shards come from {' and '.join(sorted(stored))}; keep one dataset per folder")
    folders = *path.resolve().parts, *Path(os.path.abspath(path)).parts  # a link's own name has priority
    named = (part for part in reversed(folders) if part in choices)
    return stored.pop() if stored else next(named, None)


@dataclass(frozen=True)
class StoredSet:
    """A data set on disk: its shards in order, and everything in them except the frames."""

    shards: list[Path]
    frame_size: int
    attributes: list[dict[str, Any]]
    """What `write_shard` stored with each shard."""
    counts: list[int]
    """Rows of each shard."""
    rows: dict[str, np.ndarray]
    """Rows of all shards, as by `read_rows`."""

    @property
    def starts(self) -> np.ndarray:
        """First row of every episode, (E,) int64."""
        return np.flatnonzero(self.rows["step_type"] == StepType.FIRST)

    @property
    def ends(self) -> np.ndarray:
        """One past the last row of every episode, (E,) int64."""
        return np.append(self.starts[1:], len(self.rows["reward"]))


def read_set(path: Path) -> StoredSet:
    """Read and validate a data set, a folder or a single shard, except its frames.

    Raises:
        UserError: as by `shard_paths` and `read_rows`; the shards differ in dimensions, keys or frame size; a row
            neither starts an episode nor continues that of the previous row; an episode is too long; or the number of
            episodes differs from that in collection.json.
    """
    shards = shard_paths(path)
    frame_size, parts = read_frame_size(shards), [read_rows(shard) for shard in shards]
    for shard, part in zip(shards, parts, strict=True):
        if differing := {key for key, _ in _widths(part) ^ _widths(parts[0])}:
            raise UserError(
                f"{shard}: {min(differing)!r} has other dimensions than in {shards[0].name}, or is only in one of "
                "them; keep one dataset per folder"
            )
    counts = [len(part["reward"]) for part in parts]
    rows = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    _check_episodes(shards, counts, rows["step_type"])
    found = StoredSet(shards, frame_size, [read_attributes(shard) for shard in shards], counts, rows)
    check_lengths(path, found.ends - found.starts)
    check_count(path, len(found.starts))
    return found


def _widths(rows: Mapping[str, np.ndarray]) -> set[tuple[str, tuple[int, ...]]]:
    return {(key, value.shape[1:]) for key, value in rows.items()}


def _check_episodes(shards: Sequence[Path], counts: Sequence[int], step_type: np.ndarray) -> None:
    """Raise UserError for a row that neither starts an episode nor continues that of the previous row."""
    starts = np.cumsum([0, *counts])

    def fail(row: int, what: str) -> None:
        shard = int(np.searchsorted(starts, row, side="right")) - 1
        place = f"{shards[shard]}: row {row - starts[shard]}"
        raise UserError(f"{place} {what}; is a shard before this one missing or renamed?")

    if step_type[0] != StepType.FIRST:
        fail(0, f"has step_type {step_type[0]}, but the first row of a set begins an episode")
    strays = np.flatnonzero((step_type[:-1] == StepType.LAST) & (step_type[1:] != StepType.FIRST)) + 1
    if len(strays):
        fail(int(strays[0]), "follows an episode's last row without beginning a new one")
    for shard, row in zip(shards[1:], starts[1:-1], strict=True):
        if _shard_number(shard)[1] == 0 and step_type[row] != StepType.FIRST:
            fail(int(row), "is the first of its shards, but begins no episode")


def check_lengths(place: Path | str, lengths: Sequence[int] | np.ndarray) -> None:
    """Raise UserError, naming `place`, for an episode of more rows than row keys can count."""
    if (most := max(lengths)) > MOST_ROWS:
        raise UserError(
            f"{place}: an episode has {most:,} rows, more than {MOST_ROWS:,}; mark where episodes end, or split it"
        )


def check_count(path: Path, episodes: int) -> None:
    """Raise UserError if a collected data set has another number of episodes than its collection.json states."""
    plan = read_plan(path)
    planned = plan.get("episodes", plan.get("trajectories", episodes))  # the commands use either name
    if episodes != planned:
        raise UserError(
            f"{path}: holds {episodes} episodes, its {PLAN} says {planned}: is a shard missing or of another dataset? "
            "collect or download it again"
        )


def episode_returns(reward: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Undiscounted returns (E,) of rewards (N,) float64 and first rows (E,) of all episodes.

    Rewards at first rows, which follow no action, are ignored.
    """
    paid = reward.copy()
    paid[starts] = 0.0
    return np.add.reduceat(paid, starts)
