"""Independent jobs over worker processes: the standard library's pool, whose workers end at once with their caller."""

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

from vd4rl_pomdp.core.errors import UserError, WorkerDiedError, first_line
from vd4rl_pomdp.runs.interrupt import SIGNALS

Job = TypeVar("Job")
Result = TypeVar("Result")


class _Pool:
    """Worker processes that have started."""

    def __init__(self, workers: int) -> None:
        self._executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker)
        self._processes: dict[int, Any] = {}

    def map(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        # Processes that are started here inherit the mask: Ctrl-C, which a terminal sends to all, is not for them, nor
        # is the SIGTERM that a cluster sends to a whole group.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            results = self._executor.map(function, jobs)
            self._processes = dict(self._executor._processes)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return results

    def serves(self, workers: int) -> bool:
        """Whether so many are there and alive."""
        # by their sentinels: `is_alive` says yes to a process that another thread has waited for
        ended = multiprocessing.connection.wait([process.sentinel for process in self._processes.values()], 0)
        return len(self._processes) >= workers and not ended

    def close(self) -> None:
        for process in self._processes.values():  # they hold nothing that could be lost, and `shutdown` waits for jobs
            process.kill()
        self._executor.shutdown(cancel_futures=True)


_kept: list[_Pool] = []
"""Idle workers, of one pool at most."""
_keeping = False


@contextmanager
def kept_workers() -> Iterator[None]:
    """Within the block, workers that have done their jobs wait for those of the next `run_jobs`.

    They need not start again, nor open what they opened: for evaluations of a training, which follow one another.
    """
    global _keeping
    before, _keeping = _keeping, True
    try:
        yield
    finally:
        _keeping = before
        if not _keeping:
            _close_kept()


def _close_kept() -> None:
    while _kept:
        _kept.pop().close()


def run_jobs(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yield function(job) for every job, in order.

    Workers are fresh processes (no GL context or thread pool is inherited) with one thread each; under `kept_workers`
    they may have served before. With one worker everything runs in the calling process; 0 is a worker for every core.

    Raises:
        UserError: a worker died, or a job cannot be sent to one; what a job raises is raised here.
    """
    workers = min(count_workers(workers), len(jobs))
    if workers <= 1:
        yield from map(function, jobs)
        return
    try:
        ForkingPickler.dumps(jobs[0])  # the pool tells of it only by a job's error, which looks like the job's own
    except (PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            f"a job cannot be sent to a worker process ({first_line(error)}): define its classes and functions in a "
            "module, or use --workers 1"
        ) from error
    if _kept and not _kept[0].serves(workers):
        _close_kept()
    pool, done = _kept.pop() if _kept else _Pool(workers), False
    try:
        yield from pool.map(function, jobs)
        done = True
    except BrokenProcessPool as error:
        if error.__cause__ is not None:  # a result that cannot be read here
            raise
        raise WorkerDiedError(
            "a worker process ended before its job: if it printed nothing, it was killed, perhaps for want of memory: "
            "use fewer --workers and re-run the same command"
        ) from None
    finally:
        if done and _keeping and not _kept:
            _kept.append(pool)
        else:
            pool.close()


def count_workers(workers: int) -> int:
    """`workers`, or for 0 the number of cores that this process may use."""
    if workers:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _start_worker() -> None:
    """One thread a worker, which never outlives its parent, however that ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import threadpoolctl
    import torch

    # Each library would start a thread for every core in every worker, and they would wait for one another.
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)  # at once, even inside a library's C code: nobody is left to take what it computes
