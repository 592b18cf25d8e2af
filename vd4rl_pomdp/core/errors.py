"""The exceptions that users may see, and checks that raise them.

Naming: `check_x` raises UserError unless x is valid, `require_x` unless there is enough of x (memory, disk, rows), and
`refuse_x` if something is an x that cannot be accepted. None of them changes anything.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISDIR
from typing import Any

from vd4rl_pomdp.core.text import one_line

TEMPORARY = 75
"""Exit code of failures that a retry may fix, EX_TEMPFAIL of sysexits.h. A sweep sees only a job's exit code: it
retries after 75, but not after 2 (bad input)."""


class UserError(ValueError):
    """Bad input: a one-line message with what is wrong, where, and what to do.

    The command line prints it and exits with code 2; library users can catch ValueError.
    """

    code = 2
    """Exit code of the command."""


class OutOfMemoryError(UserError):
    """The machine or its GPU ran out of memory."""


class UnavailableError(UserError):
    """The system failed in a way that may pass: a disk that does not answer, too many open files."""

    code = TEMPORARY


class DiskFullError(UnavailableError):
    """The disk is full."""


class WorkerDiedError(UserError):
    """A worker process was killed from outside."""

    code = TEMPORARY


_PASSING = (
    *(errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN, errno.EMFILE, errno.ENFILE, errno.ENOLCK, errno.EBUSY),
    *(errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENETUNREACH),
    *(errno.ECONNREFUSED, errno.ECONNRESET),
)
"""Transient errors of network file systems and busy machines."""
_OF_CONTENT = (None, errno.EINVAL, errno.ENOENT, errno.ENOTDIR)
"""Error numbers that point at a file's content: libraries report them for missing data or offsets in a damaged file."""
MAX_SEED = 2**31 - 1
"""Largest seed that all random generators accept."""
MOST = 10**9
"""Default upper limit of numeric flags."""
MOST_ROWS = 2**20
"""Maximum rows per episode; more would overflow into the next episode's row keys."""


def refuse_outside(config: Any, **ranges: float | tuple[float, float]) -> None:
    """Raise UserError for config fields outside `low` or `(low, high)`; None is allowed."""
    for name, limits in ranges.items():
        if (value := getattr(config, name)) is not None:
            refuse_number(name, value, *(limits if isinstance(limits, tuple) else (limits,)))


def refuse_number(name: str, value: float, low: float, high: float = MOST) -> None:
    """Raise UserError, naming the flag, for a number below `low`, above `high`, or NaN."""
    if not low <= value <= high:
        raise UserError(f"{flag_of(name)} is {value}; it must be at least {low} and at most {high}")


def distinct_texts(value: float, limit: float, decimals: int) -> tuple[str, str]:
    """Format two numbers for a message with just enough decimals, at least `decimals`, to show which is larger."""
    texts = f"{value:,.{decimals}f}", f"{limit:,.{decimals}f}"
    return distinct_texts(value, limit, decimals + 1) if value != limit and texts[0] == texts[1] else texts


OR_ONES_OWN = ", or run or import the file that registers it"
"""Extra advice for an unknown name of a kind that users can register themselves."""


def refuse_unknown(kind: str, name: object, choices: Iterable[object], remedy: str = "") -> None:
    """Raise UserError for the name of a `kind`, e.g. "method", that is not among the choices."""
    if name not in (known := list(choices)):
        raise UserError(f"unknown {kind} {name!r}: choose one of {', '.join(map(str, known))}{remedy}")


def first_line(error: BaseException) -> str:
    """First line of an error's message, or its class name if there is none; unprintable characters as `one_line`."""
    return one_line(next(iter(str(error).splitlines()), type(error).__name__))


def in_one_line(error: BaseException) -> str:
    """An error's message on one line, with whitespace collapsed and "?" for unprintable characters; "" if none."""
    return one_line(" ".join(str(error).split()))


def flag_of(name: str) -> str:
    """The flag of a config field: "max_k" -> "--max-k"."""
    return f"--{name.replace('_', '-')}"


def refuse_no_folder(path: Path) -> None:
    """Raise UserError unless `path` is or can become a folder. Called before work whose result goes there."""
    for place in (path, *path.parents):
        try:
            mode = place.stat().st_mode
        except FileNotFoundError:
            if not place.is_symlink():
                continue
            mode = 0
        except OSError as error:
            raise disk_error(path, error) from error
        if not S_ISDIR(mode):
            raise UserError(f"{path}: {place} is not a folder; choose another folder")
        return


def disk_error(path: Path | str | None, error: OSError) -> UserError:
    """UserError for a file or folder that could not be read or written; `path` is None if the system names none."""
    where = f"{path}: " if path is not None else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFullError(f"{where}the disk is full: free some space and re-run the same command")
    reason = (error.strerror or str(error)).lower()
    if error.errno == errno.ENOMEM:
        return OutOfMemoryError(f"{where}{reason}: end other programs, or run fewer jobs at a time")
    if error.errno in _PASSING:
        return UnavailableError(f"{where}cannot be used now ({reason}); re-run the same command")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return UserError(f"{where}may not be used ({reason}); ask its owner for access, or choose another path")
    return UserError(f"{where}cannot be used ({reason}); check the path or choose another")


def system_error(path: Path, error: Exception) -> UserError | None:
    """UserError for an OS error behind a library's exception; None if the file's content is at fault.

    HDF5 puts the errno into its message text, and h5py may even turn it into a KeyError.
    """
    found = re.search(r"\berrno = (\d+)", str(error))
    number = int(found[1]) if found else getattr(error, "errno", None)
    return None if number in _OF_CONTENT else disk_error(path, OSError(number, os.strerror(number)))


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an OSError within the block into a UserError about `path`."""
    try:
        yield
    except OSError as error:
        raise disk_error(path, error) from error
