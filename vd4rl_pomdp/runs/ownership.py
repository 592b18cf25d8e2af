"""One owner at a time for a folder that is being written: a lock of the system's, free when its process has ended."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from vd4rl_pomdp.core.errors import InUseError, disk_errors
from vd4rl_pomdp.runs.interrupt import handled

LOCK = ".lock"
_WAIT_S = 0.2
"""`in_use` holds a free lock for a moment, which keeps nobody from owning the folder."""


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Own a folder, made if missing, and answer signals as `interrupt` says; the system frees what a killed one owned.

    Raises:
        InUseError: another process owns it, which the message names.
        UserError: it cannot be written.
    """
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK)
        try:
            lock.acquire(timeout=_WAIT_S, poll_interval=_WAIT_S / 10)
        except Timeout:
            owner = (folder / LOCK).read_text(encoding="utf-8") or "another process"
            raise InUseError(f"{folder}: is in use by {owner}; wait until it ends, or choose another folder") from None
    try:
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        with disk_errors(folder):
            (folder / LOCK).write_text(
                f"process {os.getpid()} on {socket.gethostname()} since {since}", encoding="utf-8"
            )
        with handled():
            yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)  # while it is held: whoever waits for it makes another one
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
