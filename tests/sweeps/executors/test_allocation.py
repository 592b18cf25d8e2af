"""What a task of a Slurm array does, without Slurm: a process that is given jobs as files, and signals."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from tests.sweeps.executors.waiting import begun, until, waiting_job, work_of
from vd4rl_pomdp.sweeps.executors.allocation import Allocation
from vd4rl_pomdp.sweeps.executors.handover import Handover
from vd4rl_pomdp.sweeps.work import DONE, INTERRUPTED, KILLED, Ended, Work

TASK = """
import signal, sys
from pathlib import Path
from vd4rl_pomdp.sweeps.executors.allocation import Allocation
signal.signal(signal.SIGUSR2, lambda number, frame: sys.exit("requeued"))
Allocation(Path(sys.argv[1]), 3, 1, 1.0)()
"""


def start_task(folder) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": os.getcwd(), "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-c", TASK, str(folder)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def test_a_task_goes_on_with_the_jobs_that_a_signal_ended(tmp_path):
    handed, out = Handover(tmp_path / "array"), tmp_path / "out"
    long, short = (waiting_job(out, name) for name in ("long", "short"))
    (short.folder / "go").touch()
    attempts = {job.name: handed.add(3, work_of(job)) for job in (long, short)}
    handed.add(4, Work("of another task", ("list",), out / "log"))
    task = start_task(handed.folder)
    until(lambda: begun(long))
    task.send_signal(signal.SIGTERM)
    task.communicate(timeout=100)
    assert handed.ended() == set()
    assert not begun(short), "one at a time"
    (out / "go").touch()
    task = start_task(handed.folder)
    task.communicate(timeout=100)
    assert task.returncode == 0, "it ends when there has been nothing to do for a second"
    assert handed.left(3) == {}
    assert {handed.end_of(attempt) for attempt in attempts.values()} == {Ended(name, DONE, "") for name in attempts}
    assert [len(begun(job)) for job in (long, short)] == [2, 1]


def test_before_the_time_limit_jobs_end_and_then_the_task_asks_to_be_started_again(tmp_path):
    handed, job = Handover(tmp_path / "array"), waiting_job(tmp_path / "out", "job")
    handed.add(3, work_of(job))
    task = start_task(handed.folder)
    until(lambda: begun(job))
    task.send_signal(signal.SIGUSR2)
    assert task.communicate(timeout=100)[1].strip() == "requeued"
    assert "terminated" in work_of(job).log.read_text()
    assert handed.ended() == set()


class FakeExecutor:
    """Ends every job for one cause, and counts places."""

    def __init__(self, cause: str) -> None:
        self.free, self._cause, self._started = 4, cause, []
        self.largest = 2

    def fits(self, slots: int) -> bool:
        return slots <= self.free

    def start(self, work: Work) -> None:
        self.free -= work.slots
        self._started.append(work)

    def ended(self) -> list[Ended]:
        over, self._started = self._started, []
        self.free += sum(work.slots for work in over)
        return [Ended(work.name, self._cause, "why") for work in over]

    def stop(self) -> None:
        pass


def test_of_jobs_that_take_all_places_of_one_gpu_half_as_many_run(tmp_path):
    handed, task, executor = Handover(tmp_path), Allocation(tmp_path, 0, 4), FakeExecutor(DONE)
    for number in range(3):
        handed.add(0, Work(f"large{number}", ("list",), tmp_path / "log", 2 + 6 * number))
    handed.add(0, Work("small", ("list",), tmp_path / "log"))
    task._begin(executor, handed.left(0))
    assert [work.name for work in executor._started] == ["large0", "large1"]
    task._tell(executor, handed)
    assert [work.name for work in handed.left(0).values()] == ["large2", "small"]


@pytest.mark.parametrize(
    ("cause", "asked", "told"),
    [(DONE, True, True), (KILLED, False, True), (KILLED, True, False), (INTERRUPTED, False, False)],
)
def test_what_was_ended_from_outside_is_not_over(tmp_path, cause, asked, told):
    handed, task, executor = Handover(tmp_path), Allocation(tmp_path, 0, 4), FakeExecutor(cause)
    handed.add(0, Work("job", ("list",), tmp_path / "log"))
    task._asked += [signal.SIGTERM] * asked
    task._begin(executor, handed.left(0))
    task._tell(executor, handed)
    assert bool(handed.ended()) == told
    task._begin(executor, handed.left(0))
    assert bool(executor._started) != told


def test_on_a_full_disk_an_end_is_told_later_and_once(tmp_path, monkeypatch):
    handed, task, executor = Handover(tmp_path), Allocation(tmp_path, 0, 4), FakeExecutor(DONE)
    attempt = handed.add(0, Work("job", ("list",), tmp_path / "log"))
    with monkeypatch.context() as patch:
        patch.setattr(os, "mkdir", lambda *told, **more: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
        task._begin(executor, handed.left(0))
        task._tell(executor, handed)
    task._begin(executor, handed.left(0))
    assert not executor._started
    task._tell(executor, handed)
    assert handed.end_of(attempt) == Ended("job", DONE, "why")
