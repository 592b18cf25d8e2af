"""Where a command may write: neither over another command's files nor into their folder.

A folder belongs to the run, policy, encoder or data set in it. Every command checks its --out here first.
"""

from __future__ import annotations

import os
from pathlib import Path

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_error
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.data.folder import PLAN, is_shard_name
from vd4rl_pomdp.data.format import is_shard
from vd4rl_pomdp.runs import CONFIG_FILE


def refuse_inside(out: Path) -> None:
    """Raise UserError if a file or folder to write lies inside a run, a policy, an encoder or a data set."""
    for folder in Path(os.path.realpath(out)).parents:  # unlike resolve, takes a link to itself as it is
        if what := kept_in(folder):
            raise UserError(f"{out}: lies inside {folder}, which holds {what}; choose another --out")


def refuse_kept(out: Path) -> None:
    """Raise UserError if a folder of runs or sets to write is itself a run, a policy, an encoder or a data set."""
    refuse_inside(out)
    if what := kept_in(out):
        raise UserError(f"{out}: holds {what}; choose another --out")


def refuse_foreign(out: Path, what: str, *marks: str) -> None:
    """Raise UserError unless a folder is missing or empty, or has been written by the same command before.

    Args:
        out: folder to write.
        what: what the command writes, for the message.
        marks: files that the command leaves; any one of them makes the folder its own. Hidden files do not count.
    """
    refuse_kept(out)
    if _names(out) and not any((out / mark).is_file() for mark in marks):
        raise UserError(f"{out}: is not empty and holds no {what}; choose another --out")


def kept_in(folder: Path) -> str | None:
    """What a folder keeps: "a run", "a policy", "an encoder", "a data set", or None for nothing of the kind."""
    config = folder / CONFIG_FILE
    if config.is_file():
        if (folder / "model.safetensors").is_file():
            return "an encoder"
        if any((folder / name).exists() for name in ("curve.csv", "snapshots")):
            return "a policy"
        if _is_run(config):
            return "a run"
    return "a data set" if _is_set(folder) else None


def _is_run(config: Path) -> bool:
    try:
        record = parse_json(read_bytes(config))
    except UnavailableError:
        raise
    except (FileNotFoundError, ValueError):
        return False
    return isinstance(record, dict) and "stage" in record


def _is_set(folder: Path) -> bool:
    if (folder / PLAN).is_file():
        return True
    shards = (folder / name for name in _names(folder) if is_shard_name(name))
    return any(path.is_file() and is_shard(path) for path in shards)


def _names(folder: Path) -> list[str]:
    """Names in a folder, without hidden ones; empty if it may not be listed, which writing there then reports."""
    try:
        return [path.name for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        if isinstance(told := disk_error(folder, error), UnavailableError):
            raise told from error
        return []
