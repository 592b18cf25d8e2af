"""Parallel jobs in worker processes: the standard library's pool, but workers die at once with their parent."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.reduction import ForkingPickler
from pickle import PicklingError
from typing import Any, TypeVar

import threadpoolctl
import torch

from vd4rl_pomdp.core.errors import UserError, WorkerDiedError, first_line
from vd4rl_pomdp.runs.interrupt import SIGNALS

Job = TypeVar("Job")
Result = TypeVar("Result")


class _Pool:
    """Running worker processes."""

    def __init__(self, workers: int) -> None:
        self._executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker)
        self._processes: dict[int, Any] = {}

    def map(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        # Workers inherit the signal mask, which spares them Ctrl-C from a terminal and SIGTERM to a process group.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            results = self._executor.map(function, jobs)
            self._processes = dict(self._executor._processes)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return results

    def serves(self, workers: int) -> bool:
        """Whether at least `workers` processes are there and all are alive."""
        # via sentinels: `is_alive` returns True if another thread has waited for the process
        ended = multiprocessing.connection.wait([process.sentinel for process in self._processes.values()], 0)
        return len(self._processes) >= workers and not ended

    def close(self) -> None:
        for process in self._processes.values():  # they hold no state, and `shutdown` would wait for their jobs
            process.kill()
        self._executor.shutdown(cancel_futures=True)


_idle: list[_Pool] = []  # at most one pool
_keeping = False


@contextmanager
def kept_workers() -> Iterator[None]:
    """Within the block, workers stay alive between calls of `run_jobs`, with their open environments."""
    global _keeping
    before, _keeping = _keeping, True
    try:
        yield
    finally:
        _keeping = before
        if _idle and not _keeping:
            _idle.pop().close()


def run_jobs(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yield function(job) for every job, in order.

    Workers are fresh single-threaded processes that inherit no GL context or thread pool; under `kept_workers` they may
    be reused. With one worker, everything runs in the calling process. 0 means one worker per core. UserError if a
    worker died, or a job cannot be pickled. Exceptions of jobs are re-raised here.
    """
    workers = min(count_workers(workers), len(jobs))
    if workers <= 1:
        yield from map(function, jobs)
        return
    try:
        ForkingPickler.dumps(jobs[0])  # check here: from the pool, a pickling error looks like the job's own error
    except (PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            f"a job cannot be sent to a worker process ({first_line(error)}): define its classes and functions in a "
            "module, or use --workers 1"
        ) from error
    if _idle and not _idle[0].serves(workers):
        _idle.pop().close()
    pool, done = _idle.pop() if _idle else _Pool(workers), False
    try:
        yield from pool.map(function, jobs)
        done = True
    except BrokenProcessPool as error:
        if error.__cause__ is not None:  # a result that cannot be unpickled here
            raise
        raise WorkerDiedError(
            "a worker process ended before its job: if it printed nothing, it was killed, perhaps for lack of memory: "
            "use fewer --workers and re-run the same command"
        ) from None
    finally:
        if done and _keeping and not _idle:
            _idle.append(pool)
        else:
            pool.close()


def count_workers(workers: int) -> int:
    """`workers`, or the number of usable cores if 0."""
    return workers or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def _start_worker() -> None:
    """Set up a worker: one thread, and exit with the parent however that ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Otherwise every library starts one thread per core in each worker.
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)  # immediately, even inside a library's C code: the result has no recipient
