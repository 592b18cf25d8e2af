"""Files that a sweep writes beside its runs: plans, one row per attempt at a job, and the jobs' logs.

    OUT/sweep/plans/GRID.json    made_in (working directory), out, program (the user's Python file that started the
                                 sweep, if any), and the grid's jobs: name, stage, folder, command, needs;
                                 GRID~*.json: the same for a user's own, narrowed or changed grid
    OUT/sweep/attempts.jsonl     one object per line: job, ended (Unix time), seconds, cause, line, host, words (of its
                                 command), log (relative to OUT), and stack (number of jobs) if it ran in a stack
    OUT/sweep/logs/JOB.log       output of the job; a stack writes to the log of its first job
    OUT/sweep/slurm/             output of a cluster's tasks

Each row is appended in one write, so several drivers can share a folder. Whether a job is finished is never read from
here, only from the job's own folder.
"""

from __future__ import annotations

import hashlib
import json
import os
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
"""Transient causes, worth a retry. Bad input, a bug or a divergence would only recur."""
TRIES = 5  # consecutive transient failures after which a job counts as failed
_RETRIED = "retried"  # cause of the row that clears a job's earlier failures
RUNNING, WAITING, BLOCKED = "running", "waiting", "blocked"
_RECENT = 20  # finished jobs over which the rate is measured, or more if more are running


def plan_name(grid: str, words: Iterable[str]) -> str:
    """Name of the plan for a grid file and the words that narrow or change it, e.g. "ladder" or "ladder~1a2b3c4d"."""
    words = sorted(words)
    return f"{grid}~{hashlib.blake2b(json.dumps(words).encode(), digest_size=4).hexdigest()}" if words else grid


@dataclass(frozen=True)
class Plan:
    """Jobs, and how to start their processes."""

    jobs: list[Job]
    made_in: Path  # working directory of every job, to which relative paths refer
    out: Path  # the sweep's folder, as the jobs' commands name it
    program: list[str]
    """Arguments of `python` instead of `-m vd4rl_pomdp`: the user's own file that registers plug-ins."""


class SweepFolder:
    """The files of a sweep below its folder."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.path = out / "sweep"  # folder of the sweep's own files
        self._attempts = self.path / "attempts.jsonl"

    def keep_plan(self, name: str, jobs: Iterable[Job], program: Iterable[str] = ()) -> Plan:
        """Write a plan, replacing an earlier one of that name. Safe when several drivers write at once."""
        plan = Plan(list(jobs), Path.cwd(), self.out, list(program))
        write_json(self.path / "plans" / f"{name}.json", jsonable(asdict(plan)), shared=True)
        return plan

    def plans(self, name: str = "") -> list[Plan]:
        """The plan of that name, or all plans, with job folders resolved relative to `self.out`.

        UserError if no plan is there, or one is damaged.
        """
        return list(self._plans(name).values())

    def plans_to_do(self, name: str = "") -> list[Plan]:
        """Like `plans`; UserError if the folder was moved, since the jobs' commands still name the old place."""
        plans = self._plans(name)
        for path, plan in plans.items():
            if (plan.made_in / plan.out).resolve() != self.out.resolve():
                raise UserError(
                    f"{self.out}: was planned as {plan.made_in / plan.out}: move it back, or remove {path} and plan it "
                    f"again with `sweep run GRID --out {self.out}`"
                )
        return list(plans.values())

    def _plan_files(self) -> list[Path]:
        return sorted((self.path / "plans").glob("[!.]*.json"))  # macOS writes ._x.json beside x.json

    def _plans(self, name: str) -> dict[Path, Plan]:
        """See `plans`; by file."""
        paths = [path for path in self._plan_files() if name in ("", path.stem)]
        if not paths:
            raise UserError(f"{self.out}: holds no sweep; `vd4rl-pomdp sweep run GRID --out {self.out}` makes one")

        def here(plan: Plan, folder: Path) -> Path:
            inside = folder.is_relative_to(plan.out)  # else a set that lies elsewhere
            return self.out / folder.relative_to(plan.out) if inside else plan.made_in / folder

        plans = {path: read_plan(path) for path in paths}
        return {
            path: replace(plan, jobs=[replace(job, folder=here(plan, job.folder)) for job in plan.jobs])
            for path, plan in plans.items()
        }

    def jobs_of_others(self, name: str) -> list[Job]:
        """The jobs of all plans except `name`, as written."""
        return [job for path in self._plan_files() if path.stem != name for job in read_plan(path).jobs]

    def add(self, row: Row) -> None:
        """Append the row of an attempt; DiskFullError if it could not be written whole."""
        line = (json.dumps(row) + "\n").encode()
        with disk_errors(self._attempts):
            self.path.mkdir(parents=True, exist_ok=True)
            # Unbuffered, a line is one write, so appends of several drivers do not interleave.
            with self._attempts.open("ab+", buffering=0) as file:
                end = file.seek(0, os.SEEK_END)
                if end and os.pread(file.fileno(), 1, end - 1) != b"\n":  # a full disk truncated the previous row
                    line = b"\n" + line
                if file.write(line) < len(line):
                    raise DiskFullError(f"{self._attempts}: the disk is full")

    def forget(self, job: str) -> None:
        self.add({"job": job, "cause": _RETRIED})

    def attempts(self, jobs: Iterable[Job]) -> dict[str, list[Row]]:
        """Attempts by job name, at its current command and since the last `forget`; truncated lines are skipped."""
        found: dict[str, list[Row]] = {job.name: [] for job in jobs}
        words = {job.name: job.words for job in jobs}
        content = read_bytes(self._attempts) if self._attempts.exists() else b""
        for line in content.decode(errors="replace").splitlines():
            try:
                row = parse_json(line)
                rows = found[row["job"]]
                if row["cause"] == _RETRIED:
                    rows.clear()
                # Attempts at an older command do not count.
                elif _same(row["words"], words[row["job"]]) and row.keys() >= {"ended", "seconds", "line"}:
                    rows.append(row)
            except (ValueError, TypeError, KeyError):
                continue
        return found


def _same(words: list[str], others: list[str]) -> bool:
    """Whether two commands are equal, apart from whether they name a folder by its absolute path."""
    pairs = zip(words, others, strict=False)
    return len(words) == len(others) and all(a == b or os.path.abspath(a) == os.path.abspath(b) for a, b in pairs)


def read_plan(path: Path) -> Plan:
    """Read a plan as written; UserError if it is damaged."""
    with damaged(path, "is damaged", "remove it and start `sweep run` again"):
        plan = parse_json(read_bytes(path))
        jobs = [Job(**job | {"folder": Path(job["folder"])}) for job in plan["jobs"]]
        return Plan(jobs, Path(plan["made_in"]), Path(plan["out"]), list(plan["program"]))


def jobs_of(plans: Iterable[Plan]) -> list[Job]:
    """The jobs of several plans, without duplicates."""
    return list({job.name: job for plan in plans for job in plan.jobs}.values())


def failed(rows: list[Row]) -> bool:
    """Whether a job is given up: its last attempt failed, or the last TRIES were all transient failures."""
    causes = [row["cause"] for row in rows[-TRIES:]]  # an interruption among them restarts the count
    alone = not any("stack" in row for row in rows[-1:])  # in a stack, another job may have failed
    return (causes[-1:] == [FAILED] and alone) or (len(causes) == TRIES and set(causes) <= {*PASSING})


def lost_among(jobs: Iterable[Job], rows: Mapping[str, list[Row]]) -> set[str]:
    """Names of unfinished jobs that failed or depend on one that did, in any order."""
    left = list(jobs)
    lost = {job.name for job in left if failed(rows[job.name])}
    while more := {job.name for job in left if not lost.isdisjoint(job.needs)} - lost:
        lost |= more
    return lost


def is_finished(job: Job) -> bool:
    """Whether a job's folder holds a finished result; False if it cannot be read."""
    try:
        with disk_errors(job.folder):
            return job.finished
    except UserError:
        return False


def status(jobs: list[Job], attempts: Mapping[str, list[Row]]) -> dict[str, Any]:
    """Progress of a sweep.

    Returns:
        counts: jobs by state. per_hour: rate of the last finished jobs, without pauses; 0 if there are none.
            seconds_left: at that rate; None if it is 0. finished: whether nothing is left. states: by job name, done,
            running, waiting, failed, or blocked by a failed dependency. failures: the last attempt of every failed job.
    """
    left = [job for job in jobs if not is_finished(job)]
    lost = lost_among(left, attempts)
    states = dict.fromkeys((job.name for job in jobs), DONE)
    for job in left:
        here = RUNNING if in_use(job.folder) else FAILED if failed(attempts[job.name]) else WAITING
        states[job.name] = BLOCKED if here == WAITING and job.name in lost else here
    to_do = sum(state in (RUNNING, WAITING) for state in states.values())
    made = [rows for rows in attempts.values() if any(row["cause"] == DONE for row in rows)]
    number = max(_RECENT, 2 * sum(state == RUNNING for state in states.values()))
    recent = sorted(made, key=lambda rows: rows[-1]["ended"])[-number:]
    per_hour = len(recent) * 3600 / max(1.0, _seconds_of([row for rows in recent for row in rows]))
    return {
        "counts": dict(Counter(states.values())),
        "per_hour": per_hour,
        "seconds_left": to_do * 3600 / per_hour if per_hour else None if to_do else 0.0,
        "finished": not left,
        "states": states,
        "failures": {name: attempts[name][-1] for name, state in states.items() if state == FAILED},
    }


def _seconds_of(attempts: list[Row]) -> float:
    """Seconds in which at least one of some attempts ran."""
    seconds = until = 0.0
    for row in sorted(attempts, key=lambda row: row["ended"] - row["seconds"]):
        seconds += max(0.0, row["ended"] - max(until, row["ended"] - row["seconds"]))
        until = max(until, row["ended"])
    return seconds


def failure(row: Row, out: Path) -> str:
    """One line about the last attempt at a failed job of the sweep in `out`."""
    return f"failed: {row['job']}: {row['line']}" + (f" (see {out / row['log']})" if "log" in row else "")


def in_lines(found: Mapping[str, Any], out: Path) -> list[str]:
    """A status as lines of text; `out` is the sweep's folder."""
    counts = ", ".join(f"{number} {state}" for state, number in sorted(found["counts"].items()))
    left = "unknown" if found["seconds_left"] is None else f"{found['seconds_left'] / 3600:.1f} h"
    return [
        f"{len(found['states'])} jobs: {counts}",
        f"{found['per_hour']:.1f} jobs per hour, {left} left at this rate",
        *(failure(row, out) for row in found["failures"].values()),
        *(f"running: {name}" for name, state in found["states"].items() if state == RUNNING),
    ]
