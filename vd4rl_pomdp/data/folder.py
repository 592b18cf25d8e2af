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

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.tasks import SET_QUALITIES, TASKS
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.format import read_attributes
from vd4rl_pomdp.runs.files import read_json

SUFFIXES = (".hdf5", ".h5")
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
    return not name.startswith(".") and name.lower().endswith(SUFFIXES)


def shard_files(folder: Path) -> list[Path]:
    """Files in a folder with a shard's name, unordered and unchecked (see `shard_paths`); [] if there is no folder."""
    with disk_errors(folder):
        return [path for path in folder.iterdir() if is_shard_name(path.name)] if folder.is_dir() else []


def shard_paths(folder: Path) -> list[Path]:
    """Shards of a data set in the order of their rows; `folder` may also be a single shard.

    They are sorted by name without the leading number, then by that number, with digits compared as numbers:
    `10_mixed` follows `9_mixed`, and the two halves of a medium_expert folder are not interleaved.

    Raises:
        UserError: there is no such folder or no shard in it, a number is missing or duplicated among shards of the
            same name, its collection is unfinished, or it is only part of a published data set.
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
    alike: dict[str, dict[int | None, Path]] = defaultdict(dict)
    for shard in sorted(shards):
        rest, number = _shard_number(shard)
        if twin := alike[rest].get(number):
            raise UserError(f"{folder}: has both {twin.name} and {shard.name}, which are the same shard; remove one")
        alike[rest][number] = shard
    for rest, found in alike.items():
        numbers = sorted(number for number in found if number is not None)
        if numbers != list(range(len(numbers))):
            missing = min(set(range(len(numbers))) - set(numbers))
            raise UserError(
                f"{folder}: has the shard {numbers[-1]}{rest}, but not {missing}{rest}; download or collect it again, "
                "or number the shards of your own dataset 0, 1, 2, ..."
            )
    return sorted(shards, key=_shard_order)


def _shard_number(path: Path) -> tuple[str, int | None]:
    """Split a shard's name into the rest and its leading number: 10_mixed -> ("_mixed", 10); None if there is none."""
    number, rest = re.fullmatch(r"(\d*)(.*)", path.stem, re.DOTALL).groups()  # type: ignore[union-attr]
    return rest, int(number) if number else None


def _shard_order(path: Path) -> tuple[list[tuple[int, str]], int]:
    rest, number = _shard_number(path)
    words = [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", rest)]
    return words, -1 if number is None else number


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


def join_shards(path: Path, shards: Sequence[Path], parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate the rows `parts`, from `read_rows`, of all shards of the data set at `path`.

    Raises:
        UserError: the shards differ in dimensions or keys, a row neither starts an episode nor continues that of the
            previous row, or the number of episodes differs from that in collection.json.
    """
    first, expected = shards[0], parts[0]
    for shard, part in zip(shards, parts, strict=True):
        if expected.keys() != part.keys():
            key = min(expected.keys() ^ part.keys())
            having, other = (shard, first) if key in part else (first, shard)
            raise UserError(f"{having}: has {key!r} and {other.name} does not; keep one dataset per folder")
        for key, value in part.items():
            if value.shape[1:] != expected[key].shape[1:]:
                widths = f"{value.shape[1]} dimensions, in {first.name} {expected[key].shape[1]}"
                raise UserError(f"{shard}: {key!r} has {widths}; keep one dataset per folder")
    starts = np.cumsum([0, *(len(part["reward"]) for part in parts)])
    rows = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    step_type = rows["step_type"]

    def fail(row: int, what: str) -> None:
        shard = int(np.searchsorted(starts, row, side="right")) - 1
        place = f"{shards[shard]}: row {row - starts[shard]}"
        raise UserError(f"{place} {what}; is a shard before this one missing or renamed?")

    if step_type[0] != StepType.FIRST:
        fail(0, f"has step_type {step_type[0]}, but the first row of a set begins an episode")
    strays = np.flatnonzero((step_type[:-1] == StepType.LAST) & (step_type[1:] != StepType.FIRST)) + 1
    if len(strays):
        fail(int(strays[0]), "follows an episode's last row without beginning a new one")
    for previous, shard, row in zip(shards[:-1], shards[1:], starts[1:-1], strict=True):
        (previous_rest, before), (rest, number) = _shard_number(previous), _shard_number(shard)
        # without numbers, shards are assumed to be consecutive
        adjacent = before is None or number is None or (rest == previous_rest and number == before + 1)
        if step_type[row] != StepType.FIRST and not adjacent:
            fail(int(row), f"continues an episode, but not that of {previous.name}")
    check_count(path, int((step_type == StepType.FIRST).sum()))
    return rows


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
