"""The one exception that a user may see, and checks that raise it.

A function's first word says when it raises UserError: `check_x` unless x is valid, `require_x` unless there is enough
of x (memory, disk, rows), `refuse_x` for something named x that cannot be accepted. None of them changes anything.
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

TEMPORARY = 75
"""Exit code of what the same command may not meet again, EX_TEMPFAIL of sysexits.h: a sweep tries it again. It sees no
more of a job than this code, and bad input, 2, would be refused every time."""


class UserError(ValueError):
    """Bad input: the message is one line that says what is wrong, where, and what to do.

    The command line prints the message and exits with code 2; a library caller catches a ValueError.
    """

    code = 2
    """Exit code of the command."""


class OutOfMemoryError(UserError):
    """The memory of the machine or its GPU did not suffice."""


class UnavailableError(UserError):
    """The system could not do now what it may do later: a disk that does not answer, too many open files."""

    code = TEMPORARY


class DiskFullError(UnavailableError):
    """No space was left where something was to be written."""


class WorkerDiedError(UserError):
    """A process that helped was ended from outside."""

    code = TEMPORARY


_PASSING = (
    *(errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN, errno.EMFILE, errno.ENFILE, errno.ENOLCK, errno.EBUSY),
    *(errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENETUNREACH),
    *(errno.ECONNREFUSED, errno.ECONNRESET),
)
"""What a network file system or a busy machine answers for a while."""
_OF_CONTENT = (None, errno.EINVAL, errno.ENOENT, errno.ENOTDIR)
"""What a library's error carries that read what is not there, or followed an offset that a damaged file names."""
MAX_SEED = 2**31 - 1
"""Largest seed that every random generator in use takes."""
MOST = 10**9
"""Largest number that any flag takes, unless it says otherwise."""
MOST_ROWS = 2**20
"""Most rows of an episode: the keys of more would be another's."""


def refuse_outside(config: Any, **ranges: float | tuple[float, float]) -> None:
    """Refuse fields of a config outside their range: lowest, or lowest and highest; None passes."""
    for name, limits in ranges.items():
        if (value := getattr(config, name)) is not None:
            refuse_number(name, value, *(limits if isinstance(limits, tuple) else (limits,)))


def refuse_number(name: str, value: float, low: float, high: float = MOST) -> None:
    """Raise UserError, naming the flag, for a number below `low`, above `high`, or NaN."""
    if not low <= value <= high:
        raise UserError(f"{flag_of(name)} is {value}; it must be at least {low} and at most {high}")


def told_apart(value: float, limit: float, decimals: int) -> tuple[str, str]:
    """Two numbers as a message shows them: rounded to `decimals`, or to the fewest more that show which is larger."""

    def shown(number: float) -> str:
        return f"{number:,.{decimals}f}"

    while value != limit and shown(value) == shown(limit):
        decimals += 1
    return shown(value), shown(limit)


OR_ONES_OWN = ", or run or import the file that registers it"
"""What else to do about an unknown name of a kind that parts of one's own can be of."""


def refuse_unknown(kind: str, name: object, choices: Iterable[object], remedy: str = "") -> None:
    """Raise UserError for a name that is none of the choices.

    Args:
        kind: what the name is of.
        name: the name.
        choices: what is listed.
        remedy: what else may be done.
    """
    if name not in (known := list(choices)):
        raise UserError(f"unknown {kind} {name!r}: choose one of {', '.join(map(str, known))}{remedy}")


def first_line(error: BaseException) -> str:
    """What an error says first; its kind if it says nothing."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def in_one_line(error: BaseException) -> str:
    """All that an error says, line breaks and indentation as single blanks; nothing if it says nothing."""
    return " ".join(str(error).split())


def flag_of(name: str) -> str:
    """The flag that sets a config's field."""
    return f"--{name.replace('_', '-')}"


def refuse_no_folder(path: Path) -> None:
    """Raise UserError unless `path` is a folder or can become one, before the work whose result goes there."""
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
            raise UserError(f"{path}: {place} is no folder; choose another folder")
        return


def disk_error(path: Path | str | None, error: OSError) -> UserError:
    """A sentence for a file or folder that could not be read or written; None where the system does not name it."""
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
    """What the system refused to a library that opened or read a file itself; None if the file's content is at fault.

    HDF5 tells the system's number within its sentence, which is all that there is where h5py makes it a KeyError.
    """
    told = re.search(r"\berrno = (\d+)", str(error))
    number = int(told[1]) if told else getattr(error, "errno", None)
    return None if number in _OF_CONTENT else disk_error(path, OSError(number, os.strerror(number)))


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an OSError within the block into one sentence about `path`."""
    try:
        yield
    except OSError as error:
        raise disk_error(path, error) from error
