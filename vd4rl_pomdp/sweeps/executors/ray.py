"""Tasks of a sweep on a Ray cluster that is there already.

Ray chooses nodes and GPUs, and ends a task with the driver that asked for it. It tries nothing again itself.
"""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.sweeps.work import PATIENCE_S, ClusterTask, Ended

CONNECT_S = 30.0
"""Seconds that a cluster has to answer a process that connects."""


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

    limits: ClassVar[Limits] = {"cpus": (0.01, 4096), "gpus": (0, 64), "jobs": (0, 10**5)}

    def check(self) -> None:
        """Refuse a share of several GPUs, which Ray does not give."""
        super().check()
        if self.gpus > 1 and self.gpus % 1:
            raise UserError(f"--gpus is {self.gpus}; above 1 it must be a whole number")


class RayCluster:
    """A sweep's tasks on a Ray cluster, each with one job at a time."""

    jobs_per_task = 1

    def __init__(self, options: RayOptions, folder: Path) -> None:
        """Connect to the cluster.

        Raises:
            UnavailableError: the cluster does not answer.
            UserError: Ray is missing, there is no cluster, or none of its nodes has room for a job.
        """
        self._ray, self._options, self.folder = _connected(options.address), options, folder
        self.threads = max(1, int(options.cpus))
        self._running: list[Any] = []
        if not self.tasks:
            self._ray.shutdown()
            raise UserError(
                f"no node of the Ray cluster has {options.cpus:.15g} CPUs and {options.gpus:.15g} GPUs: lower --cpus "
                "or --gpus, or say with --jobs how many jobs the cluster is to grow for"
            )

    @property
    def tasks(self) -> int:
        """What was asked for, or what the nodes take that are there now."""
        wanted = {"CPU": self._options.cpus, "GPU": self._options.gpus}
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        rooms = (min(int(one.get(name, 0) / share) for name, share in wanted.items() if share) for one in nodes)
        return self._options.jobs or sum(rooms)

    def live(self) -> int:
        """How many tasks wait or run. One that failed says why."""
        over, self._running = (
            self._ray.wait(self._running, num_returns=len(self._running), timeout=0) if (self._running) else ([], [])
        )
        for task in over:
            try:
                self._ray.get(task)
            except self._ray.exceptions.RayError as error:
                print(f"warning: a task ended ({_line(getattr(error, 'cause', None) or error)})", file=sys.stderr)
        return len(self._running)

    def submit(self, task: ClusterTask, number: int) -> None:
        """Start tasks; Ray finds their nodes."""
        run = self._ray.remote(max_retries=0)(_run)
        run = run.options(num_cpus=self._options.cpus, num_gpus=self._options.gpus, name=str(self.folder))
        self._running += [run.remote(task) for _ in range(number)]

    def stop(self) -> None:
        """Cancel what waits, ask every task to end where nothing is lost, and wait for it."""
        for task in self._running:
            self._ray.cancel(task)
        if self._running:
            _, left = self._ray.wait(self._running, num_returns=len(self._running), timeout=PATIENCE_S + 10)
            for task in left:
                self._ray.cancel(task, force=True)


def _run(task: ClusterTask) -> Ended:
    return task.run([])


def _connected(address: str) -> Any:
    """Ray, connected to a cluster.

    Raises:
        UnavailableError: it does not answer.
        UserError: Ray is missing, or there is no cluster.
    """
    try:
        import ray
    except ImportError as error:
        raise UserError("--executor ray needs Ray: pip install '.[ray]' in a clone of vd4rl-pomdp") from error
    if not ray.is_initialized():
        _require_answer(address)
    try:
        with _own_signals():
            ray.init(address, log_to_driver=False, logging_level=logging.WARNING, ignore_reinit_error=True)
    except (ConnectionError, RuntimeError, ValueError) as error:  # a RuntimeError for a cluster of another version
        raise UserError(
            f"no Ray cluster at {address!r} ({_line(error)}): start one with `ray start --head`, or name another "
            "with --address"
        ) from error
    return ray


def _require_answer(address: str) -> None:
    """Raise UnavailableError if a cluster does not answer in time.

    Another process asks: `ray.init` tries for ten minutes, in C++ code that no signal and no deadline interrupts. Where
    it fails at once, so does this process's own attempt, which says why.
    """
    command = [sys.executable, "-P", "-c", "import sys, ray; ray.init(sys.argv[1])", address]
    try:
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=CONNECT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise UnavailableError(
            f"no Ray cluster answers at --address {address} within {CONNECT_S:.0f} s: start one with `ray start "
            "--head`, or name another with --address"
        ) from error


@contextmanager
def _own_signals() -> Iterator[None]:
    """Ray answers SIGTERM in its own way from `init` on; this program has its own."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


def _line(error: BaseException) -> str:
    """The first sentence of an error."""
    lines = (line.strip() for line in str(error).splitlines())
    return next((line.partition(". ")[0] for line in lines if line), type(error).__name__)
