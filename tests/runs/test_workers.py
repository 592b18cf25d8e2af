import os
import signal
import subprocess
import sys
import time

import pytest

from vd4rl_pomdp.runs.workers import count_workers, run_jobs

PARENT = """
import os, time
from tests.runs.test_workers import tell_and_sleep
from vd4rl_pomdp.runs.workers import run_jobs
if __name__ == "__main__":
    list(run_jobs(tell_and_sleep, [0, 1], 2))
"""


def tell_and_sleep(job: int) -> None:
    print(os.getpid(), flush=True)
    time.sleep(60)


def square(job: int) -> int:
    return job * job


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
