"""What V-D4RL publishes: the 84-pixel shards, and whether a folder holds a whole set of them."""

from __future__ import annotations

import csv
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.core.tasks import SET_QUALITIES, TASKS
from vd4rl_pomdp.data.format import read_attributes

_TOLD = 4
"""How many files a message names."""


@dataclass(frozen=True)
class RemoteFile:
    """One published shard."""

    path: str
    """vd4rl/main/{task}/{quality}/84px/{file}: its place on the mirror."""
    size: int
    """Bytes."""
    sha256: str

    def target(self, destination: Path) -> Path:
        """Where the file goes: destination/{task}/{quality}/84px/{file}."""
        return destination.joinpath(*self.path.split("/")[2:])


@cache
def manifest() -> tuple[RemoteFile, ...]:
    """All published 84-pixel shards."""
    text = read_bytes(Path(__file__).with_name("manifest.tsv")).decode()
    rows = csv.DictReader(text.splitlines(), delimiter="\t")
    return tuple(RemoteFile(row["path"], int(row["bytes"]), row["sha256"]) for row in rows)


def check_whole(path: Path, shards: Sequence[Path]) -> None:
    """Raise UserError for a part of a published set.

    A shard of the name and size of a published one is that. Other sets are their makers' business, unless they tell
    nothing of who made them and all their shards are called as those of the published set of their folder are.

    Args:
        path: the folder.
        shards: its shards.
    """
    with disk_errors(path):
        sizes = {shard.name: shard.stat().st_size if shard.exists() else -1 for shard in shards}
    published: dict[tuple[str | None, str | None], dict[str, int]] = defaultdict(dict)
    for file in manifest():
        *_, of_task, of_quality, _, name = file.path.split("/")
        published[of_task, of_quality][name] = file.size
    alike = [key for key, wanted in published.items() if sizes.keys() <= wanted.keys()]
    certain = [key for key in alike if sizes.items() & published[key].items()]
    key = named = task_and_quality(path, [])
    if certain and named not in certain:
        key = min(certain, key=lambda key: len(published[key]))  # the shards of expert are in medium_expert, too
    elif key not in alike or (not certain and read_attributes(shards[0])):
        return
    (task, quality), wanted = key, published[key]
    told = [f"{name} is missing" for name in wanted if name not in sizes]
    if certain:
        told += [f"{n} has {size} bytes, not {wanted[n]}" for n, size in sizes.items() if size != wanted[n]]
    if not told:
        return
    more = f" and {len(told) - _TOLD} more" if len(told) > _TOLD else ""
    out = path.parents[2] if path.parts[-3:] == (task, quality, "84px") else "DIR"
    raise UserError(
        f"{path}: is a part of V-D4RL's {task} {quality} ({', '.join(told[:_TOLD])}{more}); get the rest with "
        f"`vd4rl-pomdp data download --task {task} --quality {quality} --out {out}`, or give the shards other names to "
        "train on them alone"
    )


def task_and_quality(path: Path, attributes: list[dict[str, Any]]) -> tuple[str | None, str | None]:
    """Task and quality of a set: as the attributes of all its shards say, else as its folders are named.

    A quality of one's own is the name of a folder within its task's.
    """
    task, quality = _name(path, attributes, "task", tuple(TASKS)), _name(path, attributes, "set", SET_QUALITIES)
    return task, quality or (path.name if path.parent.name in TASKS else None)


def _name(path: Path, attributes: list[dict[str, Any]], attribute: str, choices: tuple[str, ...]) -> str | None:
    stored = {str(one[attribute]) for one in attributes if one.get(attribute)}
    if len(stored) > 1:
        raise UserError(f"{path}: its shards come from {' and '.join(sorted(stored))}; keep one set in a folder")
    folders = *path.resolve().parts, *Path(os.path.abspath(path)).parts  # a link's name comes before its target's
    named = (part for part in reversed(folders) if part in choices)
    return stored.pop() if stored else next(named, None)
