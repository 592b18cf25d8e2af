"""Jobs on a real Ray cluster of two nodes on this machine, one of which is killed."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.sweeps.executors.waiting import begun, driver, until, waiting_job
from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.runs.ownership import in_use
from vd4rl_pomdp.sweeps.executors import ray as module
from vd4rl_pomdp.sweeps.executors.ray import RayCluster, RayOptions
from vd4rl_pomdp.sweeps.work import ClusterTask, Work

ray_is_there = pytest.importorskip("ray")
NODE = {"num_cpus": 2, "object_store_memory": 80 * 2**20, "include_dashboard": False}


@pytest.fixture(scope="module")
def cluster():
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.getcwd())
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        patch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        started = Cluster(initialize_head=True, head_node_args=NODE | {"num_gpus": 1})
        started.add_node(**NODE)
        yield started
        ray_is_there.shutdown()
        started.shutdown()


@pytest.fixture
def options(cluster) -> RayOptions:
    return RayOptions(address=cluster.address, cpus=1, gpus=0)


@pytest.fixture
def silent() -> Iterator[str]:
    """An address at which connections are taken and nothing is answered."""
    with socket.create_server(("127.0.0.1", 0), backlog=64) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize("closed", [False, True])
def test_a_cluster_that_does_not_answer_is_one_line(silent, monkeypatch, closed):
    ray_is_there.shutdown()
    monkeypatch.setattr(module, "CONNECT_S", 1.0)
    address = "127.0.0.1:9" if closed else silent  # the port of a service that nobody runs
    with pytest.raises(UnavailableError, match=f"no Ray cluster answers at --address {address} within 1 s"):
        RayCluster(RayOptions(address=address), Path())


def test_a_signal_while_a_cluster_is_waited_for_ends_the_command(silent, tmp_path):
    words = ["sweep", "run", "quick", "--executor", "ray", "--address", silent, "--out", str(tmp_path / "out")]
    script = (
        "from vd4rl_pomdp.cli import main; from vd4rl_pomdp.sweeps.executors import ray; ray.CONNECT_S = 600.0; "
        f"main({words!r})"
    )
    command = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True)
    asks = Path(f"/proc/{command.pid}/task/{command.pid}/children")
    try:
        until(lambda: any(b"ray.init" in _words_of(child) for child in asks.read_text().split()))
        command.terminate()
        told = command.communicate(timeout=120)[1]
    finally:
        command.kill()
    assert (command.returncode, told.splitlines()[-1]) == (143, "terminated: re-run the same command to resume")


def _words_of(process: str) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except FileNotFoundError:  # it has just ended
        return b""


def test_tasks_fill_the_nodes_and_a_gpu_may_be_shared(options):
    before = signal.getsignal(signal.SIGTERM)
    assert RayCluster(options, Path()).tasks == 4
    assert RayCluster(replace(options, cpus=0.5, gpus=0.25), Path()).tasks == 4
    assert RayCluster(replace(options, gpus=2, jobs=3), Path()).tasks == 3
    assert signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(UserError, match="no node of the Ray cluster has 1 CPUs and 2 GPUs"):
        RayCluster(replace(options, gpus=2), Path())
    with pytest.raises(UserError, match="whole number"):
        RayOptions(gpus=1.5).check()


def test_a_node_without_the_folder_is_told(options, tmp_path, capsys):
    made = RayCluster(options, tmp_path)
    made.submit(ClusterTask(Work("join", ("list",), tmp_path), "/nowhere"), 1)
    until(lambda: not made.live())
    assert "use a disk that all nodes share" in capsys.readouterr().err


def test_without_ray_one_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"needs Ray: pip install '\.\[ray\]' in a clone"):
        RayCluster(RayOptions(), Path())


def test_all_is_finished_although_a_node_dies_and_a_driver_that_is_stopped_ends_its_jobs(cluster, tmp_path):
    """The last test, since the node does not come back."""
    jobs = [waiting_job(tmp_path, f"job{number}") for number in range(4)]
    command = driver("ray", tmp_path, 4, address=cluster.address, cpus=1, gpus=0)
    process = subprocess.Popen(command, env=os.environ)
    try:
        until(lambda: all(begun(job) for job in jobs))
        (seen,) = begun(jobs[0])
        assert (seen["OMP_NUM_THREADS"], seen["cwd"]) == ("1", os.getcwd())
        process.terminate()
        assert process.wait(200) != 0
        assert not any(in_use(job.folder) for job in jobs)
        process = subprocess.Popen(command, env=os.environ)
        until(lambda: all(len(begun(job)) == 2 for job in jobs))
        cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
        (jobs[0].folder / "go").touch()
        until(lambda: jobs[0].finished)
        (tmp_path / "go").touch()
        assert process.wait(200) == 0
    finally:
        process.kill()
