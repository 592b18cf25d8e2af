"""Sweeps on a local Slurm and Ray finish despite cancelled tasks and failing nodes."""

import os
import socket
import subprocess
import sys
from contextlib import contextmanager
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_sweeps import RECORD, begun, job, keep_plan, policy, until
from tests.sweeps.slurm_cluster import slurm, why_not
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.sweeps import clusters
from vd4rl_pomdp.sweeps.clusters import ClusterTask, RayCluster, SlurmCluster, parameters, watch
from vd4rl_pomdp.sweeps.folder import SweepFolder, is_finished
from vd4rl_pomdp.sweeps.options import LocalOptions, RayOptions, SlurmOptions

FAKES = {"squeue": "echo RUNNING; echo PENDING", "sbatch": "echo Submitted batch job 7", "scancel": ":", "srun": ":"}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(clusters, "LOOK_S", 1.0)


def retry(*words):
    """`sweep retry` in a fork, which need not import the package again."""
    process = get_context("fork").Process(target=main, args=(["sweep", "retry", *map(str, words)],))
    process.start()
    return process


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_slurm_sweep_finishes_after_a_cancelled_task(tmp_path, monkeypatch):
    with slurm(tmp_path) as configuration:
        monkeypatch.setenv("SLURM_CONF", str(configuration))
        monkeypatch.setenv("PYTHONPATH", os.getcwd())
        out = tmp_path / "out"
        jobs = [job(out, name, ends=("wait",) * 3) for name in "abc"]
        keep_plan(out, *jobs)
        words = "--executor slurm --gpus 0 --cpus 2 --tasks 4 --time 30 --jobs-per-task 2"
        process = retry(out, *words.split())
        until(lambda: all(map(begun, jobs)))
        squeue = ["squeue", "--array", "--noheader", "--format=%i"]
        tasks = subprocess.run(squeue, capture_output=True, text=True, check=True).stdout.split()
        assert len(tasks) == 2
        subprocess.run(["scancel", tasks[0]], check=True)
        until(lambda: sum(len(begun(one)) for one in jobs) > 3)
        (out / "go").touch()
        process.join(60)
        assert process.exitcode == 0
        assert all(map(is_finished, jobs))


@pytest.fixture
def fakes(tmp_path, monkeypatch):
    """Slurm's commands as scripts that log their calls."""
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


def test_slurm_errors_timeouts_and_stop(fakes, tmp_path, monkeypatch, capsys):
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
    with pytest.raises(UnavailableError, match=r"squeue says \(no host no server\)"):
        fakes(squeue=r"printf 'no host\nno server\n' >&2; exit 1").live()
    fakes(squeue=":").stop()
    lines = [line.split()[-1] for line in (tmp_path / "called").read_text().splitlines() if line.startswith("scancel")]
    assert lines == ["--state=PENDING", "--signal=USR2", "--quiet"]
    monkeypatch.setattr(clusters, "ANSWER_S", 0.5)
    cluster = fakes(squeue="exec sleep 60", scancel="exec sleep 60")
    with pytest.raises(UnavailableError, match=r"Slurm does not answer: squeue has not ended after 0\.5 s"):
        cluster.live()
    cluster.stop()
    assert "tasks may still be running: scancel --me --name=" in capsys.readouterr().err


@pytest.mark.parametrize(("gpus", "shown"), [(0, ""), (1, "3")])
def test_task_without_gpus_uses_none(tmp_path, monkeypatch, gpus, shown):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    monkeypatch.chdir(tmp_path)
    seen = []
    helper = SimpleNamespace(run=lambda: seen.append(os.environ["CUDA_VISIBLE_DEVICES"]))
    monkeypatch.setattr(clusters, "Driver", lambda *_, **__: helper)
    monkeypatch.setattr(SweepFolder, "plans_to_do", lambda *_: [])
    ClusterTask(tmp_path, "", LocalOptions(), str(tmp_path), gpus)()
    assert seen == [shown]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    monkeypatch.setenv("SLURM_JOB_GPUS", "3")
    ClusterTask(tmp_path, "", LocalOptions(), str(tmp_path), gpus)()
    assert seen == [shown, "3"], "granted by --sbatch gres"


def test_slurm_options_map_to_submitit_parameters():
    asked = SlurmOptions("gpu", "lab", "high", "a100", 90, 2, 16, 62.5, 8, 50, ["--exclusive", "reservation=mine"])
    found = {name.removeprefix("slurm_"): value for name, value in parameters(asked).items()}
    names = ("partition", "account", "qos", "constraint", "time", "mem", "gpus_per_node", "cpus_per_task")
    assert [found[name] for name in names] == ["gpu", "lab", "high", "a100", 90, "64000M", 2, 16]
    assert found["srun_args"] == ["--cpus-per-task=16"]
    assert found["additional_parameters"] == {"requeue": True, "exclusive": True, "reservation": "mine"}
    assert found["signal_delay_s"] > 120, "time to save a checkpoint"
    assert (
        not {f"slurm_{name}" for name in (*names[:4], "mem", "gpus_per_node")} & parameters(SlurmOptions(gpus=0)).keys()
    )


@pytest.mark.parametrize(("executor", "missing", "message"), [
    ("slurm", "submitit", "needs submitit: pip install '.[slurm]' in a clone of vd4rl-pomdp"),
    ("ray", "ray", "needs Ray: pip install '.[ray]' in a clone of vd4rl-pomdp"),
])  # fmt: skip
def test_missing_extra_is_reported(tmp_path, monkeypatch, executor, missing, message):
    keep_plan(tmp_path, job(tmp_path, "one"))
    monkeypatch.setitem(sys.modules, missing, None)
    line = rejection(["sweep", "retry", str(tmp_path), "--executor", executor])
    assert line == f"error: --executor {executor} {message}"


def test_missing_slurm_commands_are_reported(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="--executor slurm finds no sbatch here"):
        SlurmCluster(SlurmOptions(), tmp_path)


REJECTING = """n=$(grep -c ^sbatch {called}); [ $n = 1 ] && echo Submitted batch job 7 && exit
[ $n = 3 ] && for job in {out}/?; do echo '{{}}' > $job/timing.json; done
echo Unable to contact slurm controller >&2; exit 1"""


def test_rejected_resubmission_is_retried_and_running_tasks_continue(fakes, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clusters, "LOOK_S", 0.0)
    jobs = [job(tmp_path / "out", name) for name in "ab"]
    plan = keep_plan(tmp_path / "out", *jobs)
    for one in jobs:
        write_json(one.folder / "config.json", RECORD)
    called = tmp_path / "called"
    cluster = fakes(sbatch=REJECTING.format(called=called, out=tmp_path / "out"), squeue="echo RUNNING")
    assert watch([plan], cluster, SweepFolder(tmp_path / "out"), "plan")
    assert capsys.readouterr().err.count("Unable to contact slurm controller); trying again") == 2
    assert "scancel" not in called.read_text()
    cluster = fakes(
        sbatch="[ -e {0} ] && exit 1; echo > {0}; echo Submitted batch job 7".format(tmp_path / "once"), squeue=":"
    )
    (jobs[0].folder / "timing.json").unlink()
    with pytest.raises(UserError, match="Slurm rejected the job array"):
        watch([plan], cluster, SweepFolder(tmp_path / "out"), "plan")


def test_slurm_sweeps_of_different_plans_have_different_tasks(fakes, tmp_path):
    fakes()
    names = set()
    for plan in ("grid", "grid", "other"):
        SlurmCluster(SlurmOptions(), tmp_path / "slurm", plan).live()
        names.add((tmp_path / "called").read_text().splitlines()[-1])
    assert len(names) == 2


class IdleCluster:
    """A cluster whose tasks end before they start a job; its second answer is an error."""

    folder, tasks, gpus = Path("tasks"), 2, 0

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


def test_idle_cluster_ends_sweep_and_unavailable_one_is_retried(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clusters, "LOOK_S", 0.0)
    plan, cluster = keep_plan(tmp_path, *(job(tmp_path, name) for name in "abc")), IdleCluster()
    with pytest.raises(UserError, match="tasks end before they start a job: see tasks"):
        watch([plan], cluster, SweepFolder(tmp_path), "plan")
    assert cluster.asked == [2] * 3, "limited by the number of tasks"
    assert cluster.stopped
    assert capsys.readouterr().err == "warning: it does not answer; trying again\n"


def test_one_task_is_requested_per_stack(fakes, tmp_path, monkeypatch):
    monkeypatch.setattr(clusters, "LOOK_S", 0.0)
    plan, cluster = keep_plan(tmp_path, *(policy(tmp_path, name) for name in "abc")), IdleCluster(stack=3)
    with pytest.raises(UserError, match="tasks end before they start a job"):
        watch([plan], cluster, SweepFolder(tmp_path), "plan")
    assert cluster.asked == [1] * 3
    assert fakes(stack=5).local == LocalOptions(1, 1, threads=SlurmOptions().cpus, stack=5)


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


@contextmanager
def killed_at_the_end(command, **run):
    """A subprocess that a failed test does not wait for."""
    with subprocess.Popen(command, **run) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_ray_sweep_finishes_after_node_failure_and_driver_stop(tmp_path):
    """Cluster and drivers are subprocesses, since a process that has used Ray cannot be forked."""
    unset = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}
    ray = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "PYTHONPATH": os.getcwd()}
    run = {"env": unset | ray, "stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    jobs = [job(tmp_path / "out", name, ends=("wait",) * 4) for name in "ab"]
    keep_plan(tmp_path / "out", *jobs)
    with subprocess.Popen([sys.executable, "-c", RAY], **run) as cluster:
        try:
            address = next(line for line in cluster.stdout if line.startswith(("127.", "10.", "172.", "192."))).strip()
            words = f"sweep retry {tmp_path / 'out'} --executor ray --address {address} --cpus 1 --gpus 0"
            command = [sys.executable, "-c", DRIVER, *words.split()]
            with killed_at_the_end(command, **run) as driver:
                until(lambda: all(map(begun, jobs)))
                assert begun(jobs[0])[0]["OMP_NUM_THREADS"] == "1"
                driver.terminate()
                assert driver.wait(60) == 143
            with killed_at_the_end(command, **run) as driver:
                until(lambda: all(len(begun(one)) == 2 for one in jobs))
                print(file=cluster.stdin, flush=True)
                (tmp_path / "out" / "go").touch()
                assert driver.wait(120) == 0
            assert all(map(is_finished, jobs))
        finally:
            (tmp_path / "out" / "go").touch()
            cluster.communicate("\n", timeout=60)


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_unreachable_ray_cluster_is_reported(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(
        UserError, match=f"no Ray cluster at --address 127.0.0.1:{port} .*Connection refused.*ray start"
    ):
        RayCluster(RayOptions(address=f"127.0.0.1:{port}"), tmp_path)


@pytest.mark.parametrize(("options", "message"), [
    (SlurmOptions(gpus=4), "--gpus 4 is more than --jobs-per-task 1, and a job uses one GPU"),
    (RayOptions(gpus=2), "--gpus is 2; it must be at least 0 and at most 1"),
])  # fmt: skip
def test_gpus_that_no_job_uses_are_rejected(options, message):
    with pytest.raises(UserError, match=message):
        options.check()
