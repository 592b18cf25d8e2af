"""Where a command may write: not over or inside another command's results, nor where another process is writing.

A folder belongs to the run, policy, encoder or dataset in it, and every command checks its --out here first. While a
process writes, it holds a file lock, which the system releases when the process ends.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_error, disk_errors, refuse_no_folder
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.runs import CONFIG_FILE
from vd4rl_pomdp.runs.files import holds_anything
from vd4rl_pomdp.runs.interrupt import handled

LOCK = ".lock"
_WAIT_S = 0.2
"""Wait for a lock in seconds: `in_use` briefly takes a free one, which must not stop its new owner."""


def refuse_inside(out: Path) -> None:
    """Raise UserError if a path to write lies inside a run, policy, encoder or dataset."""
    for folder in Path(os.path.realpath(out)).parents:  # unlike resolve, accepts a symlink loop
        if what := kept_in(folder):
            raise UserError(f"{out}: lies inside {folder}, which holds {what}; choose another folder")


def refuse_kept(out: Path) -> None:
    """Raise UserError if a folder that will contain runs or datasets is itself one of these."""
    refuse_inside(out)
    if what := kept_in(out):
        raise UserError(f"{out}: holds {what}; choose another --out")


def refuse_foreign(out: Path, what: str, *marks: str) -> None:
    """Raise UserError unless a folder is missing, empty but for hidden files, or holds one of the `marks`.

    `marks` are files that identify what the command wrote before; `what` names it.
    """
    refuse_kept(out)
    refuse_no_folder(out)
    if holds_anything(out) and not any((out / mark).is_file() for mark in marks):
        raise UserError(f"{out}: is not empty and holds no {what}; choose another --out")


def refuse_mount(folder: Path) -> None:
    """Raise UserError, before the work, for an empty folder that could not be replaced at its end."""
    if os.path.ismount(os.path.realpath(folder)):  # of a link, its target
        raise UserError(f"{folder}: is a mount point; choose a folder in it")


def kept_in(folder: Path) -> str | None:
    """What a folder holds, by its files: "a run", "a policy", "an encoder", "an agent", "a data set", or None."""
    names = set(_names(folder))
    if {"card.json", "encoder", "policy"} <= names:
        return "an agent"
    if CONFIG_FILE in names:
        if "model.safetensors" in names:
            return "an encoder"
        if names & {"curve.csv", "snapshots"}:
            return "a policy"
        # Other programs write a config.json too; only this package's has a stage.
        try:
            record = parse_json(read_bytes(folder / CONFIG_FILE))
        except UnavailableError:
            raise
        except (FileNotFoundError, ValueError):
            record = None
        if isinstance(record, dict) and "stage" in record:
            return "a run"
    is_shard = (name.lower().endswith((".hdf5", ".h5")) for name in names)
    return "a data set" if "collection.json" in names or any(is_shard) else None


def _names(folder: Path) -> list[str]:
    """Names in a folder except hidden ones; empty if it cannot be listed, since writing there will report the error."""
    try:
        return [name for name in os.listdir(folder) if not name.startswith(".")]
    except OSError as error:
        if isinstance(problem := disk_error(folder, error), UnavailableError):
            raise problem from error
        return []


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Create and lock a folder, and handle signals as `interrupt` does.

    The lock of a killed process is released, unless the folder's disk has no file locks: then its file stays.

    UserError if another process, which the message names, owns it, or it cannot be written.
    """
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK)
        try:
            lock.acquire(timeout=_WAIT_S, poll_interval=_WAIT_S / 10)
        except Timeout:
            owner = (folder / LOCK).read_text(encoding="utf-8") or "another process"
            raise UserError(
                f"{folder}: is in use by {owner}; wait until it ends, or choose another folder; if it was killed on a "
                f"disk without locks, delete {folder / LOCK}"
            ) from None
    try:
        owner = f"process {os.getpid()} on {socket.gethostname()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S UTC}"
        with disk_errors(folder):
            (folder / LOCK).write_text(owner, encoding="utf-8")
        with handled():
            yield
    finally:
        # Delete the lock file while holding the lock. FileLock does not lock a deleted file, so waiters create a new
        # one. Deleted after the release, it could already be another owner's, and two processes would own the folder.
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


@contextmanager
def removing_if_empty(folder: Path, ours: bool = False) -> Iterator[None]:
    """On exit remove `folder` and its parents if empty and created in the block (`folder` always, if `ours`)."""
    made = [one for one in (folder, *folder.parents) if not one.exists() or (ours and one == folder)]
    try:
        yield
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()


@contextmanager
def built(out: Path) -> Iterator[Path]:
    """Yield the absolute path of a folder to create, which becomes `out` at the end: `out` is never incomplete.

    It lies in a hidden folder next to `out`, locked against other processes. If the block fails, nothing remains; what
    a killed process leaves is replaced by the next one. UserError unless `out` is missing or empty.
    """
    refuse_inside(out)
    refuse_no_folder(out)
    absolute = Path(os.path.realpath(out))  # a link stays one
    with disk_errors(out):
        if absolute.is_dir() and (held := os.listdir(absolute)):
            raise UserError(f"{out}: is not empty (holds {min(held)}); choose another folder")
    refuse_mount(out)
    hidden = absolute.with_name(f".{absolute.name}.export")
    made = hidden / "new"
    with removing_if_empty(hidden, True), owned(hidden):
        shutil.rmtree(made, ignore_errors=True)
        try:
            yield made
            with disk_errors(out):
                made.rename(absolute)  # replaces an empty folder, no other
        finally:
            shutil.rmtree(made, ignore_errors=True)


def in_use(folder: Path) -> bool:
    """Whether another process owns a folder. True if permissions or a read-only disk keep us from checking."""
    if not (folder / LOCK).exists():
        return False
    try:
        with FileLock(folder / LOCK).acquire(timeout=0):
            return False
    except OSError as error:
        if isinstance(error, Timeout | PermissionError) or error.errno == errno.EROFS:
            return True
        raise
