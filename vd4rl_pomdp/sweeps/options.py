"""Options of the sweep executors (this machine, Slurm, Ray), and the program that starts the jobs."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.registry import BY_CALL, REGISTRIES, code_of

JOB_VARIABLE = "VD4RL_POMDP_JOB"
"""Set in the environment of a job's process: a second signal does not kill it early, and it may not start a sweep."""


@dataclass(frozen=True)
class LocalOptions(Options):
    """Options of the local executor."""

    jobs: int = 0
    """Concurrent jobs on this machine; 0: as many as its GPUs take, or 1 without a GPU."""
    jobs_per_gpu: int = 1
    """Concurrent jobs per GPU."""
    threads: int = 0
    """CPU threads per job; 0: OMP_NUM_THREADS if it is set, else its share of the machine's cores."""
    stack: int = 1
    """Maximum fine-tunings trained together in one process, in the slot of one job.
    Results match single runs (on a GPU up to rounding). On a CPU they are updated one after another."""

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

    def check(self) -> None:
        """Raise UserError for GPUs that no job would use."""
        super().check()
        if self.gpus > self.jobs_per_task:
            raise UserError(
                f"--gpus {self.gpus} is more than --jobs-per-task {self.jobs_per_task}, and a job uses one GPU: raise "
                "--jobs-per-task or lower --gpus"
            )


@dataclass(frozen=True)
class RayOptions(Options):
    """Options of the Ray executor."""

    address: str = "auto"
    """Cluster address: HOST:PORT, or auto for RAY_ADDRESS or the cluster on this machine."""
    cpus: float = 1.0
    """CPU cores per job."""
    gpus: float = 1.0
    """GPUs per job, at most 1; 0.25 lets four jobs share one."""
    jobs: int = 0
    """Concurrent jobs; 0: as many as the current nodes fit. Set it explicitly for an autoscaling cluster."""
    stack: int = 1
    """Maximum fine-tunings trained together in one process, in the slot of one job."""

    limits: ClassVar[Limits] = {"cpus": (0.01, 4096), "gpus": (0, 1), "jobs": (0, 10**5), "stack": (1, 64)}


EXECUTORS: dict[str, type[Options]] = {"local": LocalOptions, "slurm": SlurmOptions, "ray": RayOptions}
"""Options classes by executor name."""


def own_program() -> list[str]:
    """Arguments of `python` that started this process, if a user's file registered plug-ins; else empty."""
    main = sys.modules["__main__"]
    if not any(registry.has_added for registry in REGISTRIES.values()):
        return []
    if (spec := getattr(main, "__spec__", None)) is not None:
        return ["-m", spec.name.removesuffix(".__main__")]
    return [sys.argv[0]] if getattr(main, "__file__", None) else []


def program_name(program: list[str] | None = None) -> str:
    """The command to type instead of `vd4rl-pomdp`, e.g. "python my_method.py"; default: that of this process."""
    program = own_program() if program is None else program
    return shlex.join(["python", *program]) if program else "vd4rl-pomdp"


def refuse_unknown_to_jobs(settings: Mapping[str, str]) -> None:
    """Raise UserError if settings name a plug-in that a job's process could not import."""
    if not own_program():
        for part, origin in code_of(settings)["plugins"].items():
            if origin == BY_CALL:
                raise UserError(
                    f"{part}: is registered only in this process, but each job is a process of its own: register it in "
                    "a file that ends in `main()`, and start the sweep with `python FILE sweep run`"
                )
