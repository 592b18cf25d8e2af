"""Options of the sweep executors: this machine, Slurm or Ray."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options


@dataclass(frozen=True)
class LocalOptions(Options):
    """Options of the local executor."""

    jobs: int = 0
    """Concurrent jobs on this machine; 0: as many as its GPUs take, or 1 without a GPU."""
    jobs_per_gpu: int = 1
    """Concurrent jobs per GPU."""
    threads: int = 0
    """CPU threads per job; 0: its share of the machine's cores."""
    stack: int = 1
    """Maximum fine-tunings trained together in one process, in the slot of one job. Results match single runs up to
    rounding."""

    limits: ClassVar[Limits] = {"jobs": (0, 1024), "jobs_per_gpu": (1, 64), "threads": (0, 4096), "stack": (1, 64)}


@dataclass(frozen=True)
class SlurmOptions(Options):
    """Options of the Slurm executor; each array task is one sbatch allocation."""

    partition: str | None = None
    """Partition; default: the cluster's."""
    account: str | None = None
    """Account to charge."""
    qos: str | None = None
    """Quality of service."""
    constraint: str | None = None
    """Required node features, e.g. "a100|h100"."""
    time: int = 240
    """Time limit of a task in minutes; unfinished jobs resume in another task."""
    gpus: int = 1
    """GPUs per task."""
    cpus: int = 8
    """CPU cores per task."""
    memory: float | None = None
    """Memory per task in GB; default: the cluster's."""
    jobs_per_task: int = 1
    """Concurrent jobs per task, sharing its GPUs, cores and memory."""
    tasks: int = 100
    """Maximum tasks queued or running at a time."""
    sbatch: list[str] = field(default_factory=list)
    """More sbatch parameters, e.g. reservation=mine exclusive."""
    stack: int = 1
    """Maximum fine-tunings trained together in one process, in the slot of one job."""

    limits: ClassVar[Limits] = {
        **{"time": (5, 60 * 24 * 365), "gpus": (0, 64), "cpus": (1, 4096), "memory": (0.01, 10**6)},
        **{"jobs_per_task": (1, 1024), "tasks": (1, 1000), "stack": (1, 64)},
    }


@dataclass(frozen=True)
class RayOptions(Options):
    """Options of the Ray executor."""

    address: str = "auto"
    """Cluster address: HOST:PORT, or auto for RAY_ADDRESS or the cluster on this machine."""
    cpus: float = 1.0
    """CPU cores per job."""
    gpus: float = 1.0
    """GPUs per job; 0.25 lets four jobs share one."""
    jobs: int = 0
    """Concurrent jobs; 0: as many as the current nodes fit. Set it explicitly for an autoscaling cluster."""
    stack: int = 1
    """Maximum fine-tunings trained together in one process, in the slot of one job."""

    limits: ClassVar[Limits] = {"cpus": (0.01, 4096), "gpus": (0, 64), "jobs": (0, 10**5), "stack": (1, 64)}

    def check(self) -> None:
        """Raise UserError for fractional GPU counts above 1, which Ray does not support."""
        super().check()
        if self.gpus > 1 and self.gpus % 1:
            raise UserError(f"--gpus is {self.gpus}; above 1 it must be a whole number")


EXECUTORS: dict[str, type[Options]] = {"local": LocalOptions, "slurm": SlurmOptions, "ray": RayOptions}
"""Options classes by executor name."""
