"""Tasks of a sweep as arrays of Slurm, submitted by submitit; the queue knows them by a name that the folder gives."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_errors
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.work import PATIENCE_S, ClusterTask

ANSWER_S, LAST_ANSWER_S = 30.0, 10.0
"""Seconds that a command of Slurm's has, and what it has once a signal has asked for the end."""
SPARE_S = 15.0
"""Seconds that the end of a task takes beside that of its jobs."""
POLL_S = 1.0
_USUAL = ("None", "Priority", "Resources", "BeginTime", "Cleaning", "JobArrayTaskLimit")
"""What a task waits for that comes by itself."""


@dataclass(frozen=True)
class SlurmOptions(Options):
    """Options of the Slurm executor; an array task is one allocation of sbatch."""

    partition: str | None = None
    """Partition of the tasks; default: the cluster's."""
    account: str | None = None
    """Account that pays."""
    qos: str | None = None
    """Quality of service."""
    constraint: str | None = None
    """Features that the nodes must have: "a100|h100"."""
    time: int = 240
    """Time limit of a task, minutes; jobs that it cuts resume in another task."""
    gpus: int = 1
    """GPUs of a task."""
    cpus: int = 8
    """CPU cores of a task."""
    memory: float | None = None
    """Memory of a task, GB; default: the cluster's."""
    jobs_per_task: int = 1
    """Jobs at a time in a task, which share its GPUs, cores and memory."""
    tasks: int = 100
    """Tasks in the queue or running at a time."""
    sbatch: list[str] = field(default_factory=list)
    """Further parameters of sbatch: reservation=mine exclusive."""

    limits: ClassVar[Limits] = {
        **{"time": (5, 60 * 24 * 365), "gpus": (0, 64), "cpus": (1, 4096), "memory": (0.01, 10**6)},
        **{"jobs_per_task": (1, 1024), "tasks": (1, 1000)},
    }


@dataclass(frozen=True)
class Allocation:
    """What submitit runs in an array task."""

    task: ClusterTask

    def __call__(self) -> None:
        """Do the task; SIGTERM, and the signal that Slurm sends before the time limit, end it in peace."""
        asked: list[int] = []
        for number in (signal.SIGTERM, signal.SIGUSR2):
            signal.signal(number, lambda number, frame: asked.append(number))
        print(self.task.run(asked))


class SlurmCluster:
    """A sweep's tasks in Slurm's queue."""

    threads = 0

    def __init__(self, options: SlurmOptions, folder: Path) -> None:
        """Asks Slurm for nothing yet.

        Args:
            options: what a task gets.
            folder: for what submitit and the tasks write, on a disk that all nodes share.

        Raises:
            UserError: submitit or Slurm's commands are missing.
        """
        _require_slurm()
        self._options, self.folder = options, folder
        self.tasks, self.jobs_per_task = options.tasks, options.jobs_per_task
        digest = hashlib.blake2b(str(folder.resolve()).encode(), digest_size=4).hexdigest()
        self._own = ("--me", f"--name=vd4rl-pomdp-{digest}")
        self._reasons: set[str] = set()

    def live(self) -> int:
        """How many tasks of this sweep wait or run; UnavailableError if Slurm does not answer."""
        told = _ask("squeue", *self._own, "--array", "--noheader", "--format=%T|%r")
        rows = [line.partition("|") for line in told.splitlines() if line.strip()]
        for state, _, reason in rows:
            if state == "PENDING" and reason not in (*_USUAL, *self._reasons):
                self._reasons.add(reason)
                print(f"warning: Slurm keeps tasks waiting: {reason}", file=sys.stderr)
        return len(rows)

    def submit(self, task: ClusterTask, number: int) -> None:
        """Submit one array.

        Raises:
            UnavailableError: its files could not be written, or sbatch does not answer, and Slurm may have taken the
                array or not.
            UserError: Slurm did not take it.
        """
        import submitit

        executor = submitit.AutoExecutor(self.folder, cluster="slurm")
        executor.update_parameters(name=self._own[1].partition("=")[2], **parameters(self._options))
        try:
            with disk_errors(self.folder), _alarm():
                executor.submit_array([Allocation(task)] * number)
        except RuntimeError as error:  # submitit's for a command that failed
            if isinstance(error.__cause__, UnavailableError):
                raise error.__cause__ from None
            told = str(error).strip().splitlines()
            raise UserError(f"Slurm took no array ({told[-1] if told else 'it does not say why'})") from error

    def stop(self) -> None:
        """Take what waits out of the queue, ask every task to end where nothing is lost, and wait for it."""
        try:
            _ask("scancel", "--quiet", *self._own, "--state=PENDING")
            _ask("scancel", "--quiet", *self._own, "--signal=TERM")
            until = time.monotonic() + PATIENCE_S + SPARE_S
            while self.live() and time.monotonic() < until:
                time.sleep(POLL_S)
            _ask("scancel", "--quiet", *self._own)
        except UnavailableError as error:
            print(f"warning: {error}; tasks may be left: scancel {' '.join(self._own)}", file=sys.stderr)


def _require_slurm() -> None:
    """Raise UserError unless submitit and Slurm's commands are here."""
    try:
        import submitit  # noqa: F401
    except ImportError as error:
        raise UserError("--executor slurm needs submitit: pip install '.[slurm]' in a clone of vd4rl-pomdp") from error
    for name in ("sbatch", "squeue", "scancel", "srun"):
        if shutil.which(name) is None:
            raise UserError(f"--executor slurm finds no {name} here: start the sweep where Slurm's commands are")


def parameters(options: SlurmOptions) -> dict[str, Any]:
    """What submitit is told of a task."""
    names = ("partition", "account", "qos", "constraint", "time")
    found = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.gpus:
        found["gpus_per_node"] = options.gpus
    if options.memory is not None:
        found["mem"] = f"{options.memory * 1024:.0f}M"
    further = [parameter.removeprefix("--").partition("=") for parameter in options.sbatch]
    found |= {
        "cpus_per_task": options.cpus,
        "srun_args": [f"--cpus-per-task={options.cpus}"],  # which some versions do not take from sbatch
        "array_parallelism": options.tasks,
        "signal_delay_s": round(PATIENCE_S + SPARE_S),
        "additional_parameters": {"requeue": True} | {name: value or True for name, _, value in further},
    }
    return {f"slurm_{name}": value for name, value in found.items()} | {"stderr_to_stdout": True}


def _ask(*command: str) -> str:
    """What a command of Slurm's prints; UnavailableError if it does not end in time, or fails."""
    seconds = LAST_ANSWER_S if interrupt.asked() else ANSWER_S
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds)
    except subprocess.TimeoutExpired as error:
        raise UnavailableError(f"Slurm does not answer: {command[0]} has not ended after {seconds:g} s") from error
    if answer.returncode and command[0] == "squeue":  # scancel fails where there is nothing to cancel
        raise UnavailableError(f"Slurm does not answer: see what squeue says ({answer.stderr.strip()})")
    return answer.stdout


@contextmanager
def _alarm() -> Iterator[None]:
    """Raise UnavailableError within the block when sbatch has had its time; submitit, which waits for it, kills it."""
    if threading.current_thread() is not threading.main_thread():  # which alone gets signals
        yield
        return

    def over(*_: object) -> None:
        raise UnavailableError(f"Slurm does not answer: sbatch has not ended after {ANSWER_S:g} s")

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, ANSWER_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
