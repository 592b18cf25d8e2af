"""A job as an executor gets it, and how its process says how it ended: by its exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from vd4rl_pomdp.core.errors import (
    DIVERGED,
    DONE,
    INTERRUPTED,
    DiskFullError,
    InUseError,
    OutOfMemoryError,
    UnavailableError,
    UserError,
    WorkerDiedError,
)
from vd4rl_pomdp.sweeps.oom import oom_kills

FAILED = "failed"
KILLED = WorkerDiedError.cause
_FIRST = 64
_BEGINS = b"-- an attempt begins --\n"
"""What stands in a log before what an attempt prints."""
_ROOT = Path(__file__).parents[2]
_CAUSES = (UserError, OutOfMemoryError, DiskFullError, UnavailableError, InUseError, WorkerDiedError)
CAUSES = (*(kind.cause for kind in _CAUSES), DIVERGED, INTERRUPTED)
"""Causes that a job's process tells; its exit code is _FIRST and the position here."""


@dataclass(frozen=True)
class Work:
    """One attempt at a job."""

    name: str
    words: tuple[str, ...]
    log: Path
    """What the command prints goes to this file's end."""
    slots: int = 1
    """Share of the executor's places that it takes."""
    own_file: dict[str, str] = field(default_factory=dict)
    """Where the parts of one's own come from that its process imports, as `sweeps.own_file` has it."""
    sources: dict[str, str] = field(default_factory=dict)
    """What the parts that it names were when the sweep was started, as `registry.sources` tells them."""


@dataclass(frozen=True)
class Ended:
    """How an attempt ended."""

    name: str
    cause: str
    line: str
    """The last line of its log."""


class Executor(Protocol):
    """Where jobs run. Run folders and logs lie on a disk that driver and jobs share."""

    @property
    def largest(self) -> int:
        """The most slots that share a memory, so that one job may take them all."""

    def fits(self, slots: int) -> bool:
        """Whether so many slots wait for a job."""

    def start(self, work: Work) -> None:
        """Begin a job that fits."""

    def ended(self) -> list[Ended]:
        """What has ended since the last call."""

    def stop(self) -> None:
        """Ask every job to end where nothing is lost, and wait for it."""


def start_process(work: Work, environment: Mapping[str, str], cores: Sequence[int] = ()) -> subprocess.Popen:
    """Start the process that does a job and appends to its log.

    Args:
        work: the job.
        environment: what is added to this process's environment.
        cores: those that it may use; none: all.
    """
    told: dict[str, Any] = {"words": work.words, "own_file": work.own_file, "sources": work.sources}
    told |= {"cores": list(cores), "parent": os.getpid()}
    work.log.parent.mkdir(parents=True, exist_ok=True)
    with work.log.open("ab") as log:
        log.write(_BEGINS)
        log.flush()
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "vd4rl_pomdp.sweeps.worker", json.dumps(told)],
            env=os.environ | {"PYTHONPATH": _path()} | dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is the driver's business
        )


def _path() -> str:
    """Where a job imports from first: these very packages, whatever ones of their names the working directory holds."""
    return os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))


def wait_or_kill(process: subprocess.Popen, seconds: float) -> None:
    """Wait for a process that was asked to end, and kill it when its time is over."""
    try:
        process.wait(max(0.0, seconds))
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def code_of(cause: str) -> int:
    """Exit code of a process that ended for a cause."""
    return 0 if cause == DONE else _FIRST + CAUSES.index(cause)


def ended(work: Work, code: int, oom_kills_before: int | None = None) -> Ended:
    """How a job's process ended.

    Args:
        work: the job.
        code: its exit code, negative for a signal, as `subprocess` has it.
        oom_kills_before: `oom_kills()` when it began; None: not known.
    """
    if code == 0:
        return Ended(work.name, DONE, "")
    told = CAUSES[code - _FIRST] if _FIRST <= code < _FIRST + len(CAUSES) else None
    killed = code == -signal.SIGKILL or told == KILLED  # the job itself, or a worker of it
    if killed and oom_kills_before is not None and oom_kills() > oom_kills_before:
        return Ended(work.name, OutOfMemoryError.cause, "the kernel killed it for want of memory")
    return Ended(work.name, told or (KILLED if code < 0 else FAILED), last_line(work.log))


def last_line(log: Path) -> str:
    """The last line that is not empty in a log, of its last attempt if it is a job's."""
    try:
        text = log.read_bytes()[-4096:].rpartition(_BEGINS)[2].decode(errors="replace")
    except OSError:
        return ""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


def told_seconds(seconds: float) -> str:
    """A time as one reads it: "42 s", "12 min", "3.4 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
