"""Where a command may write: neither over another command's files, nor into their folder, nor beside another process.

A folder belongs to the run, policy, encoder or data set in it. Every command checks its --out here first. While one is
being written, its process owns it by a lock of the system's, which is free when that process has ended.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_error, disk_errors
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.runs import CONFIG_FILE
from vd4rl_pomdp.runs.interrupt import handled

LOCK = ".lock"
_WAIT_S = 0.2
"""`in_use` holds a free lock for a moment, which keeps nobody from owning the folder."""


def refuse_inside(out: Path) -> None:
    """Raise UserError if a file or folder to write lies inside a run, a policy, an encoder or a data set."""
    for folder in Path(os.path.realpath(out)).parents:  # unlike resolve, takes a link to itself as it is
        if what := kept_in(folder):
            raise UserError(f"{out}: lies inside {folder}, which holds {what}; choose another folder")


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
    """What a folder keeps, by its files: "a run", "a policy", "an encoder", "an agent", "a data set", or None."""
    names = set(_names(folder))
    if {"card.json", "encoder", "policy"} <= names:
        return "an agent"
    if CONFIG_FILE in names:
        if "model.safetensors" in names:
            return "an encoder"
        if names & {"curve.csv", "snapshots"}:
            return "a policy"
        # Other programs have a config.json, too: what has a stage is this package's.
        try:
            record = parse_json(read_bytes(folder / CONFIG_FILE))
        except UnavailableError:
            raise
        except (FileNotFoundError, ValueError):
            record = None
        if isinstance(record, dict) and "stage" in record:
            return "a run"
    is_set = "collection.json" in names or any(name.lower().endswith((".hdf5", ".h5")) for name in names)
    return "a data set" if is_set else None


def _names(folder: Path) -> list[str]:
    """Names in a folder, without hidden ones; empty if it may not be listed, which writing there then reports."""
    try:
        return [name for name in os.listdir(folder) if not name.startswith(".")]
    except OSError as error:
        if isinstance(told := disk_error(folder, error), UnavailableError):
            raise told from error
        return []


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Own a folder, made if missing, and answer signals as `interrupt` says; the system frees what a killed one owned.

    Raises:
        UserError: another process owns it, which the message names, or it cannot be written.
    """
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK)
        try:
            lock.acquire(timeout=_WAIT_S, poll_interval=_WAIT_S / 10)
        except Timeout:
            owner = (folder / LOCK).read_text(encoding="utf-8") or "another process"
            raise UserError(f"{folder}: is in use by {owner}; wait until it ends, or choose another folder") from None
    try:
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        with disk_errors(folder):
            (folder / LOCK).write_text(
                f"process {os.getpid()} on {socket.gethostname()} since {since}", encoding="utf-8"
            )
        with handled():
            yield
    finally:
        # Deleted while it is still held, and never by anyone else: FileLock takes no lock on a name that is gone, so
        # whoever waits makes a new file. After the release it could be another owner's already, and two would own it.
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


def in_use(folder: Path) -> bool:
    """Whether a process owns a folder, or seems to where this one may not look."""
    if not (folder / LOCK).exists():
        return False
    try:
        with FileLock(folder / LOCK).acquire(timeout=0):
            return False
    except (Timeout, PermissionError):
        return True
