"""Independent jobs over worker processes, results in order; workers end at once with their caller, however it ends."""

from __future__ import annotations

import atexit
import multiprocessing
import multiprocessing.connection
import os
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pickle import PicklingError, UnpicklingError
from typing import Any, TypeVar

from vd4rl_pomdp.core.errors import UserError, WorkerDiedError, first_line
from vd4rl_pomdp.runs.interrupt import blocked

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yield function(job) for every job, in order.

    Workers are fresh processes (no GL context or thread pool is inherited) with one thread each; they end with the
    caller. With one worker everything runs in the calling process; 0 is a worker for every core.

    Raises:
        UserError: a worker died; what a job raises is raised here.
    """
    workers = count_workers(workers)
    if workers <= 1 or len(jobs) <= 1:
        yield from map(function, jobs)
        return
    crew = _Crew()
    try:
        crew.start(function, min(workers, len(jobs)))
        yield from crew.results(jobs)
    finally:
        crew.end()


def count_workers(workers: int) -> int:
    """`workers`, or for 0 the number of cores that this process may use."""
    if workers:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Crew:
    """Worker processes, each at the other end of a pipe.

    The standard library's pools wait for their running jobs when they are told to end, and leave semaphores behind
    when they are killed; pipes need neither.
    """

    def __init__(self) -> None:
        self._workers: dict[Connection, Any] = {}
        _CREWS.add(self)

    def start(self, function: Callable[[Any], Any], size: int) -> None:
        """Start the processes, which do `function`."""
        context = multiprocessing.get_context("spawn")
        resource_tracker.ensure_running()  # now: to start it later would unblock the signals that are `blocked` below
        for _ in range(size):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, function), daemon=True)
            with blocked():  # Ctrl-C, which a terminal sends to all processes, is the caller's business
                process.start()
                self._workers[ours] = process
            theirs.close()

    def results(self, jobs: Sequence[Any]) -> Iterator[Any]:
        """Results in the order of the jobs."""
        waiting, finished, next_out = iter(enumerate(jobs)), {}, 0
        for connection in self._workers:
            self._give(connection, waiting)
        while next_out < len(jobs):
            ready: list[Any] = multiprocessing.connection.wait(list(self._workers))
            for connection in ready:
                number, result, error = self._take(connection)
                if error is not None:
                    raise error
                finished[number] = result
                self._give(connection, waiting)
            while next_out in finished:
                yield finished.pop(next_out)
                next_out += 1

    def _give(self, connection: Connection, waiting: Iterator[tuple[int, Any]]) -> None:
        job = next(waiting, None)
        if job is not None:
            with self._expecting_life(connection):
                _send(connection, job)

    def _take(self, connection: Connection) -> tuple[int, Any, BaseException | None]:
        with self._expecting_life(connection):
            number, result, error = connection.recv()
        return number, result, error

    @contextmanager
    def _expecting_life(self, connection: Connection) -> Iterator[None]:
        try:
            yield
        except (EOFError, ConnectionError):
            process = self._workers[connection]
            process.join()
            killed = process.exitcode is not None and process.exitcode < 0
            why = "perhaps for want of memory: use fewer --workers" if killed else "as what it printed tells: mend that"
            raise WorkerDiedError(
                f"a worker process ended before its job (exit code {process.exitcode}), {why} "
                "and re-run the same command"
            ) from None

    def end(self) -> None:
        """End all workers at once; they hold nothing that could be lost."""
        for process in self._workers.values():
            process.kill()
        for connection, process in self._workers.items():
            process.join()
            connection.close()
        self._workers.clear()
        _CREWS.discard(self)


_CREWS: set[_Crew] = set()


@atexit.register
def _end_all() -> None:
    """End the crews whose results were not all read."""
    for crew in list(_CREWS):
        crew.end()


def _send(connection: Connection, job: Any) -> None:
    try:
        connection.send(job)
    except (PicklingError, AttributeError, TypeError) as error:
        raise _unsendable(error) from error


def _unsendable(error: Exception) -> UserError:
    return UserError(
        f"a job cannot be sent to a worker process ({first_line(error)}): define its classes and functions in a "
        "module, or use --workers 1"
    )


def _serve(connection: Connection, function: Callable[[Any], Any]) -> None:
    """Do jobs until the pipe is closed."""
    _start_worker()
    while True:
        try:
            number, job = connection.recv()
        except EOFError:
            return
        except (AttributeError, ImportError, UnpicklingError) as error:  # what a job names is not in this process
            connection.send((-1, None, _unsendable(error)))
            continue
        connection.send((number, *_attempt(function, job)))


def _attempt(function: Callable[[Any], Any], job: Any) -> tuple[Any, BaseException | None]:
    try:
        return function(job), None
    except BaseException as error:
        where = f"in a worker process:\n{traceback.format_exc()}"
        error = error if _crosses(error) else RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(where)
        return None, error


def _crosses(error: BaseException) -> bool:
    """Whether an error of others' code comes out of a pipe as it went in."""
    try:
        return type(ForkingPickler.loads(ForkingPickler.dumps(error))) is type(error)
    except Exception:
        return False


def _start_worker() -> None:
    """One thread a worker; a worker never outlives its parent."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import threadpoolctl
    import torch

    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)


def _end_with_parent() -> None:
    """End this process when its parent is gone, however it went."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)
