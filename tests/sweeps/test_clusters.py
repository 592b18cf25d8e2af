"""Sweeps on a Slurm and a Ray of this machine: all is finished although tasks are cancelled and nodes die."""

import os
import socket
import subprocess
import sys
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

import pytest

from tests.helpers_sweeps import begun, job, keep_plan, policy, until
from tests.sweeps.slurm_cluster import slurm, why_not
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.sweeps import clusters
from vd4rl_pomdp.sweeps.clusters import ClusterTask, RayCluster, SlurmCluster, parameters, watch
from vd4rl_pomdp.sweeps.folder import SweepFolder, is_finished
from vd4rl_pomdp.sweeps.options import LocalOptions, RayOptions, SlurmOptions

FAKES = {"squeue": "echo RUNNING; echo PENDING", "sbatch": "echo Submitted batch job 7", "scancel": ":", "srun": ":"}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(clusters, "LOOK_S", 1.0)


def retry(*words):
    """`sweep retry` in a process of its own, which need not import what this one has."""
    process = get_context("fork").Process(target=main, args=(["sweep", "retry", *map(str, words)],))
    process.start()
    return process


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_a_sweep_under_slurm_is_finished_although_a_task_is_cancelled(tmp_path, monkeypatch):
    with slurm(tmp_path) as configuration:
        monkeypatch.setenv("SLURM_CONF", str(configuration))
        monkeypatch.setenv("PYTHONPATH", os.getcwd())
        out = tmp_path / "out"
        jobs = [job(out, name, ends=("wait",) * 3) for name in "abc"]
        keep_plan(out, *jobs)
        words = "--executor slurm --gpus 0 --cpus 2 --tasks 4 --time 30 --jobs-per-task 2"
        process = retry(out, *words.split())
        until(lambda: all(map(begun, jobs)))
        told = ["squeue", "--array", "--noheader", "--format=%i"]
        tasks = subprocess.run(told, capture_output=True, text=True, check=True).stdout.split()
        assert len(tasks) == 2
        subprocess.run(["scancel", tasks[0]], check=True)
        until(lambda: sum(len(begun(one)) for one in jobs) > 3)
        (out / "go").touch()
        process.join(60)
        assert process.exitcode == 0
        assert all(map(is_finished, jobs))


@pytest.fixture
def fakes(tmp_path, monkeypatch):
    """Slurm's commands as scripts, which note how they are called."""
    pytest.importorskip("submitit")

    def write(stack: int = 1, **scripts: str) -> SlurmCluster:
        for name, text in (FAKES | scripts).items():
            script = tmp_path / "bin" / name
            script.parent.mkdir(exist_ok=True)
            script.write_text(f"#!/bin/sh\necho {name} $* >> {tmp_path}/called\n{text}\n")
            script.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
        return SlurmCluster(SlurmOptions(stack=stack), tmp_path / "slurm")

    return write


def test_what_slurm_refuses_or_does_not_answer_is_one_line_and_stopping_asks_before_it_ends(
    fakes, tmp_path, monkeypatch, capsys
):
    task = ClusterTask(tmp_path, "", LocalOptions(), str(tmp_path))
    cluster = fakes(sbatch="echo invalid partition >&2; exit 1")
    with pytest.raises(UserError, match=r"Slurm rejected the job array .*invalid partition"):
        cluster.submit(task, 2)
    cluster = fakes()
    cluster.submit(task, 3)
    assert cluster.live() == 2
    text = "".join(script.read_text() for script in (tmp_path / "slurm").glob("*.sh"))
    assert f"--job-name={cluster._name}\n" in text
    assert "--array=0-2%3\n" in text
    fakes(squeue=":").stop()
    lines = [line.split()[-1] for line in (tmp_path / "called").read_text().splitlines() if line.startswith("scancel")]
    assert lines == ["--state=PENDING", "--signal=USR2", "--quiet"]
    monkeypatch.setattr(clusters, "ANSWER_S", 0.5)
    cluster = fakes(squeue="exec sleep 60", scancel="exec sleep 60")
    with pytest.raises(UnavailableError, match=r"Slurm does not answer: squeue has not ended after 0\.5 s"):
        cluster.live()
    cluster.stop()
    assert "tasks may still be running: scancel --me --name=" in capsys.readouterr().err


def test_slurms_options_become_what_submitit_takes():
    asked = SlurmOptions("gpu", "lab", "high", "a100", 90, 2, 16, 62.5, 8, 50, ["--exclusive", "reservation=mine"])
    found = {name.removeprefix("slurm_"): value for name, value in parameters(asked).items()}
    names = ("partition", "account", "qos", "constraint", "time", "mem", "gpus_per_node", "cpus_per_task")
    assert [found[name] for name in names] == ["gpu", "lab", "high", "a100", 90, "64000M", 2, 16]
    assert found["srun_args"] == ["--cpus-per-task=16"]
    assert found["additional_parameters"] == {"requeue": True, "exclusive": True, "reservation": "mine"}
    assert found["signal_delay_s"] > 120, "time to end in"
    assert (
        not {f"slurm_{name}" for name in (*names[:4], "mem", "gpus_per_node")} & parameters(SlurmOptions(gpus=0)).keys()
    )


@pytest.mark.parametrize(("executor", "missing", "told"), [
    ("slurm", "submitit", "needs submitit: pip install '.[slurm]' in a clone of vd4rl-pomdp"),
    ("ray", "ray", "needs Ray: pip install '.[ray]' in a clone of vd4rl-pomdp"),
])  # fmt: skip
def test_a_missing_extra_is_one_line(tmp_path, monkeypatch, capsys, executor, missing, told):
    keep_plan(tmp_path, job(tmp_path, "one"))
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(SystemExit, match="2"):
        main(["sweep", "retry", str(tmp_path), "--executor", executor])
    assert capsys.readouterr().err == f"error: --executor {executor} {told}\n"


def test_without_slurms_commands_one_is_told_where_to_start(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="--executor slurm finds no sbatch here"):
        SlurmCluster(SlurmOptions(), tmp_path)


class Vain:
    """A cluster whose tasks end before they start a job, after one look at which it does not answer."""

    folder, tasks = Path("tasks"), 2

    def __init__(self, stack=1):
        self.local = LocalOptions(jobs=1, stack=stack)
        self.asked, self.answers, self.stopped = [], iter([None, UnavailableError("it does not answer")]), False

    def live(self):
        if error := next(self.answers, None):
            raise error
        return 0

    def submit(self, task, number):
        self.asked.append(number)

    def stop(self):
        self.stopped = True


def test_a_cluster_that_does_nothing_ends_the_sweep_and_one_that_falls_silent_is_asked_again(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(clusters, "LOOK_S", 0.0)
    plan, cluster = keep_plan(tmp_path, *(job(tmp_path, name) for name in "abc")), Vain()
    with pytest.raises(UserError, match="tasks end before they start a job: see tasks"):
        watch([plan], cluster, SweepFolder(tmp_path), "plan")
    assert cluster.asked == [2] * 3, "as many as the jobs need, and no more than it may have"
    assert cluster.stopped
    assert capsys.readouterr().err == "warning: it does not answer; trying again\n"


def test_a_task_is_asked_for_a_stack(fakes, tmp_path, monkeypatch):
    monkeypatch.setattr(clusters, "LOOK_S", 0.0)
    plan, cluster = keep_plan(tmp_path, *(policy(tmp_path, name) for name in "abc")), Vain(stack=3)
    with pytest.raises(UserError, match="tasks end before they start a job"):
        watch([plan], cluster, SweepFolder(tmp_path), "plan")
    assert cluster.asked == [1] * 3
    assert fakes(stack=5).local == LocalOptions(1, 1, stack=5)


RAY = """
from ray.cluster_utils import Cluster
node = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
cluster = Cluster(initialize_head=True, head_node_args=node)
try:
    cluster.add_node(**node)
    print(cluster.address, flush=True)
    input()
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    input()
finally:
    cluster.shutdown()
"""
DRIVER = "from vd4rl_pomdp.sweeps import clusters; clusters.LOOK_S = 1.0; from vd4rl_pomdp.cli import main; main()"


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_a_sweep_on_ray_is_finished_although_a_node_dies_and_a_driver_is_stopped(tmp_path):
    """Each in a process of its own: one that has used Ray cannot be forked."""
    unset = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}
    told = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "PYTHONPATH": os.getcwd()}
    run = {"env": unset | told, "stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    jobs = [job(tmp_path / "out", name, ends=("wait",) * 4) for name in "ab"]
    keep_plan(tmp_path / "out", *jobs)
    with subprocess.Popen([sys.executable, "-c", RAY], **run) as cluster:
        try:
            address = next(line for line in cluster.stdout if line.startswith(("127.", "10.", "172.", "192."))).strip()
            words = f"sweep retry {tmp_path / 'out'} --executor ray --address {address} --cpus 1 --gpus 0"
            command = [sys.executable, "-c", DRIVER, *words.split()]
            with subprocess.Popen(command, **run) as driver:
                until(lambda: all(map(begun, jobs)))
                assert begun(jobs[0])[0]["OMP_NUM_THREADS"] == "1"
                driver.terminate()
                assert driver.wait(60) == 143
            with subprocess.Popen(command, **run) as driver:
                until(lambda: all(len(begun(one)) == 2 for one in jobs))
                print(file=cluster.stdin, flush=True)
                (tmp_path / "out" / "go").touch()
                assert driver.wait(120) == 0
            assert all(map(is_finished, jobs))
        finally:
            cluster.communicate("\n", timeout=60)


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_a_ray_that_is_not_there_is_one_line(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(
        UserError, match=f"no Ray cluster at --address 127.0.0.1:{port} .*Connection refused.*ray start"
    ):
        RayCluster(RayOptions(address=f"127.0.0.1:{port}"), tmp_path)
    with pytest.raises(UserError, match="whole number"):
        RayOptions(gpus=1.5).check()
