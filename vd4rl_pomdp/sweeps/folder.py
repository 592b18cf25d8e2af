"""What a sweep keeps beside its runs: its plans, one row for every attempt at a job, and what the jobs printed.

    OUT/sweep/plans/GRID.json    made_in (the working directory), out, program (a file of one's own that the sweep
                                 was started from), and the jobs of a grid: name, stage, folder, command, needs;
                                 GRID~*.json those of a grid of one's own, of a part of one, or of one with other
                                 settings
    OUT/sweep/attempts.jsonl     one object a line: job, ended (Unix time), seconds, cause, line, host, words (of its
                                 command), log (below OUT); of a job in a stack also stack (its number of jobs)
    OUT/sweep/logs/JOB.log       what a stack prints is in that of its first job
    OUT/sweep/slurm/             what the tasks of a cluster print

Rows are appended whole, so that several drivers may share a folder. Whether a job is finished is never read here: its
own folder says it.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import DiskFullError, UserError, disk_errors
from vd4rl_pomdp.core.reading import damaged, parse_json, read_bytes
from vd4rl_pomdp.runs.files import Row, jsonable, write_json
from vd4rl_pomdp.runs.outputs import in_use
from vd4rl_pomdp.sweeps.plan import Job

DONE, INTERRUPTED, KILLED, UNAVAILABLE, FAILED = "done", "interrupted", "killed", "unavailable", "failed"
"""How an attempt at a job ended."""
PASSING = (KILLED, UNAVAILABLE)
"""What another attempt may not meet. A refusal, a defect or a divergence would only come again."""
TRIES = 5
"""Attempts in a row that end so before a job has failed."""
_RETRIED = "retried"
"""Cause of a row that says: forget this job's failures."""
RUNNING, WAITING, BLOCKED = "running", "waiting", "blocked"
_RATE_S = 3600.0
"""A rate is that of the jobs that ended within so many seconds."""


def plan_name(grid: str, words: Iterable[str]) -> str:
    """What a grid's plan is called, given its file and what narrows or changes it: each such command has its own."""
    told = sorted(words)
    return f"{grid}~{hashlib.blake2b(json.dumps(told).encode(), digest_size=4).hexdigest()}" if told else grid


@dataclass(frozen=True)
class Plan:
    """Jobs, and how their processes are started."""

    jobs: list[Job]
    made_in: Path
    """The working directory of every job, which relative paths begin at."""
    out: Path
    """The sweep's folder, as its jobs' commands name it."""
    program: list[str]
    """What stands behind `python` in place of `-m vd4rl_pomdp`: a file of one's own that registers parts."""


class SweepFolder:
    """The files of a sweep below its folder."""

    def __init__(self, out: Path) -> None:
        """Nothing is written."""
        self.out = out
        self.path = out / "sweep"
        """Where they lie."""
        self._attempts = self.path / "attempts.jsonl"

    def keep_plan(self, name: str, jobs: Iterable[Job], program: Iterable[str] = ()) -> Plan:
        """Write a plan, in place of what was written of it before; other drivers may do so at once."""
        plan = Plan(list(jobs), Path.cwd(), self.out, list(program))
        with disk_errors(self.path):
            (self.path / "plans").mkdir(parents=True, exist_ok=True)
        write_json(self.path / "plans" / f"{name}.json", jsonable(asdict(plan)), shared=True)
        return plan

    def plans(self, name: str = "") -> list[Plan]:
        """The plan of a name, or all; the jobs' folders as seen from here.

        Raises:
            UserError: there is none, or one is damaged.
        """
        paths = [path for path in sorted((self.path / "plans").glob("*.json")) if name in ("", path.stem)]
        if not paths:
            raise UserError(f"{self.out}: holds no sweep; `vd4rl-pomdp sweep run GRID --out {self.out}` makes one")
        plans = []
        for plan in map(read_plan, paths):
            jobs = [
                replace(
                    job,
                    folder=self.out / job.folder.relative_to(plan.out)
                    if job.folder.is_relative_to(plan.out)
                    else plan.made_in / job.folder,  # a set that lies elsewhere
                )
                for job in plan.jobs
            ]
            plans.append(replace(plan, jobs=jobs))
        return plans

    def plans_to_do(self, name: str = "") -> list[Plan]:
        """As `plans`; UserError if the folder was moved, so that their commands name another one."""
        plans = self.plans(name)
        for plan in plans:
            if (plan.made_in / plan.out).resolve() != self.out.resolve():
                raise UserError(
                    f"{self.out}: was planned as {plan.made_in / plan.out}: move it back, or plan it anew by `sweep "
                    f"run GRID --out {self.out}`"
                )
        return plans

    def jobs_of_others(self, name: str) -> list[Job]:
        """The jobs of all plans but one, as they were written."""
        paths = sorted((self.path / "plans").glob("*.json"))
        return [job for path in paths if path.stem != name for job in read_plan(path).jobs]

    def add(self, row: Row) -> None:
        """Append the row of an attempt; DiskFullError if the disk takes a part of it at most."""
        line = (json.dumps(row) + "\n").encode()
        with disk_errors(self._attempts):
            self.path.mkdir(parents=True, exist_ok=True)
            # Unbuffered, a line is one write, and appends of several drivers do not mix.
            with self._attempts.open("ab+", buffering=0) as file:
                end = file.seek(0, os.SEEK_END)
                if end and os.pread(file.fileno(), 1, end - 1) != b"\n":  # a full disk cut the row before
                    line = b"\n" + line
                if file.write(line) < len(line):
                    raise DiskFullError(f"{self._attempts}: the disk is full")

    def forget(self, job: str) -> None:
        """Have the job taken up as if it had never been tried."""
        self.add({"job": job, "cause": _RETRIED})

    def attempts(self, jobs: Iterable[Job]) -> dict[str, list[Row]]:
        """By job, attempts at its present command since it was last taken up again; a line that was cut is left out."""
        found: dict[str, list[Row]] = {job.name: [] for job in jobs}
        words = {job.name: job.words for job in jobs}
        content = read_bytes(self._attempts) if self._attempts.exists() else b""
        for line in content.decode(errors="replace").splitlines():
            try:
                row = parse_json(line)
                rows = found[row["job"]]
                if row["cause"] == _RETRIED:
                    rows.clear()
                # A corrected command has not failed yet.
                elif row["words"] == words[row["job"]] and row.keys() >= {"ended", "seconds", "line"}:
                    rows.append(row)
            except (ValueError, TypeError, KeyError):
                continue
        return found


def read_plan(path: Path) -> Plan:
    """A plan as it was written; UserError if it is damaged."""
    with damaged(path, "is damaged", "remove it and start `sweep run` again"):
        told = parse_json(read_bytes(path))
        jobs = [Job(**job | {"folder": Path(job["folder"])}) for job in told["jobs"]]
        return Plan(jobs, Path(told["made_in"]), Path(told["out"]), list(told["program"]))


def jobs_of(plans: Iterable[Plan]) -> list[Job]:
    """The jobs of several plans, once each."""
    return list({job.name: job for plan in plans for job in plan.jobs}.values())


def failed(rows: list[Row]) -> bool:
    """Whether a job is not tried again, judging by its attempts: one failed, or too many in a row were of no use."""
    causes = [row["cause"] for row in rows[-TRIES:]]  # an interruption among them begins the count anew
    alone = not any("stack" in row for row in rows[-1:])  # a stack's failure may be another job's
    return (causes[-1:] == [FAILED] and alone) or (len(causes) == TRIES and set(causes) <= {*PASSING})


def lost_among(jobs: Iterable[Job], rows: Mapping[str, list[Row]]) -> set[str]:
    """Of unfinished jobs, each after those it needs, the names of those that failed or need such a one."""
    lost: set[str] = set()
    for job in jobs:
        if failed(rows[job.name]) or not lost.isdisjoint(job.needs):
            lost.add(job.name)
    return lost


def is_finished(job: Job) -> bool:
    """Whether a job's folder says that it is finished, which one that cannot be read does not."""
    try:
        with disk_errors(job.folder):
            return job.finished
    except UserError:
        return False


def status(jobs: list[Job], attempts: Mapping[str, list[Row]]) -> dict[str, Any]:
    """Where a sweep stands.

    Returns:
        counts of jobs by state; per_hour: jobs that ended in the last hour, or since the sweep began, as a rate;
        seconds_left at that rate, None without one; finished: whether nothing is left; states by job: done, running,
        waiting, failed, or blocked by a failure before it; failures: the last attempt at every failed job.
    """
    left = [job for job in jobs if not is_finished(job)]
    lost = lost_among(left, attempts)
    states = dict.fromkeys((job.name for job in jobs), DONE)
    for job in left:
        here = RUNNING if in_use(job.folder) else FAILED if failed(attempts[job.name]) else WAITING
        states[job.name] = BLOCKED if here == WAITING and job.name in lost else here
    to_do = sum(state in (RUNNING, WAITING) for state in states.values())
    tried, now = [row for rows in attempts.values() for row in rows], time.time()
    began = min((row["ended"] - row["seconds"] for row in tried), default=now)
    span = min(_RATE_S, max(now - began, 1.0))
    per_hour = sum(row["cause"] == DONE and now - row["ended"] <= span for row in tried) * 3600 / span
    return {
        "counts": dict(Counter(states.values())),
        "per_hour": per_hour,
        "seconds_left": to_do * 3600 / per_hour if per_hour else None if to_do else 0.0,
        "finished": not left,
        "states": states,
        "failures": {name: attempts[name][-1] for name, state in states.items() if state == FAILED},
    }


def failure(row: Row, out: Path) -> str:
    """The last attempt at a failed job of the sweep in `out`, as a line."""
    return f"failed: {row['job']}: {row['line']}" + (f" (see {out / row['log']})" if "log" in row else "")


def in_lines(found: Mapping[str, Any], out: Path) -> list[str]:
    """A status as text, of the sweep in `out`."""
    counts = ", ".join(f"{number} {state}" for state, number in sorted(found["counts"].items()))
    left = "unknown" if found["seconds_left"] is None else f"{found['seconds_left'] / 3600:.1f} h"
    shown = [
        f"{len(found['states'])} jobs: {counts}",
        f"{found['per_hour']:.1f} jobs an hour, {left} left at this rate",
    ]
    shown += [failure(row, out) for row in found["failures"].values()]
    return shown + [f"running: {name}" for name, state in found["states"].items() if state == RUNNING]
