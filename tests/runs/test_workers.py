import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import workers
from vd4rl_pomdp.runs.workers import count_workers, run_jobs

PARENT = """
import os, time
from tests.runs.test_workers import tell_and_sleep
from vd4rl_pomdp.runs.workers import run_jobs
if __name__ == "__main__":
    list(run_jobs(tell_and_sleep, [0, 1], 2))
"""


def tell_and_sleep(job: int) -> None:
    os.write(1, f"{os.getpid()}\n".encode())  # at once: `print` may write the line's end apart, and there are two
    time.sleep(60)


def square(job: int) -> int:
    return job * job


NOTEBOOK = """
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.workers import run_jobs
from tests.runs.test_workers import square
class Job(int):
    pass
try:
    list(run_jobs(square, [Job(1), Job(2)], 2))
except UserError as error:
    print(error)
"""


def test_a_job_that_workers_cannot_read_is_told_as_that():
    """What a notebook or `python -c` defines is not there in another process."""
    run = subprocess.run([sys.executable, "-c", NOTEBOOK], capture_output=True, text=True, check=True)
    assert "a job cannot be sent to a worker process (Can't get attribute 'Job'" in run.stdout
    assert "or use --workers 1" in run.stdout


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order(workers):
    assert list(run_jobs(square, range(5), workers)) == [0, 1, 4, 9, 16]


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_killed_parent_leaves_no_workers(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    assert all(map(_alive, workers))
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 20
    while any(map(_alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(_alive, workers))


def test_no_number_of_workers_is_one_for_every_core():
    assert count_workers(0) >= 1
    assert count_workers(3) == 3


def fail_or_die(job: int) -> int:
    if job == 1:
        raise ValueError("job 1 is wrong")
    if job == 3:
        os._exit(7)
    return job


def test_what_a_job_raises_is_raised_with_where_it_was():
    with pytest.raises(ValueError, match="job 1 is wrong") as caught:
        list(run_jobs(fail_or_die, [0, 1, 2], 2))
    assert "in fail_or_die" in caught.value.__notes__[0]


class TwoWordsError(Exception):
    """Other people's, which no pipe gives back: it is made of two words and keeps one."""

    def __init__(self, what: str, where: str) -> None:
        super().__init__(f"{what} is lost in {where}")


def fail_in_two_words(job: int) -> None:
    raise TwoWordsError("job", "space")


def test_an_error_that_no_pipe_carries_is_told_all_the_same():
    with pytest.raises(RuntimeError, match="TwoWordsError: job is lost in space") as caught:
        list(run_jobs(fail_in_two_words, [0, 1], 2))
    assert "in fail_in_two_words" in caught.value.__notes__[0]


def test_a_worker_that_dies_is_one_sentence():
    with pytest.raises(UserError, match=r"a worker process ended before its job \(exit code 7\), as what it printed"):
        list(run_jobs(fail_or_die, [2, 3], 2))


def be_killed(job: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_was_killed_may_have_lacked_memory(capfd):
    with pytest.raises(
        UserError, match=r"\(exit code -9\), perhaps for want of memory: use fewer --workers and re-run"
    ):
        list(run_jobs(be_killed, [0, 1], 2))


def test_a_job_that_no_other_process_can_read_is_one_sentence():
    class Local:
        pass

    with pytest.raises(UserError, match=r"a job cannot be sent to a worker process \(.*Local.*\): .* --workers 1"):
        list(run_jobs(square, [Local(), Local()], 2))


def test_results_that_nobody_takes_leave_no_workers():
    results = run_jobs(tell_and_sleep, [0, 1], 2)
    crews = set(workers._CREWS)
    with pytest.raises(KeyboardInterrupt):
        raise_in_place_of(next, results)
    assert set(workers._CREWS) == crews
    assert not multiprocessing.active_children()


def raise_in_place_of(function, *arguments):
    """Call a function that Ctrl-C cuts."""
    threading.Timer(1.0, lambda: signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)).start()
    function(*arguments)
