"""A sweep on a real Slurm of one node: tasks share the jobs, are replaced, and outlive a driver that is killed."""

import os
import signal
import subprocess

import pytest

from tests.sweeps.executors.slurm_cluster import slurm, why_not
from tests.sweeps.executors.waiting import begun, driver, until, waiting_job
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.work import INTERRUPTED

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())
OPTIONS = {"time": 30, "gpus": 0, "cpus": 2, "tasks": 4}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with slurm(tmp_path_factory.mktemp("slurm")) as configuration:
        yield configuration


@pytest.fixture
def out(cluster, tmp_path, monkeypatch):
    """Folder of a sweep, on a machine with the cluster."""
    monkeypatch.setenv("SLURM_CONF", str(cluster))
    monkeypatch.setenv("PYTHONPATH", os.getcwd())
    yield tmp_path / "out"
    subprocess.run(["scancel", "--me"], check=True)
    until(lambda: not queue())


@pytest.fixture
def start(out, request):
    def started(number: int, **changes: object) -> subprocess.Popen:
        process = subprocess.Popen(driver("slurm", out, number, **OPTIONS | changes), stderr=subprocess.PIPE, text=True)
        request.addfinalizer(process.kill)
        return process

    return started


def queue() -> list[str]:
    """Slurm's numbers of tasks that run or wait."""
    told = subprocess.run(
        ["squeue", "--array", "--noheader", "--format=%i"], capture_output=True, text=True, check=True
    )
    return told.stdout.split()


def causes(out) -> dict[str, list[str]]:
    return {name: [row["cause"] for row in rows] for name, rows in SweepFolder(out).attempts().items()}


def test_tasks_share_the_jobs_of_a_sweep_and_a_cancelled_one_is_replaced(out, start):
    jobs = [waiting_job(out, f"job{number}") for number in range(3)]
    process = start(3, jobs_per_task=2)
    until(lambda: all(begun(job) for job in jobs))
    assert len(queue()) == 2
    subprocess.run(["scancel", queue()[0]], check=True)
    until(lambda: sum(len(begun(job)) for job in jobs) > 3)
    (out / "go").touch()
    process.communicate(timeout=200)
    assert process.returncode == 0, "all is finished"
    until(lambda: not queue())


def test_a_task_before_its_time_limit_and_a_driver_that_is_stopped_end_in_peace(out, start):
    (job,) = jobs = [waiting_job(out, "job0")]
    process = start(1)
    until(lambda: begun(job))
    subprocess.run(["scancel", "--signal=USR2", *queue()], check=True)  # what Slurm sends before the limit
    until(lambda: len(begun(job)) == 2)
    process.terminate()
    process.communicate(timeout=200)
    assert queue() == []
    assert causes(out) == {job.name: [INTERRUPTED, INTERRUPTED] for job in jobs}


def test_a_new_driver_finds_the_tasks_of_a_killed_one(out, start):
    jobs = [waiting_job(out, f"job{number}") for number in range(2)]
    process = start(2, cpus=8)  # of which the machine takes one task at a time
    until(lambda: any(begun(job) for job in jobs))
    until(lambda: len(queue()) == 2)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before, process = queue(), start(2, cpus=8)
    (out / "go").touch()
    process.communicate(timeout=200)
    assert process.returncode == 0
    assert set(queue()) <= set(before)
    assert [len(begun(job)) for job in jobs] == [1, 1]


def test_an_array_that_slurm_refuses_is_one_line(out, start):
    process = start(1, partition="none")
    told = process.communicate(timeout=200)[1]
    assert process.returncode == 1
    assert "UserError: Slurm took no array" in told.splitlines()[-1]
    assert "partition" in told.splitlines()[-1]
    assert queue() == []
