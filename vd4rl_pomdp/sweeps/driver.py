"""Carries out a plan: starts what can be started, tries again what is worth it, and lets the rest go on.

Whether a job is done, its folder says; so a driver may be killed at any moment, several may work on one folder, and the
next one goes on with whatever is left.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import takewhile

from vd4rl_pomdp.core.errors import (
    DiskFullError,
    InUseError,
    OutOfMemoryError,
    UnavailableError,
    UserError,
    disk_errors,
)
from vd4rl_pomdp.core.registry import of_other_code, sources
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.ownership import in_use
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.progress import progress_of
from vd4rl_pomdp.sweeps.work import DIVERGED, DONE, FAILED, INTERRUPTED, KILLED, Ended, Executor

POLL_S = 0.1


@dataclass(frozen=True)
class Retry:
    """What is done about a cause."""

    times: int
    """How often a job is tried again without having got further or having been ended from outside."""
    wait_s: float = 0.0
    """Before that."""


_ALWAYS = 10**6
RETRIES = {
    KILLED: Retry(4),
    DiskFullError.cause: Retry(20, 30.0),
    UnavailableError.cause: Retry(20, 30.0),
    InUseError.cause: Retry(_ALWAYS, 10.0),
    INTERRUPTED: Retry(_ALWAYS),
    OutOfMemoryError.cause: Retry(1),
    FAILED: Retry(1),
    UserError.cause: Retry(0),
    DIVERGED: Retry(0),
}
"""By cause. Out of memory is tried again with twice the slots; where a job had them all already, it is not."""


def attempts_at(job: Job, attempts: dict[str, list[Row]]) -> list[Row]:
    """A job's attempts, oldest first: those at its present command, and with its parts as their files now have them.

    A corrected grid changes the one, a mended part of one's own the others.
    """
    words, settings = list(job.words), dict(job.settings)
    rows = (row for row in attempts.get(job.name, []) if row.get("words", words) == words)
    return [row for row in rows if not of_other_code(row, settings)]


def given_up(rows: list[Row]) -> str:
    """Why a job is not tried again, judging by its attempts since it was last taken up; empty if it is.

    What was done once, and is there no more, is done again.
    """
    if not rows or rows[-1]["cause"] == DONE:
        return ""
    last = rows[-1]
    here = takewhile(lambda row: row["step"] == last["step"] and row["cause"] != INTERRUPTED, reversed(rows))
    alike = sum(row["cause"] == last["cause"] for row in here)
    hopeless = last["cause"] == OutOfMemoryError.cause and last["slots"] >= last.get("largest", 1)
    return last["cause"] if hopeless or alike > RETRIES.get(last["cause"], Retry(0)).times else ""


def lost_among(jobs: Iterable[Job], rows: Mapping[str, list[Row]]) -> set[str]:
    """Of unfinished jobs, each after those it needs, the names of those given up, and of those that need such a one."""
    lost: set[str] = set()
    for job in jobs:
        if given_up(rows[job.name]) or not lost.isdisjoint(job.needs):
            lost.add(job.name)
    return lost


def _is_finished(job: Job) -> bool:
    """Whether a job's folder says that it is finished, which one that cannot be read does not."""
    try:
        with disk_errors(job.folder):
            return job.finished
    except UserError:
        return False


def _finished_anew(job: Job) -> bool:
    """Whether a job is finished, listing its folder first: NFS may remember for a minute that a file was not there."""
    if job.folder.is_dir():
        os.listdir(job.folder)
    return job.finished


class Driver:
    """One process's part in a sweep."""

    def __init__(self, jobs: Iterable[Job], executor: Executor, folder: SweepFolder) -> None:
        """See the module."""
        self._jobs = {job.name: job for job in jobs}
        self._executor, self._folder = executor, folder
        attempts = folder.attempts()
        self._rows = {name: attempts_at(job, attempts) for name, job in self._jobs.items()}
        self._left = {job.name: job for job in self._jobs.values() if not job.finished}
        self._running: dict[str, tuple[float, int, int]] = {}
        """When each began, its slots, and the most it could have had."""
        self._not_before: dict[str, float] = {}
        self._lost = lost_among(self._left.values(), self._rows)
        """What is left and will stay so."""

    def run(self) -> bool:
        """Work until nothing is left that can be done; whether all is finished."""
        try:
            while len(self._left) > len(self._lost):
                self._start()
                time.sleep(POLL_S)
                self._collect()
                interrupt.check("the sweep's jobs have ended")
        except BaseException:
            self._executor.stop()
            self._collect()
            raise
        return all(map(_is_finished, self._left.values()))  # others may have finished what was given up here

    def _start(self) -> None:
        """Start every job that can be."""
        for job in filter(self._ready, list(self._left.values())):
            if not self._executor.fits(1):
                break
            if self._executor.fits(self._slots(job)) and not self._elsewhere(job):
                self._begin(job)

    def _begin(self, job: Job) -> None:
        self._count(job)
        try:
            with disk_errors(job.folder):
                self._executor.start(self._folder.work(job, self._slots(job)))
        except UserError as error:
            self._end(Ended(job.name, error.cause, str(error)))

    def _count(self, job: Job) -> None:
        self._running[job.name] = (time.monotonic(), self._slots(job), self._executor.largest)

    def _ready(self, job: Job) -> bool:
        free = job.name not in self._running and time.monotonic() >= self._not_before.get(job.name, 0)
        return free and job.name not in self._lost and not any(name in self._left for name in job.needs)

    def _elsewhere(self, job: Job) -> bool:
        """Whether another process has finished a job, or is at it, or its folder does not tell, now or ever."""
        try:
            with disk_errors(job.folder):
                if job.finished:
                    del self._left[job.name]
                    return True
                cause = InUseError.cause if in_use(job.folder) else ""
        except UnavailableError as error:
            cause = error.cause
        except UserError as error:
            self._count(job)
            self._end(Ended(job.name, error.cause, str(error)))
            return True
        if cause:
            self._not_before[job.name] = time.monotonic() + RETRIES[cause].wait_s
        return bool(cause)

    def _slots(self, job: Job) -> int:
        """One, or twice as many as when the memory last did not suffice."""
        short = [row["slots"] for row in self._rows[job.name] if row["cause"] == OutOfMemoryError.cause]
        return min(2 * max(short), self._executor.largest) if short else 1

    def _collect(self) -> None:
        for ended in self._executor.ended():
            self._end(ended)

    def _end(self, ended: Ended) -> None:
        began, slots, largest = self._running.pop(ended.name)
        seconds = time.monotonic() - began
        ended, finished, step = self._outcome(ended)
        self._note(ended, {"seconds": round(seconds, 1), "slots": slots, "largest": largest, "step": step})
        if finished:
            del self._left[ended.name]
        else:
            self._not_before[ended.name] = time.monotonic() + RETRIES[ended.cause].wait_s
            self._lost = lost_among(self._left.values(), self._rows)
        self._say(ended, seconds)

    def _outcome(self, ended: Ended) -> tuple[Ended, bool, int]:
        """How an attempt ended, whether its job is finished, and how far it is, as far as the disk tells now."""
        job = self._jobs[ended.name]
        try:
            with disk_errors(job.folder):
                finished, step = job.finished or (ended.cause == DONE and _finished_anew(job)), progress_of(job)
        except UserError as error:
            before = [row.get("step") or 0 for row in self._rows[job.name]]
            return Ended(job.name, error.cause, str(error)), False, max(before, default=0)
        if ended.cause == DONE and not finished:
            ended = Ended(job.name, FAILED, f"{job.folder}: holds nothing finished, though the command ended well")
        return ended, finished, step

    def _note(self, ended: Ended, took: Row) -> None:
        """Keep the row of an attempt, here and on the disk, unless that takes nothing now."""
        job = self._jobs[ended.name]
        row: Row = {"job": ended.name, "cause": ended.cause, "line": ended.line, "ended": round(time.time(), 1)} | took
        row |= {"host": socket.gethostname(), "words": list(job.words), "sources": sources(dict(job.settings))}
        self._rows[ended.name].append(row)
        try:
            self._folder.add(row)
        except UnavailableError as error:
            print(f"warning: {error}", file=sys.stderr)

    def _say(self, ended: Ended, seconds: float) -> None:
        done = len(self._jobs) - len(self._left)
        line = f"[{done}/{len(self._jobs)}] {ended.cause:<13} {seconds:6.0f} s  {ended.name}"
        line += f": {ended.line}" if ended.line else ""
        print(line, file=sys.stderr, flush=True)
