"""Jobs on a real Slurm of one node: arrays, allocations that are used again, requeue, and drivers that are killed."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from tests.sweeps.executors.slurm_cluster import slurm, why_not
from tests.sweeps.executors.waiting import begun, run, until, waiting_job, work_of
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.sweeps.executors import slurm as module
from vd4rl_pomdp.sweeps.executors.slurm import SlurmExecutor
from vd4rl_pomdp.sweeps.executors.slurm_queue import SlurmOptions
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.work import DONE, INTERRUPTED, KILLED

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())
SETTLED_S = 5.0
"""Time for Slurm to hear how an interrupted task's script ended: told of it after the new start, it fails the task."""
OPTIONS = SlurmOptions(time=30, gpus=0, cpus=2, tasks=4)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with slurm(tmp_path_factory.mktemp("slurm")) as configuration:
        yield configuration


@pytest.fixture
def out(cluster, tmp_path, monkeypatch):
    """Folder of a sweep, on a machine with the cluster."""
    monkeypatch.setenv("SLURM_CONF", str(cluster))
    monkeypatch.setenv("PYTHONPATH", os.getcwd())
    for name, seconds in {"QUEUE_S": 0.5, "IDLE_S": 4.0}.items():
        monkeypatch.setattr(module, name, seconds)
    yield tmp_path / "out"
    subprocess.run(["scancel", "--me"], check=True)
    until(lambda: not queue())


def make(out, **changes) -> SlurmExecutor:
    return SlurmExecutor(replace(OPTIONS, **changes), out / "sweep" / "slurm")


def queue() -> list[str]:
    """Slurm's numbers of tasks that run or wait."""
    told = subprocess.run(
        ["squeue", "--array", "--noheader", "--format=%i"], capture_output=True, text=True, check=True
    )
    return told.stdout.split()


def test_what_starts_together_is_one_array_of_tasks_with_several_jobs_each_and_free_places_are_used_again(out):
    jobs = [waiting_job(out, f"job{number}") for number in range(4)]
    executor = make(out, jobs_per_task=2)
    for job in jobs[:3]:
        executor.start(work_of(job))
    assert executor.slots == 8
    run(executor, 0)
    assert sorted(name.partition("_")[2] for name in queue()) == ["0", "1"]
    until(lambda: all(begun(job) for job in jobs[:3]))  # at the same time: none of them may end yet
    executor.start(work_of(jobs[3]))
    until(lambda: begun(jobs[3]))
    assert len(queue()) == 2
    (out / "go").touch()
    found = run(executor, 4)
    assert {ended.name: ended.cause for ended in found} == {job.name: DONE for job in jobs}
    executor.stop()
    assert queue() == []


@pytest.mark.parametrize("how", ["scontrol requeue", "scancel --signal=USR2"])
def test_a_task_that_slurm_interrupts_starts_again_with_its_jobs(out, how):
    """The second is what Slurm sends before the time limit."""
    job, executor = waiting_job(out, "job"), make(out)
    executor.start(work_of(job))
    run(executor, 0)
    until(lambda: begun(job))
    subprocess.run([*how.split(), *queue()], check=True)
    update = ["scontrol", "update", "StartTime=now", f"JobId={queue()[0]}"]  # Slurm has it wait else
    settled = time.monotonic() + SETTLED_S

    def hurry(found):
        if time.monotonic() > settled:
            subprocess.run(update, capture_output=True, check=False)
        if len(begun(job)) == 2:
            (out / "go").touch()

    assert [ended.cause for ended in run(executor, 1, hurry)] == [DONE]
    assert len(begun(job)) == 2
    assert "terminated" in work_of(job).log.read_text()


def test_what_is_stopped_ends_in_peace_and_what_is_cancelled_was_killed(out):
    running, waiting, cancelled = (waiting_job(out, name) for name in ("running", "waiting", "cancelled"))
    executor = make(out, cpus=8)
    executor.start(work_of(cancelled))
    run(executor, 0)
    until(lambda: begun(cancelled))
    subprocess.run(["scancel", *queue()], check=True)
    (ended,) = run(executor, 1)
    assert (ended.cause, "CANCELLED" in ended.line) == (KILLED, True)
    executor.start(work_of(running))
    run(executor, 0)
    until(lambda: begun(running))
    executor.start(work_of(waiting))
    run(executor, 0)
    executor.stop()
    assert queue() == []
    assert {ended.name: ended.cause for ended in run(executor, 2)} == {"running": INTERRUPTED, "waiting": INTERRUPTED}
    assert not begun(waiting)


def test_a_new_driver_waits_for_what_a_killed_one_has_running_and_in_the_queue(out, request):
    def start_driver():
        driver = subprocess.Popen([sys.executable, "-m", "tests.sweeps.executors.waiting", str(out), "2"])
        request.addfinalizer(driver.kill)
        return driver

    driver = start_driver()
    until(lambda: len(queue()) == 2)  # of which the machine takes one at a time
    until(lambda: begun(waiting_job(out, "job0")))
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    driver = start_driver()
    until(lambda: (out / "sweep" / "slurm").is_dir())
    (out / "go").touch()
    assert driver.wait(150) == 0
    assert [len(begun(waiting_job(out, name))) for name in ("job0", "job1")] == [1, 1]
    assert len(list((out / "sweep" / "slurm").iterdir())) == 1
    assert {row["cause"] for rows in SweepFolder(out).attempts().values() for row in rows} == {DONE}


def test_an_array_that_slurm_refuses_is_one_line_and_a_later_one_is_tried_again(out, capsys):
    executor = make(out, partition="none")
    executor.start(work_of(waiting_job(out, "job")))
    with pytest.raises(UserError, match=r"Slurm took no array .*partition"):
        executor.ended()
    executor._accepted = True
    assert executor.ended() == []
    assert "trying again in 60 s" in capsys.readouterr().err
    executor.stop()
    assert queue() == []
