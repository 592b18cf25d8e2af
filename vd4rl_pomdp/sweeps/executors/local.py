"""Jobs as processes of this machine: a place each, with cores of its own and, where there are GPUs, a share of one."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections import Counter
from dataclasses import dataclass
from typing import ClassVar

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.sweeps.work import PATIENCE_S, Ended, Work, ended, start_process, wait_or_kill


@dataclass(frozen=True)
class LocalOptions(Options):
    """Options of the local executor."""

    jobs: int = 0
    """Jobs at a time on this machine; 0: as many as its GPUs take, or one without a GPU."""
    jobs_per_gpu: int = 1
    """Jobs at a time on each GPU."""
    threads: int = 0
    """CPU threads of a job; 0: its share of the machine's cores."""

    limits: ClassVar[Limits] = {"jobs": (0, 1024), "jobs_per_gpu": (1, 64), "threads": (0, 4096)}


@dataclass(frozen=True)
class Place:
    """Room for one job."""

    cores: tuple[int, ...]
    gpu: str | None
    """What CUDA_VISIBLE_DEVICES is to be."""


@dataclass
class _Running:
    work: Work
    places: list[Place]
    process: subprocess.Popen


class LocalExecutor:
    """A pool of processes."""

    def __init__(self, options: LocalOptions) -> None:
        """See the class."""
        self._free, self._threads = _places(options), options.threads
        self.slots = len(self._free)
        self.largest = max(Counter(place.gpu for place in self._free).values())
        self._running: list[_Running] = []

    def fits(self, slots: int) -> bool:
        """Whether so many slots wait for a job."""
        return bool(self._choose(slots))

    def _choose(self, slots: int) -> list[Place]:
        """Free places of one GPU, or of the machine where there is none."""
        for gpu in dict.fromkeys(place.gpu for place in self._free):
            alike = [place for place in self._free if place.gpu == gpu]
            if len(alike) >= slots:
                return alike[:slots]
        return []

    def start(self, work: Work) -> None:
        """Begin a job that fits."""
        chosen = self._choose(work.slots)
        cores = sorted({core for place in chosen for core in place.cores})
        environment = {"OMP_NUM_THREADS": str(self._threads or max(1, len(cores)))}
        if chosen[0].gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = chosen[0].gpu
        process = start_process(work, environment, cores)
        for place in chosen:
            self._free.remove(place)
        self._running.append(_Running(work, chosen, process))

    def ended(self) -> list[Ended]:
        """What has ended since the last call."""
        over = [job for job in self._running if job.process.poll() is not None]
        for job in over:
            self._running.remove(job)
            self._free += job.places
        return [ended(job.work, job.process.returncode) for job in over]

    def stop(self) -> None:
        """Ask every job to end where nothing is lost, and wait for it."""
        for job in self._running:
            job.process.send_signal(signal.SIGTERM)
        until = time.monotonic() + PATIENCE_S
        for job in self._running:
            wait_or_kill(job.process, until - time.monotonic())


def _places(options: LocalOptions) -> list[Place]:
    """The machine's cores and GPUs, shared out among the jobs."""
    gpus = visible_gpus()
    jobs = options.jobs or max(1, len(gpus) * options.jobs_per_gpu)
    if gpus and jobs > len(gpus) * options.jobs_per_gpu:
        raise UserError(
            f"--jobs {jobs} is more than {len(gpus)} GPUs take with --jobs-per-gpu {options.jobs_per_gpu}: "
            "raise that, or set CUDA_VISIBLE_DEVICES to nothing to run on the CPU"
        )
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return [Place(_share(cores, number, jobs), gpus[number % len(gpus)] if gpus else None) for number in range(jobs)]


def _share(cores: list[int], number: int, jobs: int) -> tuple[int, ...]:
    """The cores of one of several jobs: at least one, unless the system does not tell what there is."""
    first, end = (place * len(cores) // jobs for place in (number, number + 1))
    return tuple(cores[first : max(end, first + 1)])


def visible_gpus() -> list[str]:
    """Names of the GPUs that this process may use, as CUDA_VISIBLE_DEVICES has them."""
    import torch

    count = torch.cuda.device_count()  # opens none of them
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    return shown.split(",")[:count] if shown else [str(number) for number in range(count)]
