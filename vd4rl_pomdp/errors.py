"""The one exception that a user may see."""

from __future__ import annotations

import errno
from pathlib import Path


class UserError(ValueError):
    """Bad input: the message is one line that says what is wrong, where, and what to do.

    The command line prints the message and exits with code 2; a library caller catches a ValueError.
    """


def disk_error(path: Path | str | None, error: OSError) -> UserError:
    """A sentence for a file or folder that could not be read or written; None where the system does not name it."""
    where = f"{path}: " if path is not None else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(f"{where}the disk is full: free some space and start the same command again")
    reason = (error.strerror or str(error)).lower()
    return UserError(f"{where}cannot be used ({reason}); check the path or choose another")
