"""Where a sweep stands, told from its folder alone."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.ownership import in_use
from vd4rl_pomdp.sweeps.driver import attempts_at, given_up, lost_among
from vd4rl_pomdp.sweeps.estimate import Estimates
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.work import DIVERGED, DONE, told_seconds

RUNNING, WAITING, BLOCKED, FAILED = "running", "waiting", "blocked", "failed"
RATE_S = 3600.0
"""A rate is that of the jobs that ended within so many seconds."""


@dataclass(frozen=True)
class Status:
    """What `sweep status` shows."""

    states: dict[str, str]
    """done, running, waiting, blocked (by a failure before it), failed or diverged, by job."""
    per_hour: float
    """Jobs that ended in the last hour, or since the sweep began if that is less, as a rate."""
    seconds_left: float | None
    """Time until all that can be done is done, with as many jobs at a time as run now; None if nothing tells."""
    failures: dict[str, Row]
    """The last attempt at every job that is not tried again."""

    @property
    def counts(self) -> Counter[str]:
        """Jobs by state."""
        return Counter(self.states.values())

    @property
    def finished(self) -> bool:
        """Whether nothing is left."""
        return set(self.states.values()) <= {DONE}


def status(jobs: list[Job], attempts: dict[str, list[Row]], estimates: Estimates) -> Status:
    """Where some jobs stand.

    Args:
        jobs: all jobs of a sweep.
        attempts: rows of their attempts by name.
        estimates: what jobs take.
    """
    rows = {job.name: attempts_at(job, attempts) for job in jobs}
    states = {job.name: _state(job, rows[job.name]) for job in jobs}
    lost = lost_among((job for job in jobs if states[job.name] != DONE), rows)
    states |= {name: BLOCKED for name in lost if states[name] == WAITING}
    failures = {name: rows[name][-1] for name, state in states.items() if state in (FAILED, DIVERGED)}
    left = [job for job in jobs if states[job.name] in (RUNNING, WAITING)]
    seconds = [estimates.seconds(job) for job in left]
    known = [value for value in seconds if value is not None]
    at_once = max(1, sum(state == RUNNING for state in states.values()))
    whole = sum(known) * len(seconds) / len(known) / at_once if known else (0.0 if not left else None)
    return Status(states, _per_hour(attempts), whole, failures)


def _state(job: Job, rows: list[Row]) -> str:
    if job.finished:
        return DONE
    if in_use(job.folder):
        return RUNNING
    cause = given_up(rows)
    return {"": WAITING, DIVERGED: DIVERGED}.get(cause, FAILED)


def _per_hour(attempts: dict[str, list[Row]]) -> float:
    done = [row["ended"] for rows in attempts.values() for row in rows if row["cause"] == DONE]
    began = [row["ended"] - row["seconds"] for rows in attempts.values() for row in rows]
    if not done:
        return 0.0
    now = time.time()
    span = min(RATE_S, max(now - min(began), 1.0))
    return sum(now - ended <= span for ended in done) * 3600 / span


def lines(found: Status) -> list[str]:
    """A status as text."""
    counts = ", ".join(f"{number} {state}" for state, number in sorted(found.counts.items()))
    left = "unknown" if found.seconds_left is None else told_seconds(found.seconds_left)
    shown = [f"{len(found.states)} jobs: {counts}", f"{found.per_hour:.1f} jobs an hour, about {left} left"]
    shown += [f"{row['cause']}: {name}: {row['line']}" for name, row in found.failures.items()]
    shown += [f"running: {name}" for name, state in found.states.items() if state == RUNNING]
    return shown
