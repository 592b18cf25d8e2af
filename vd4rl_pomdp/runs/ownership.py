"""One owner at a time for a folder that is being written.

The lock is filelock's lease: a file `.lock` that names host and process. On the owner's machine its death frees the
folder at once; from another machine, over a network file system, the owner counts as dead when its heartbeat has not
been seen for LEASE_S. `.owner.json` beside it says since when.
"""

from __future__ import annotations

import os
import secrets
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import SoftFileLease, Timeout

from vd4rl_pomdp.core.errors import InUseError, disk_errors
from vd4rl_pomdp.core.reading import parse_json
from vd4rl_pomdp.runs.files import synchronise, write_json
from vd4rl_pomdp.runs.interrupt import handled, hangups

LEASE_S = 60.0
EMPTY_S = 5.0
"""Seconds after which a lock that does not name its owner counts as left behind."""
_LOCK, _NOTE, _BREAKING = ".lock", ".owner.json", ".lock.break"


class Owner:
    """This process as a folder's owner."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        self._note = {"host": socket.gethostname(), "pid": os.getpid(), "since": since, "token": secrets.token_hex(8)}
        self._note |= {"started": _started(os.getpid())}
        write_json(folder / _NOTE, self._note, shared=True)

    def check(self) -> None:
        """Raise InUseError unless the folder is still this process's; called before what cannot be undone."""
        note = _read_note(self._folder)
        if note != self._note:
            taken = f"was taken over by {_name(note)}" if note else "was removed or taken over"
            raise InUseError(f"{self._folder}: {taken} while this process wrote there; it ends and leaves it alone")

    def release(self) -> None:
        """Remove the note, if it is still this process's."""
        if _read_note(self._folder) == self._note:
            (self._folder / _NOTE).unlink(missing_ok=True)


@contextmanager
def owned(folder: Path) -> Iterator[Owner]:
    """Own a folder, made if missing, and answer signals as `interrupt` says.

    Raises:
        InUseError: another process owns it, which the message names.
        UserError: it cannot be written.
    """
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lease = SoftFileLease(folder / _LOCK, lease_duration=LEASE_S)
        _acquire(lease, folder)
    try:
        with disk_errors(folder):  # else a network file system shows others an empty lock until the first heartbeat
            synchronise(folder / _LOCK)
        owner = Owner(folder)
        try:
            with handled(), hangups():
                yield owner
        finally:
            owner.release()
    finally:
        lease.release()


def in_use(folder: Path) -> bool:
    """Whether a process seems to own a folder: it gave a sign of life of late, and is not known to be gone."""
    note, beat = _read_note(folder), _heartbeat(folder)
    if beat is None or time.time_ns() - beat > LEASE_S * 1e9:
        return False
    return note.get("host") != socket.gethostname() or _runs_here(note)


def _acquire(lease: SoftFileLease, folder: Path) -> None:
    if _take(lease):
        return
    if _stays_empty(folder) and _broken(lease, folder, lambda: _size(folder) == 0) and _take(lease):
        return
    note = _read_note(folder)
    if not _runs_here(note):
        print(f"{folder}: held by {_name(note)}; waiting for a sign of its life", file=sys.stderr)
        seen = _heartbeat(folder)
        if _take(lease, 1.5 * LEASE_S, lambda: _heartbeat(folder) not in (seen, None)):
            return
        # NFS and the like cannot exchange names, by which filelock takes a dead one's
        if _broken(lease, folder, lambda: _heartbeat(folder) == seen) and _take(lease):
            return
    raise InUseError(
        f"{folder}: is in use by {_name(_read_note(folder))}; wait until it ends, or choose another folder"
    )


def _take(lease: SoftFileLease, wait_s: float = 0.0, refused: Callable[[], bool] | None = None) -> bool:
    """Try to take the lease for `wait_s` seconds or until `refused` is true; whether it was taken."""
    try:
        lease.acquire(timeout=wait_s, cancel_check=refused)
    except Timeout:
        return False
    return True


def _stays_empty(folder: Path) -> bool:
    """Whether a process was killed, or a machine lost power, between making the lock and writing its name there."""
    for _ in range(20):
        if _size(folder) != 0:
            return False
        time.sleep(EMPTY_S / 20)
    return True


def _broken(lease: SoftFileLease, folder: Path, is_dead: Callable[[], bool]) -> bool:
    """Remove a lock that is dead; one process at a time does: a slower one would remove its successor's.

    Whether it was this one.
    """
    breaking = folder / _BREAKING
    try:
        breaking.touch(exist_ok=False)
    except FileExistsError:
        with suppress(FileNotFoundError):
            if time.time() - breaking.stat().st_mtime > LEASE_S:  # of a process that was killed at it
                breaking.unlink()
        return False
    try:
        if dead := is_dead():
            lease.force_break()
        return dead
    finally:
        breaking.unlink(missing_ok=True)


def _runs_here(note: dict[str, Any]) -> bool:
    """Whether the owner is a living process of this machine: one of its number may be of a later container."""
    if note.get("host") != socket.gethostname():
        return False
    try:
        os.kill(int(note["pid"]), 0)
    except ProcessLookupError:  # of another container on this machine, or just gone
        return False
    except PermissionError:
        pass
    return note.get("started") in (None, _started(int(note["pid"])))


def _started(pid: int) -> str | None:
    """When a process began, in the system's ticks since it was started; None where the system does not tell."""
    try:
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[19].decode()
    except (OSError, IndexError):
        return None


def _heartbeat(folder: Path) -> int | None:
    """When the owner last gave a sign of life."""
    lock = _lock(folder)
    return None if lock is None else lock.st_mtime_ns


def _size(folder: Path) -> int | None:
    """Bytes of the lock."""
    lock = _lock(folder)
    return None if lock is None else lock.st_size


def _lock(folder: Path) -> os.stat_result | None:
    """What is known of the lock, None if there is none."""
    try:
        with (folder / _LOCK).open("rb") as file:  # opening makes network file systems look anew
            return os.fstat(file.fileno())
    except OSError:
        return None


def _read_note(folder: Path) -> dict[str, Any]:
    try:
        note = parse_json((folder / _NOTE).read_bytes())
    except (OSError, ValueError):
        return {}
    return note if isinstance(note, dict) else {}


def _name(note: dict[str, Any]) -> str:
    if not note:
        return "another process"
    return f"process {note.get('pid')} on {note.get('host')} since {note.get('since')}"
