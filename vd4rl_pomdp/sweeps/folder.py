"""What a sweep keeps beside its runs: its plans, one row for every attempt at a job, and what the jobs printed.

    OUT/sweep/plans/GRID.json    from (the working directory), out, own_file (the file of one's own that registers parts
                                 of its jobs, if one does), and the jobs of a grid: name, stage, folder, command, needs;
                                 GRID~*.json those of a grid of one's own, of a part of one, or of one with other
                                 settings
    OUT/sweep/attempts.jsonl     one object a line: job, ended (Unix time), seconds, cause, line, step, host, words (of
                                 its command), sources (files of its parts that are one's own)
    OUT/sweep/logs/JOB.log
    OUT/sweep/slurm/, ray/       what the tasks of a cluster print

Rows are appended whole, so that several drivers may share a folder. Whether a job is finished is never read here: its
own folder says it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shlex
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.core.registry import sources
from vd4rl_pomdp.runs.files import Row, jsonable, write_json
from vd4rl_pomdp.sweeps.own_file import OwnFile, own_file, parts_by_call, program_of, same_file
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.work import Work

FOLDER = "sweep"
RETRIED = "retried"
"""Cause of a row that says: forget this job's failures."""


def plan_name(grid: str, words: Iterable[str]) -> str:
    """What a grid's plan is called, given its file and what narrows or changes it: each such command has its own."""
    told = sorted(words)
    return f"{grid}~{hashlib.blake2b(json.dumps(told).encode(), digest_size=4).hexdigest()}" if told else grid


class SweepFolder:
    """The files of a sweep below its folder."""

    def __init__(self, out: Path) -> None:
        """Nothing is written."""
        self.out = out
        self.path = out / FOLDER
        """Where they lie."""
        self._attempts = self.path / "attempts.jsonl"

    def keep_plan(self, name: str, jobs: Iterable[Job]) -> None:
        """Write the jobs of a plan, in place of what was written of it before; other drivers may do so at once."""
        with disk_errors(self.path):
            (self.path / "plans").mkdir(parents=True, exist_ok=True)
        jobs, here = list(jobs), own_file()
        needed = here if here and any(parts_by_call(jobs)) else {}
        plan = {"from": str(Path.cwd()), "out": str(self.out), "own_file": needed}
        plan |= {"jobs": [jsonable(asdict(job)) for job in jobs]}
        write_json(self.path / "plans" / f"{name}.json", plan, shared=True)

    def jobs(self) -> list[Job]:
        """The jobs of all plans, their folders as seen from here; UserError if there is none."""
        return self._jobs_of(self._plans())

    def _jobs_of(self, plans: list[_Plan]) -> list[Job]:
        jobs = [replace(job, folder=plan.place(job.folder, self.out)) for plan in plans for job in plan.jobs]
        return list({job.name: job for job in jobs}.values())

    def own_jobs(self, name: str = "") -> list[Job]:
        """The jobs of the plans that this process can carry out: of the program itself, or its own file's.

        Those of other files are told of in a warning each.

        Args:
            name: of the plan; empty: all of them.

        Raises:
            UserError: there is none, or the commands of one name other folders here than where it was made.
        """
        plans, here = self._plans(name), own_file()
        own = [plan for plan in plans if not plan.own_file or same_file(plan.own_file, here)]
        others = dict.fromkeys(program_of(plan.own_file) for plan in plans if plan not in own)
        told = [f"`{program} sweep retry {shlex.quote(str(self.out))}`" for program in others]
        if not own:
            raise UserError(f"{self.out}: was planned with parts that this process has not: start {' and '.join(told)}")
        for command in told:
            print(f"warning: {self.out}: jobs with parts of another file are left to {command}", file=sys.stderr)
        self._refuse_elsewhere(own)
        return self._jobs_of(own)

    def jobs_of_others(self, name: str) -> list[Job]:
        """The jobs of all plans but one, as they were written."""
        return [job for path in self._plan_files() if path.stem != name for job in _read_plan(path).jobs]

    def _refuse_elsewhere(self, plans: list[_Plan]) -> None:
        """Raise UserError if the commands of a plan name other folders here than where it was made."""
        for plan in plans:
            if plan.out_there.resolve() != self.out.resolve() or not (plan.absolute or plan.made_in == Path.cwd()):
                raise UserError(
                    f"{self.out}: was planned in {plan.made_in} as {plan.out}: `sweep retry` it there, or plan it "
                    f"anew by `sweep run GRID --out {self.out}`"
                )

    def _plans(self, name: str = "") -> list[_Plan]:
        if not (paths := [path for path in self._plan_files() if name in ("", path.stem)]):
            raise UserError(f"{self.out}: holds no sweep; `vd4rl-pomdp sweep run GRID --out {self.out}` makes one")
        return [_read_plan(path) for path in paths]

    def _plan_files(self) -> list[Path]:
        return sorted((self.path / "plans").glob("*.json"))

    def work(self, job: Job, slots: int) -> Work:
        """A job as an executor takes it."""
        log = self.path / "logs" / f"{job.name}.log"
        return Work(job.name, job.words, log, slots, own_file(), sources(dict(job.settings)))

    def of_executor(self, name: str) -> Path:
        """Folder of what an executor keeps."""
        return self.path / name

    def add(self, row: Row) -> None:
        """Append the row of an attempt."""
        line = (json.dumps(row) + "\n").encode()
        with disk_errors(self._attempts):
            self.path.mkdir(parents=True, exist_ok=True)
            handle = os.open(self._attempts, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                end = os.lseek(handle, 0, os.SEEK_END)
                if end and os.pread(handle, 1, end - 1) != b"\n":  # a full disk cut the row before
                    line = b"\n" + line
                if os.write(handle, line) < len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            finally:
                os.close(handle)

    def attempts_size(self) -> int:
        """Bytes of the attempts' file: another number, further attempts."""
        with suppress(OSError):
            return self._attempts.stat().st_size
        return 0

    def forget(self, job: str) -> None:
        """Have the job taken up as if it had never been tried."""
        self.add({"job": job, "cause": RETRIED})

    def attempts(self) -> dict[str, list[Row]]:
        """By job, its attempts since it was last taken up again; a line that a full disk cut is left out."""
        found: dict[str, list[Row]] = {}
        if self._attempts.exists():
            for line in read_bytes(self._attempts).decode(errors="replace").splitlines():
                row = _row(line)
                if row.get("cause") == RETRIED:
                    found.pop(row["job"], None)
                elif "job" in row:
                    found.setdefault(row["job"], []).append(row)
        return found


def _row(line: str) -> Row:
    try:
        row = parse_json(line)
    except ValueError:
        return {}
    return row if isinstance(row, dict) and {"job", "cause"} <= row.keys() else {}


@dataclass(frozen=True)
class _Plan:
    """A plan that was kept, with paths as they were told."""

    made_in: Path
    """The working directory, which relative paths begin at."""
    out: Path
    jobs: list[Job]
    own_file: OwnFile
    """Empty for a plan of the program itself, and of an earlier version."""

    @property
    def out_there(self) -> Path:
        """The sweep's folder when the plan was made."""
        return self.made_in / self.out

    @property
    def absolute(self) -> bool:
        """Whether its commands mean the same from every working directory."""
        return self.out.is_absolute() and all(job.folder.is_absolute() for job in self.jobs)

    def place(self, folder: Path, out: Path) -> Path:
        """Where a job's folder is if the sweep's is now `out`."""
        return out / folder.relative_to(self.out) if folder.is_relative_to(self.out) else self.made_in / folder


def _read_plan(path: Path) -> _Plan:
    try:
        told = parse_json(read_bytes(path).decode())
        if not isinstance(told, dict) or not told["jobs"]:
            raise TypeError("it does not tell its jobs and where they were planned")
        jobs = [_job(one) for one in told["jobs"]]
        return _Plan(Path(told["from"]), Path(told["out"]), jobs, dict(told.get("own_file", {})))
    except UserError:
        raise
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: is damaged ({error}); remove it and start `sweep run` again") from error


def _job(told: dict[str, Any]) -> Job:
    listed = {name: tuple(told[name]) for name in ("words", "needs")}
    settings = tuple((name, value) for name, value in told["settings"])
    return Job(**(told | listed | {"folder": Path(told["folder"]), "settings": settings}))
