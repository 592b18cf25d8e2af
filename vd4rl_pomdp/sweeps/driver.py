"""Runs a sweep's plans on this machine: starts jobs, retries transient failures, and keeps going when a job fails.

Whether a job is done is read from its own folder. So a driver can be killed at any time, several can share one sweep
folder, and a new one resumes the rest. One process can train several policies as a stack (`vd4rl-pomdp finetune WORDS +
WORDS`); each remains a separate job with its own folder, command, attempts and result.
"""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from vd4rl_pomdp.core.errors import TEMPORARY, UnavailableError, UserError, disk_errors
from vd4rl_pomdp.nn.encoder_folder import read_record
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.outputs import in_use
from vd4rl_pomdp.sweeps.folder import (
    DONE,
    FAILED,
    INTERRUPTED,
    KILLED,
    PASSING,
    UNAVAILABLE,
    Plan,
    SweepFolder,
    is_finished,
    jobs_of,
    lost_among,
)
from vd4rl_pomdp.sweeps.options import JOB_VARIABLE, LocalOptions
from vd4rl_pomdp.sweeps.plan import Job

POLL_S = 0.5
PAUSE_S = 60.0  # seconds to wait before a retry, whichever driver made the last attempt
IN_USE_S = 10.0  # seconds before checking again on a job that another driver is running
IDLE_S = 90.0  # seconds after which a helping driver with nothing to start exits
PATIENCE_S = 120.0
"""Seconds between SIGTERM and SIGKILL, in which a job finishes its step and writes a checkpoint."""
_ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Place:
    """Cores and GPU of one job."""

    cores: tuple[int, ...]
    gpu: str | None  # value for CUDA_VISIBLE_DEVICES
    pinned: bool = True
    """Whether the job is bound to its cores; else they only count."""


@dataclass(frozen=True)
class _Running:
    jobs: list[Job]  # more than one: a stack
    places: list[Place]
    process: subprocess.Popen
    began: float
    log: Path
    log_size: int  # size of the log in bytes before this attempt


class Driver:
    """One process that works on a sweep, possibly alongside others."""

    def __init__(self, plans: Iterable[Plan], options: LocalOptions, folder: SweepFolder, helps: bool = False) -> None:
        """Run the jobs of `plans`; if it only `helps`, it exits after IDLE_S without work."""
        self._plans = {job.name: plan for plan in plans for job in plan.jobs}
        self._jobs = {job.name: job for job in jobs_of(plans)}
        self._left = {name: job for name, job in self._jobs.items() if not is_finished(job)}
        self._free, self._threads, self._stack = places(options), options.threads, options.stack
        self._folder, self._helps = folder, helps
        self._running: list[_Running] = []
        self._not_before: dict[str, float] = {}
        """Earliest time to look at a job again that another driver runs or that just failed."""
        self._busy = time.monotonic()  # time at which something last ran
        self._ends = False
        """Whether it terminates its jobs."""
        self._unwritten: list[Row] = []
        """Rows of attempts that a full disk did not take yet."""
        self._widths: dict[str, int | None] = {}
        """Feature width by fine-tuning job, known once its encoder exists."""

    def run(self) -> bool:
        """Run jobs until none can run any more. Return whether all are finished."""
        try:
            while self._start_ready():
                time.sleep(POLL_S)
                self._collect()
                interrupt.check("the sweep's jobs have ended")
        except BaseException:
            # Terminate all jobs at once, so that they share the grace period for their checkpoints.
            self._ends = True
            for one in self._running:
                one.process.terminate()
            until = time.monotonic() + PATIENCE_S
            for one in self._running:
                try:
                    one.process.wait(max(0.0, until - time.monotonic()))
                except subprocess.TimeoutExpired:
                    one.process.kill()
                    one.process.wait()
            self._collect()
            raise
        return all(map(is_finished, self._left.values()))  # other drivers may have finished jobs that failed here

    def _start_ready(self) -> bool:
        """Start all jobs that can start. Return whether there is anything left to wait for."""
        attempts = self._folder.attempts(self._jobs.values())  # includes other drivers' attempts
        for row in self._unwritten:
            attempts[row["job"]].append(row)
        lost = lost_among(self._left.values(), attempts)
        running = {job.name for one in self._running for job in one.jobs}
        ready = []
        for job in self._left.values():
            pauses = self._not_before.get(job.name, 0) > time.monotonic()
            for last in attempts[job.name][-1:]:
                pauses |= last["cause"] in PASSING and time.time() < last["ended"] + PAUSE_S
            if not pauses and job.name not in lost | running and self._left.keys().isdisjoint(job.needs):
                ready.append(job)
        processes = self._in_processes(ready, attempts, lost, running) if self._free else []
        for number, jobs in enumerate(processes, 1):
            # Checked only now: while we started the previous ones, another driver may have begun these.
            if self._free and (mine := [job for job in jobs if not self._is_anothers(job)]):
                with interrupt.deferred():  # a process that is not listed yet would not be terminated
                    self._begin(mine, spare=len(self._free) - 1 - len(processes[number:]))
        if self._running:
            self._busy = time.monotonic()
        idle = self._helps and time.monotonic() - self._busy > IDLE_S
        return len(self._left) > len(lost) and not idle

    def _in_processes(
        self, ready: list[Job], attempts: Mapping[str, list[Row]], lost: set[str], running: set[str]
    ) -> list[list[Job]]:
        """Ready jobs grouped by process, in starting order. A stack that will soon grow is held back."""

        def alike(job: Job) -> Hashable:
            if self._stack == 1 or not (kind := kind_of(job)):
                return None
            plan = self._plans[job.name]
            if job.name not in self._widths:
                self._widths[job.name] = width_of(job, plan.made_in)
            return plan.made_in, tuple(plan.program), self._widths[job.name], kind

        def small(jobs: list[Job]) -> bool:
            return bool(len(jobs) < self._stack and kind_of(jobs[0]) and not runs_alone(attempts[jobs[0].name]))

        # Hold back only for jobs that become ready as soon as a running or starting job ends, or a slot would idle too
        # long.
        coming = running | {job.name for job in ready}
        waiting = [(job, self._left.keys() & job.needs) for job in self._left.values() if job.name not in lost]
        soon = {kind_of(job) for job, needs in waiting if needs and needs <= coming}
        found = in_stacks(ready, self._stack, attempts, alike)
        if self._helps:
            random.shuffle(found)  # or all drivers would race for the same job
        return sorted((jobs for jobs in found if not (small(jobs) and kind_of(jobs[0]) in soon)), key=small)

    def _is_anothers(self, job: Job) -> bool:
        """Whether another driver runs or has finished this job. In this order of checks, it cannot end in between."""
        if in_use(job.folder):
            self._not_before[job.name] = time.monotonic() + IN_USE_S
        elif is_finished(job):
            del self._left[job.name]
        else:
            return False
        return True

    def _log(self, job: Job) -> Path:
        return self._folder.path / "logs" / f"{job.name}.log"

    def _begin(self, jobs: list[Job], spare: int) -> None:
        """Start a process for some jobs. A stack takes one place per job, if spare, for its parallel evaluations."""
        log = self._log(jobs[0])
        ((gpu, _),) = Counter(place.gpu for place in self._free).most_common(1)  # the least busy one
        taken = [place for place in self._free if place.gpu == gpu][: max(1, min(len(jobs), 1 + spare))]
        place = replace(taken[0], cores=tuple(sorted({core for one in taken for core in one.cores})))
        try:
            with disk_errors(log):
                for path in map(self._log, jobs):
                    path.parent.mkdir(parents=True, exist_ok=True)
                    if path != log:
                        with path.open("a", encoding="utf-8") as file:
                            print(f"in one process with {jobs[0].name}: see {log}", file=file)
                size = log.stat().st_size if log.exists() else 0
                process = start(words_of_stack(jobs), self._plans[jobs[0].name], log, place, self._threads)
        except UserError as error:
            self._end(jobs, UNAVAILABLE, 0.0, str(error))
            return
        self._free = [place for place in self._free if not any(place is one for one in taken)]
        self._running.append(_Running(jobs, taken, process, time.monotonic(), log, size))

    def _collect(self) -> None:
        for one in [one for one in self._running if one.process.poll() is not None]:
            self._running.remove(one)
            self._free += one.places
            code = one.process.returncode  # negative: killed by a signal
            if code in (-signal.SIGINT, -signal.SIGTERM, 128 + signal.SIGINT, 128 + signal.SIGTERM):
                cause = INTERRUPTED if self._ends else KILLED  # by others, who may do so again at once
            else:
                cause = KILLED if code < 0 else {0: DONE, TEMPORARY: UNAVAILABLE}.get(code, FAILED)
            line = "" if cause == DONE else _line_of_end(one.log, one.log_size)
            self._end(one.jobs, cause, time.monotonic() - one.began, line)

    def _end(self, jobs: list[Job], cause: str, seconds: float, line: str) -> None:
        shared: Row = {"ended": round(time.time(), 1), "seconds": round(seconds, 1), "host": socket.gethostname()}
        shared |= {"log": str(self._log(jobs[0]).relative_to(self._folder.out))}
        shared |= {"stack": len(jobs)} if len(jobs) > 1 else {}
        unfinished = [job for job in jobs if not is_finished(job)]
        if cause == FAILED and any(in_use(job.folder) for job in unfinished):  # lost a race: no attempt
            self._not_before |= {job.name: time.monotonic() + IN_USE_S for job in unfinished}
            jobs = [job for job in jobs if job not in unfinished]
        for job in jobs:
            if job not in unfinished:
                self._left.pop(job.name, None)
                how, why = DONE, ""  # however the process ended
            elif cause == DONE:
                how, why = FAILED, f"{job.folder}: holds nothing finished, though the command ended well"
            else:
                how, why = cause, line
            if how in PASSING:
                self._not_before[job.name] = time.monotonic() + PAUSE_S
            row: Row = {"job": job.name, "cause": how, "line": why, "words": job.words} | shared
            self._unwritten.append(row)
            try:
                while self._unwritten:
                    self._folder.add(self._unwritten[0])
                    del self._unwritten[0]
            except UnavailableError as error:
                note(f"warning: {error}")
            say(row, len(self._jobs) - len(self._left), len(self._jobs))


def start(words: list[str], plan: Plan, log: Path, place: Place, threads: int) -> subprocess.Popen:
    """Start the process `vd4rl-pomdp WORDS` in the plan's working directory, its output appended to `log`.

    `threads` are its CPU threads; 0: those of OMP_NUM_THREADS, else one per core of its `place`.
    """
    # One command line per process: anyone can repeat it by hand, a crash or OOM kill takes down nothing else, and the
    # system manages cores, GPU and signals. The exit code is all that the driver learns.
    imports = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
    own = {JOB_VARIABLE: "1", "PYTHONPATH": imports}
    if threads or not os.environ.get("OMP_NUM_THREADS"):
        own["OMP_NUM_THREADS"] = str(threads or max(1, len(place.cores)))
    own |= {} if place.gpu is None else {"CUDA_VISIBLE_DEVICES": place.gpu}
    program = plan.program or ["-P", "-m", "vd4rl_pomdp"]  # -P: do not import from the working directory
    mine = os.sched_getaffinity(0) if place.pinned else set()
    # A child inherits affinity and blocked signals. Slurm sends its time-limit warning to every process; only the task
    # itself should react, and then terminate its jobs.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2})
    try:
        if place.pinned:
            os.sched_setaffinity(0, place.cores)
        with log.open("ab") as file:
            return subprocess.Popen(
                [sys.executable, *program, *words],
                env=os.environ | own,
                cwd=plan.made_in,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,  # the driver handles Ctrl-C
            )
    finally:
        if place.pinned:
            os.sched_setaffinity(0, mine)
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _line_of_end(log: Path, start: int) -> str:
    """Why a job ended, from its log after byte `start`: the last line, or the exception line of a traceback."""
    try:
        text = log.read_bytes()[start:].decode(errors="replace")
    except OSError:
        return ""
    lines = [line for line in text.splitlines() if line.strip()]
    last = lines[-1].strip() if lines else ""
    _, traceback, rest = "\n".join(lines).rpartition("Traceback (most recent call last):\n")
    if not traceback or last.startswith("error: "):
        return last
    return next((line for line in rest.splitlines() if not line[0].isspace()), last)  # the message may have more lines


def say(row: Row, done: int, of: int) -> None:
    """Print the result of an attempt."""
    line = f"[{done}/{of}] {row['cause']:<11} {row['seconds']:6.0f} s  {row['job']}"
    note(line + (f": {row['line']}" if row["line"] else ""))


def note(line: str) -> None:
    """Print a line to stderr. A full disk under the driver's own log must not end the sweep."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


def places(options: LocalOptions) -> list[Place]:
    """Split the machine's cores and GPUs among the concurrent jobs."""
    gpus = visible_gpus()
    jobs = options.jobs or max(1, len(gpus) * options.jobs_per_gpu)
    if gpus and jobs > len(gpus) * options.jobs_per_gpu:
        raise UserError(
            f"--jobs {jobs} is more than {len(gpus)} GPUs take with --jobs-per-gpu {options.jobs_per_gpu}: "
            "raise that, or set CUDA_VISIBLE_DEVICES to nothing to run on the CPU"
        )
    binds = hasattr(os, "sched_getaffinity")  # not on macOS
    cores = sorted(os.sched_getaffinity(0)) if binds else list(range(os.cpu_count() or 1))
    granted = int(os.environ.get("SLURM_CPUS_PER_TASK", len(cores)))
    pinned = binds and granted >= len(cores)  # else Slurm binds no cores, and other tasks would get the same ones
    cores = cores[:granted]
    found = []
    for number in range(jobs):
        first, end = (place * len(cores) // jobs for place in (number, number + 1))
        share = tuple(cores[first : max(end, first + 1)])  # at least one
        found.append(Place(share, gpus[number % len(gpus)] if gpus else None, pinned))
    return found


def visible_gpus() -> list[str]:
    """GPUs that this process may use, as named in CUDA_VISIBLE_DEVICES."""
    count = torch.cuda.device_count()  # does not initialise CUDA
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    return shown.split(",")[:count] if shown else [str(number) for number in range(count)]


_OWN = ("--seed", "--view-seed", "--encoder", "--data", "--out")
"""Flags that may differ between the runs of a stack."""
STACKED = "finetune"


def kind_of(job: Job) -> tuple[str, ...]:
    """Grouping key of jobs that may share a stack, before their encoders exist; () for jobs that cannot be stacked."""
    if job.section != STACKED or job.settings.get("views") == "0":  # reads pixels, an encoder per run
        return ()
    words = list(job.words)
    for flag in _OWN:
        if flag in words:
            del words[words.index(flag) : words.index(flag) + 2]
    return *words, *(job.settings.get(name, "") for name in ("task", "algorithm"))  # these two come from the encoder


def width_of(job: Job, made_in: Path) -> int | None:
    """Width of the encoder features that a fine-tuning reads; None if its encoder cannot be read.

    Paths in its command are relative to `made_in`.
    """
    try:
        encoder = read_record(made_in / job.words[job.words.index("--encoder") + 1]).encoder
    except (ValueError, UserError):
        return None
    own = {"readout": job.settings["readout"]} if "readout" in job.settings else {}
    return replace(encoder, **own).dim  # type: ignore[arg-type]


def runs_alone(rows: Iterable[Row]) -> bool:
    """Whether a job must run alone from now on, because a stack with it failed or was killed."""
    return any("stack" in row and row["cause"] in (FAILED, KILLED) for row in rows)


def in_stacks(
    jobs: Iterable[Job], size: int, attempts: Mapping[str, list[Row]], alike: Callable[[Job], Hashable] = kind_of
) -> list[list[Job]]:
    """Group jobs by process, in order: stacks of up to `size` with equal keys, and single jobs, whose key is falsy."""
    found = groups(jobs, lambda job: job.name if runs_alone(attempts.get(job.name, ())) else alike(job) or job.name)
    return [group[first : first + size] for group in found.values() for first in range(0, len(group), size)]


def words_of_stack(jobs: list[Job]) -> list[str]:
    """The command that runs some jobs in one process, after `vd4rl-pomdp`: the jobs' words joined by "+"."""
    return [*jobs[0].words, *(word for job in jobs[1:] for word in ("+", *job.words[1:]))]
