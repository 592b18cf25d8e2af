"""Jobs as tasks of a Ray cluster that is there already: each task starts the process of a job on its node.

Ray chooses nodes and GPUs; whether an attempt is followed by another one is the driver's business, so that Ray itself
tries nothing again. A task ends with its driver, and the process of its job with the task.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

from vd4rl_pomdp.core.errors import OutOfMemoryError, UnavailableError, UserError, disk_errors
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.sweeps.executors.local import PATIENCE_S
from vd4rl_pomdp.sweeps.oom import oom_kills
from vd4rl_pomdp.sweeps.work import FAILED, INTERRUPTED, KILLED, Ended, Work, ended, start_process, wait_or_kill

NODES_S = 5.0
"""Seconds between two looks at which nodes there are."""
POLL_S = 0.2
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


class RayExecutor:
    """Tasks of a cluster."""

    def __init__(self, options: RayOptions) -> None:
        """Connect to the cluster.

        Raises:
            UnavailableError: the cluster does not answer.
            UserError: Ray is missing, there is no cluster, or none of its nodes has room for a job.
        """
        self._ray = _connected(options.address)
        self._options = options
        self._running: dict[Any, Work] = {}
        self._until, self._rooms = 0.0, [0]
        if not options.jobs and not self.slots:
            self._ray.shutdown()
            raise UserError(
                f"no node of the Ray cluster has {options.cpus:.15g} CPUs and {options.gpus:.15g} GPUs: lower --cpus "
                "or --gpus, or say with --jobs how many jobs the cluster is to grow for"
            )
        self._task = self._ray.remote(max_retries=0)(attempt)

    @property
    def slots(self) -> int:
        """Jobs at a time."""
        return self._options.jobs or sum(self._room())

    @property
    def largest(self) -> int:
        """The most slots that share a memory: a GPU's, or a node's."""
        shared = int(1 / self._options.gpus) if self._options.gpus else max(self._room())
        return max(1, min(self.slots, shared))

    def fits(self, slots: int) -> bool:
        """Whether so many slots wait for a job."""
        return sum(work.slots for work in self._running.values()) + slots <= self.slots

    def start(self, work: Work) -> None:
        """Begin a job that fits; Ray finds the node."""
        options, slots = self._options, work.slots
        task = self._task.options(num_cpus=slots * options.cpus, num_gpus=slots * options.gpus, name=work.name)
        self._running[task.remote(work, max(1, int(slots * options.cpus)), os.getcwd())] = work

    def ended(self) -> list[Ended]:
        """What has ended since the last call."""
        if not self._running:
            return []
        over, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        return [self._end(task, self._running.pop(task)) for task in over]

    def _end(self, task: Any, work: Work) -> Ended:
        errors = self._ray.exceptions
        try:
            return self._ray.get(task)
        except errors.TaskCancelledError:
            return Ended(work.name, INTERRUPTED, "ended before its process was")
        except errors.OutOfMemoryError as error:
            return Ended(work.name, OutOfMemoryError.cause, _line(error))
        except errors.RayTaskError as error:
            cause = error.cause
            return Ended(work.name, getattr(cause, "cause", FAILED), _line(cause))
        except errors.RayError as error:  # a node or a process of Ray's is gone
            return Ended(work.name, KILLED, _line(error))

    def stop(self) -> None:
        """Ask every job to end where nothing is lost, and wait for it."""
        for task in self._running:
            self._ray.cancel(task)
        if self._running:
            _, left = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=PATIENCE_S + 10)
            for task in left:
                self._ray.cancel(task, force=True)

    def _room(self) -> list[int]:
        """How many jobs every node takes."""
        if time.monotonic() > self._until:
            alive = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
            self._rooms = [self._room_of(resources) for resources in alive] or [0]
            self._until = time.monotonic() + NODES_S
        return self._rooms

    def _room_of(self, resources: dict[str, float]) -> int:
        wanted = {"CPU": self._options.cpus, "GPU": self._options.gpus}
        return min(int(resources.get(name, 0) / amount) for name, amount in wanted.items() if amount)


def attempt(work: Work, threads: int, folder: str) -> Ended:
    """What a task does on its node: start the process of a job, and end it if the task is cancelled.

    Args:
        work: the job.
        threads: how many it may use.
        folder: the driver's, in which relative paths begin.

    Raises:
        UserError: this node does not have the folder, or the log's disk takes nothing now.
    """
    try:
        os.chdir(folder)
    except OSError as error:
        raise UserError(f"{folder}: not on node {os.uname().nodename}; use a disk that all nodes share") from error
    before = oom_kills()
    with disk_errors(work.log):
        process = start_process(work, {"OMP_NUM_THREADS": str(threads)})
    try:
        while process.poll() is None:
            time.sleep(POLL_S)
    except KeyboardInterrupt:  # as which a cancellation arrives
        process.terminate()
        wait_or_kill(process, PATIENCE_S)
    return ended(work, process.returncode, before)


def _connected(address: str) -> Any:
    """Ray, connected to a cluster."""
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
