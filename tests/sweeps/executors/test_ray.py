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

from tests.sweeps.executors.waiting import begun, run, until, waiting_job, work_of
from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.runs.ownership import in_use
from vd4rl_pomdp.sweeps.driver import Driver
from vd4rl_pomdp.sweeps.executors import ray as module
from vd4rl_pomdp.sweeps.executors.ray import RayExecutor, RayOptions
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.work import DONE, INTERRUPTED, KILLED, Ended, Work

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
def options(cluster, monkeypatch) -> RayOptions:
    monkeypatch.setattr(module, "NODES_S", 0.0)
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
        RayExecutor(RayOptions(address=address))


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


def test_jobs_share_gpus_and_a_cancelled_one_ends_in_peace(options, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    assert (RayExecutor(options).slots, RayExecutor(options).largest) == (4, 2)
    assert RayExecutor(replace(options, jobs=1)).largest == 1, "no job may wait for more than there will ever be"
    assert signal.getsignal(signal.SIGTERM) is before
    executor = RayExecutor(replace(options, cpus=0.5, gpus=0.25))
    assert (executor.slots, executor.largest) == (4, 4)
    small, large, waiting = (waiting_job(tmp_path, name) for name in ("small", "large", "waiting"))
    executor.start(work_of(small))
    executor.start(work_of(large, 3))
    assert not executor.fits(1)
    until(lambda: begun(small) and begun(large))  # before the third, which Ray might else place ahead of the large one
    executor.start(work_of(waiting))  # which Ray keeps until there is room
    (seen,) = begun(small)
    assert (seen["CUDA_VISIBLE_DEVICES"], seen["OMP_NUM_THREADS"], seen["cwd"]) == ("0", "1", os.getcwd())
    (small.folder / "go").touch()
    assert [(ended.name, ended.cause) for ended in run(executor, 1)] == [("small", DONE)]
    until(lambda: begun(waiting))
    executor.stop()
    assert {(ended.name, ended.cause) for ended in run(executor, 2)} == {
        ("large", INTERRUPTED),
        ("waiting", INTERRUPTED),
    }
    assert "terminated" in work_of(large).log.read_text()


def test_a_job_that_cannot_be_found_is_refused_and_a_task_that_fails_has_failed(options, tmp_path, monkeypatch):
    executor = RayExecutor(options)
    executor.start(Work("none", ("pretrain", "--method", "none"), tmp_path / "none.log"))
    (ended,) = run(executor, 1)
    assert (ended.cause, "unknown method 'none'" in ended.line) == ("refused", True)
    monkeypatch.setattr(os, "getcwd", lambda: "/nowhere")
    executor.start(Work("lost", ("list",), tmp_path / "lost.log"))
    (ended,) = run(executor, 1)
    assert (ended.cause, "use a disk that all nodes share" in ended.line) == ("refused", True)


def test_a_cluster_without_room_for_a_job_is_refused(options):
    with pytest.raises(UserError, match="no node of the Ray cluster has 1 CPUs and 2 GPUs"):
        RayExecutor(replace(options, gpus=2))
    assert RayExecutor(replace(options, gpus=2, jobs=3)).slots == 3
    with pytest.raises(UserError, match="whole number"):
        RayOptions(gpus=1.5).check()


def test_without_ray_one_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"needs Ray: pip install '\.\[ray\]' in a clone"):
        RayExecutor(RayOptions())


def test_all_is_finished_although_a_node_dies(cluster, options, tmp_path):
    """The last test, since the node does not come back."""
    jobs = [waiting_job(tmp_path, f"job{number}") for number in range(4)]
    executor = RayExecutor(options)
    ended, nodes, history = executor.ended, list(cluster.worker_nodes), SweepFolder(tmp_path)

    def interfere() -> list[Ended]:
        """Kill a node while all jobs run, and let them end once it is known which of them that killed."""
        if nodes and all(begun(job) for job in jobs):
            cluster.remove_node(nodes.pop(), allow_graceful=False)
        killed = history.attempts()
        if killed and not any(in_use(tmp_path / name) for name in killed):
            (tmp_path / "go").touch()
        return ended()

    executor.ended = interfere
    assert Driver(jobs, executor, history).run()
    assert nodes == []
    causes = {name: [row["cause"] for row in rows] for name, rows in history.attempts().items()}
    assert sorted(told[0] for told in causes.values()) == [DONE, DONE, KILLED, KILLED]
    assert {told[-1] for told in causes.values()} == {DONE}  # "in use" between, where the killed were slow to go
