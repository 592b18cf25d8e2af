"""Jobs in worker processes: ordered results, errors raised in the parent, and no process left."""

import multiprocessing
import multiprocessing.connection
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from vd4rl_pomdp.core.errors import DiskFullError, UserError, WorkerDiedError
from vd4rl_pomdp.runs.workers import count_workers, kept_workers, run_jobs

PARENT = """
from tests.runs.test_workers import print_pid_and_sleep
from vd4rl_pomdp.runs.workers import run_jobs
if __name__ == "__main__":
    list(run_jobs(print_pid_and_sleep, [0, 1], 2))
"""


def print_pid_and_sleep(job: int) -> None:
    os.write(1, f"{os.getpid()}\n".encode())  # atomic; `print` of two processes may interleave
    time.sleep(60)


def act(job: str) -> str:
    if job == "refuse":
        raise DiskFullError("run: the disk is full")
    if job == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    return job.upper()


def number_of_process(_: int) -> int:
    time.sleep(0.2)
    return os.getpid()


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("workers", [1, 2])
def test_job_results_keep_their_order(workers):
    assert list(run_jobs(act, ["a", "b", "c", "d", "e"], workers)) == ["A", "B", "C", "D", "E"]
    assert count_workers(0) >= 1
    assert count_workers(3) == 3


@pytest.mark.parametrize(
    ("job", "kind", "message"),
    [
        ("refuse", DiskFullError, "^run: the disk is full$"),
        ("die", WorkerDiedError, "a worker process ended before its job: .* use fewer --workers"),
        (lambda: None, UserError, r"a job cannot be sent to a worker process \(.*lambda.*\): .* --workers 1"),
    ],
)
def test_worker_errors_are_raised_in_the_parent(job, kind, message):
    with pytest.raises(kind, match=message):
        list(run_jobs(act, [job, "b"], 2))
    assert not multiprocessing.active_children()


def test_killed_parent_leaves_no_workers(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as parent:
        assert parent.stdout is not None
        workers = [int(parent.stdout.readline()) for _ in range(2)]
        assert all(map(alive, workers))
        parent.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 20
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(alive, workers))


def test_interrupted_iteration_leaves_no_workers():
    results = run_jobs(print_pid_and_sleep, [0, 1], 2)
    main = threading.main_thread().ident
    threading.Timer(1.0, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert not multiprocessing.active_children()


def test_kept_workers_are_reused_until_one_dies():
    def serving(workers: int) -> set[int]:
        list(run_jobs(number_of_process, range(workers), workers))  # one worker may be fast enough to do all jobs
        return {child.pid for child in multiprocessing.active_children() if child.pid}

    with kept_workers():
        first = serving(2)
        assert serving(2) == first
        more = serving(3)
        assert not more & first
        killed = multiprocessing.active_children()[0]
        killed.kill()
        multiprocessing.connection.wait([killed.sentinel])
        assert not serving(2) & more
        assert len(multiprocessing.active_children()) == 2
    assert not multiprocessing.active_children()
