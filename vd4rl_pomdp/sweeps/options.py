"""What the executors of a sweep can be told: this machine, Slurm or Ray."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options


@dataclass(frozen=True)
class LocalOptions(Options):
    """Options of the local executor."""

    jobs: int = 0
    """Jobs at a time on this machine; 0: as many as its GPUs take, or one without a GPU."""
    jobs_per_gpu: int = 1
    """Jobs at a time on each GPU."""
    threads: int = 0
    """CPU threads of a job; 0: its share of the machine's cores."""
    stack: int = 1
    """Most fine-tunings that one process trains as a stack, in the place of one job; their results are those of single
    runs within rounding."""

    limits: ClassVar[Limits] = {"jobs": (0, 1024), "jobs_per_gpu": (1, 64), "threads": (0, 4096), "stack": (1, 64)}


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
    stack: int = 1
    """Most fine-tunings that one process trains as a stack, in the place of one job."""

    limits: ClassVar[Limits] = {
        **{"time": (5, 60 * 24 * 365), "gpus": (0, 64), "cpus": (1, 4096), "memory": (0.01, 10**6)},
        **{"jobs_per_task": (1, 1024), "tasks": (1, 1000), "stack": (1, 64)},
    }


@dataclass(frozen=True)
class RayOptions(Options):
    """Options of the Ray executor."""

    address: str = "auto"
    """Where the cluster is: HOST:PORT, or auto for RAY_ADDRESS or the one on this machine."""
    cpus: float = 1.0
    """CPU cores of a job."""
    gpus: float = 1.0
    """GPUs of a job: 0.25 lets four share one."""
    jobs: int = 0
    """Jobs at a time; 0: as many as the nodes take that are there. On a cluster that grows when asked, say how many."""
    stack: int = 1
    """Most fine-tunings that one process trains as a stack, in the place of one job."""

    limits: ClassVar[Limits] = {"cpus": (0.01, 4096), "gpus": (0, 64), "jobs": (0, 10**5), "stack": (1, 64)}

    def check(self) -> None:
        """Refuse a share of several GPUs, which Ray does not give."""
        super().check()
        if self.gpus > 1 and self.gpus % 1:
            raise UserError(f"--gpus is {self.gpus}; above 1 it must be a whole number")


EXECUTORS: dict[str, type[Options]] = {"local": LocalOptions, "slurm": SlurmOptions, "ray": RayOptions}
"""Options by name."""
