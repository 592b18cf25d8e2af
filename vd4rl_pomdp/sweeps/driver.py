"""Carries out a plan: starts what can be started, tries again what is worth it, and lets the rest go on.

Whether a job is done, its folder says; so a driver may be killed at any moment, several may work on one folder, and the
next one goes on with whatever is left.
"""

from __future__ import annotations

import os
import random
import socket
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import takewhile

from vd4rl_pomdp.core.errors import (
    DONE,
    INTERRUPTED,
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
from vd4rl_pomdp.sweeps.work import FAILED, KILLED, Ended, Executor

POLL_S = 0.1
TRIES = 5
"""Attempts at a job that end alike without a new checkpoint, before it has failed."""
PAUSE_S = 60.0
"""Before another attempt, whoever made the last."""
IN_USE_S = 10.0
"""Until a job that another driver has is looked at again."""
IDLE_S = 90.0
"""A helping driver that finds nothing to start for so long ends."""
SPREAD = 64
"""Helping drivers choose among so many jobs by chance: all would otherwise start the same one."""
PASSING = (KILLED, OutOfMemoryError.cause, DiskFullError.cause, UnavailableError.cause)
"""Causes that another attempt may not meet. A refusal, a defect or a divergence would only come again."""
_SHORT_OF_MEMORY = (OutOfMemoryError.cause, KILLED)
"""The kernel kills a process when memory runs out, and does not say so."""


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
    if not rows or rows[-1]["cause"] in (DONE, INTERRUPTED):
        return ""
    cause, step = rows[-1]["cause"], rows[-1]["step"]
    here = takewhile(lambda row: row["step"] == step and row["cause"] != INTERRUPTED, reversed(rows))
    return "" if cause in PASSING and len(list(here)) < TRIES else cause


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

    def __init__(self, jobs: Iterable[Job], executor: Executor, folder: SweepFolder, helps: bool = False) -> None:
        """See the module.

        Args:
            jobs: those of the sweep, each after those it needs.
            executor: what runs them.
            folder: the sweep's.
            helps: whether it is one of several on a cluster, which ends when there is nothing to start for IDLE_S.
        """
        self._jobs = {job.name: job for job in jobs}
        self._executor, self._folder, self._helps = executor, folder, helps
        self._left = {job.name: job for job in self._jobs.values() if not job.finished}
        self._running: dict[str, float] = {}
        """When each began."""
        self._not_before: dict[str, float] = {}
        """When to look again at what others have."""
        self._busy = time.monotonic()
        """When something last ran."""
        self._read = 0
        self._learn(folder.attempts())

    def run(self) -> bool:
        """Work until nothing is left that can be done; whether all is finished."""
        try:
            while len(self._left) > len(self._lost) and not self._idle():
                self._look()
                self._start()
                time.sleep(POLL_S)
                self._collect()
                interrupt.check("the sweep's jobs have ended")
        except BaseException:
            self._executor.stop()
            self._collect()
            raise
        return all(map(_is_finished, self._left.values()))  # others may have finished what was given up here

    def _idle(self) -> bool:
        if self._running:
            self._busy = time.monotonic()
        return self._helps and time.monotonic() - self._busy > IDLE_S

    def _look(self) -> None:
        """Learn of all attempts, other drivers' too: what is given up is so for everybody."""
        with suppress(UnavailableError):  # the next time, then
            if (size := self._folder.attempts_size()) != self._read:
                self._learn(self._folder.attempts())
                self._read = size

    def _learn(self, attempts: dict[str, list[Row]]) -> None:
        self._rows = {name: attempts_at(job, attempts) for name, job in self._jobs.items()}
        self._lost = lost_among(self._left.values(), self._rows)

    def _start(self) -> None:
        """Start every job that can be."""
        ready = [job for job in self._left.values() if self._ready(job)]
        if self._helps:
            ready = random.sample(ready[:SPREAD], min(SPREAD, len(ready)))
        for job in ready:
            if not self._executor.fits(1):
                break
            if self._executor.fits(self._slots(job)) and not self._elsewhere(job):
                self._begin(job)

    def _begin(self, job: Job) -> None:
        self._running[job.name] = time.monotonic()
        try:
            with disk_errors(job.folder):
                self._executor.start(self._folder.work(job, self._slots(job)))
        except UserError as error:
            self._end(Ended(job.name, error.cause, str(error)))

    def _ready(self, job: Job) -> bool:
        free = job.name not in self._running and time.monotonic() >= self._not_before.get(job.name, 0)
        last = (self._rows[job.name] or [{"cause": DONE}])[-1]
        free = free and not (last["cause"] in PASSING and time.time() < last.get("ended", 0) + PAUSE_S)
        return free and job.name not in self._lost and not any(name in self._left for name in job.needs)

    def _elsewhere(self, job: Job) -> bool:
        """Whether another process has finished a job, or is at it, or its folder does not tell, now or ever."""
        try:
            with disk_errors(job.folder):
                if job.finished:
                    del self._left[job.name]
                    return True
                if not in_use(job.folder):
                    return False
        except UnavailableError:
            pass
        except UserError as error:
            self._running[job.name] = time.monotonic()
            self._end(Ended(job.name, error.cause, str(error)))
            return True
        self._not_before[job.name] = time.monotonic() + IN_USE_S
        return True

    def _slots(self, job: Job) -> int:
        """One, and twice as many after every attempt that the memory may not have sufficed for."""
        short = sum(row["cause"] in _SHORT_OF_MEMORY for row in self._rows[job.name])
        return min(2**short, self._executor.largest)

    def _collect(self) -> None:
        for ended in self._executor.ended():
            self._end(ended)

    def _end(self, ended: Ended) -> None:
        seconds = time.monotonic() - self._running.pop(ended.name)
        if ended.cause == InUseError.cause:  # another driver was faster: no attempt at the job
            self._not_before[ended.name] = time.monotonic() + IN_USE_S
            return
        ended, finished, step = self._outcome(ended)
        self._note(ended, {"seconds": round(seconds, 1), "step": step})
        if finished:
            del self._left[ended.name]
        else:
            self._lost = lost_among(self._left.values(), self._rows)
        say(ended.name, ended.cause, seconds, ended.line, len(self._jobs) - len(self._left), len(self._jobs))

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


def say(name: str, cause: str, seconds: float, told: str, done: int, of: int) -> None:
    """Print how an attempt at a job ended."""
    line = f"[{done}/{of}] {cause:<13} {seconds:6.0f} s  {name}" + (f": {told}" if told else "")
    print(line, file=sys.stderr, flush=True)
