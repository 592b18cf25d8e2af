"""What is asked of Slurm: arrays of allocations, the state of what is in the queue, and to end it."""

from __future__ import annotations

import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_errors
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.executors.allocation import Allocation
from vd4rl_pomdp.sweeps.executors.local import PATIENCE_S

PREFIX = "vd4rl-pomdp-"
"""What the names of all sweeps' arrays begin with."""
QUEUE_S = 15.0
"""Seconds between two looks at the queue."""
ANSWER_S, LAST_ANSWER_S = 30.0, 10.0
"""Seconds that a command of Slurm's has, and what it has once a signal has asked for the end."""
REQUEUES = 100
"""How often a task goes on after its time limit before its driver is asked."""


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
    """Time limit of a task, minutes; jobs that it cuts go on in the same task, started again."""
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


class TaskState(NamedTuple):
    """What the queue says of a task."""

    name: str
    """Slurm's word."""
    job: str
    """Its number, with the task's for one of an array."""
    reason: str = ""
    """What it waits for."""


Queue = dict[tuple[str, int], TaskState]
"""By array and number of the task."""


def require_slurm() -> None:
    """Raise UserError unless submitit and Slurm's commands are here."""
    try:
        import submitit  # noqa: F401
    except ImportError as error:
        raise UserError("--executor slurm needs submitit: pip install '.[slurm]' in a clone of vd4rl-pomdp") from error
    for name in ("sbatch", "squeue", "scancel", "srun"):
        if shutil.which(name) is None:
            raise UserError(f"--executor slurm finds no {name} here: start the sweep where Slurm's commands are")


def read_queue() -> Queue | None:
    """This user's arrays of sweeps in the queue, those that ended of late included; None if Slurm does not answer."""
    command = ["squeue", "--me", "--array", "--states=all", "--noheader", "--format=%j|%K|%T|%i|%r"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_deadline())
    except subprocess.TimeoutExpired:
        return None
    if answer.returncode:
        return None
    rows = [line.split("|") for line in answer.stdout.splitlines() if line.startswith(PREFIX)]
    return {(name, int(number) if number.isdigit() else 0): TaskState(*state) for name, number, *state in rows}


def _deadline() -> float:
    return LAST_ANSWER_S if interrupt.asked() else ANSWER_S


def submit(folder: Path, tasks: list[Allocation], options: SlurmOptions) -> None:
    """Submit tasks as one array, called as its folder is.

    Raises:
        UnavailableError: its files could not be written, the machine starts no process now, or sbatch does not answer,
            and Slurm may have taken the array or not.
        UserError: Slurm did not take it.
    """
    import submitit

    executor = submitit.SlurmExecutor(folder, max_num_timeout=REQUEUES)
    executor.update_parameters(job_name=folder.name, **parameters(options))
    try:
        with disk_errors(folder), _alarm():
            executor.submit_array(tasks)
    except RuntimeError as error:  # submitit's for a command that failed
        if isinstance(error.__cause__, UnavailableError):
            raise error.__cause__ from None
        told = str(error).strip().splitlines()
        raise UserError(f"Slurm took no array ({told[-1] if told else 'it does not say why'})") from error


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


def parameters(options: SlurmOptions) -> dict[str, Any]:
    """What submitit is told of an allocation."""
    names = ("partition", "account", "qos", "constraint", "time")
    found = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.gpus:
        found["gpus_per_node"] = options.gpus
    if options.memory is not None:
        found["mem"] = f"{options.memory * 1024:.0f}M"
    further = [parameter.removeprefix("--").partition("=") for parameter in options.sbatch]
    return found | {
        "cpus_per_task": options.cpus,
        "srun_args": [f"--cpus-per-task={options.cpus}"],  # which some versions do not take from sbatch
        "array_parallelism": options.tasks,
        "signal_delay_s": round(PATIENCE_S + QUEUE_S),
        "stderr_to_stdout": True,
        "additional_parameters": {"requeue": True} | {name: value or True for name, _, value in further},
    }


def cancel(jobs: list[str], *how: str) -> None:
    """Have scancel, with the options `how`, end tasks by their numbers; none is nothing.

    Raises:
        UnavailableError: it does not end in time.
    """
    if jobs:
        try:
            command = ["scancel", "--quiet", *how, *jobs]
            subprocess.run(command, capture_output=True, check=False, timeout=_deadline())
        except subprocess.TimeoutExpired as error:
            raise UnavailableError(f"Slurm does not answer: scancel has not ended after {error.timeout:g} s") from error
