"""A job as an executor gets it, a task as a cluster does, and how a process says how it ended: by its exit code."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
    disk_errors,
)

FAILED = "failed"
KILLED = WorkerDiedError.cause
PATIENCE_S = 120.0
"""Seconds that a job has to end in after SIGTERM: it finishes a step and writes a checkpoint."""
POLL_S = 0.5
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


class Cluster(Protocol):
    """Where tasks run. They see the folders of runs and sets at the same paths."""

    folder: Path
    """For what tasks print."""
    jobs_per_task: int
    """Jobs of a task at a time."""
    threads: int
    """CPU threads of a job; 0: its share of the task's cores."""

    @property
    def tasks(self) -> int:
        """The most at a time."""

    def live(self) -> int:
        """How many tasks of this sweep wait or run; UnavailableError if the cluster does not answer."""

    def submit(self, task: ClusterTask, number: int) -> None:
        """Ask for tasks; UnavailableError if it may succeed later, UserError if it was refused."""

    def stop(self) -> None:
        """Take waiting tasks back, ask running ones to end where nothing is lost, and wait for them."""


@dataclass(frozen=True)
class ClusterTask:
    """What a task does: `sweep join` in a process of its own, which ends when the task is asked to."""

    work: Work
    cwd: str
    """In which relative paths begin."""

    def run(self, asked: list[int]) -> Ended:
        """Wait for the process, and end it in peace once a signal is in `asked`, or at a KeyboardInterrupt.

        Raises:
            UserError: this machine does not have the folder, or the log's disk takes nothing now.
        """
        here = socket.gethostname()
        try:
            os.chdir(self.cwd)
        except OSError as error:
            raise UserError(f"{self.cwd}: not on node {here}; use a disk that all nodes share") from error
        work = replace(self.work, log=self.work.log / f"{here}-{os.getpid()}.log")
        with disk_errors(work.log):
            process = start_process(work, {})
        with suppress(KeyboardInterrupt):  # as which Ray's cancellation arrives
            while process.poll() is None and not asked:
                time.sleep(POLL_S)
        if process.poll() is None:
            process.terminate()
            wait_or_kill(process, PATIENCE_S + 10 * POLL_S)
        return ended(work, process.returncode)


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


def ended(work: Work, code: int) -> Ended:
    """How a job's process ended.

    Args:
        work: the job.
        code: its exit code, negative for a signal, as `subprocess` has it.
    """
    if code == 0:
        return Ended(work.name, DONE, "")
    told = CAUSES[code - _FIRST] if _FIRST <= code < _FIRST + len(CAUSES) else None
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
