"""What the Slurm executor asks for, and what it makes of commands that do not answer, without Slurm."""

import os
import signal
import sys
from pathlib import Path

import pytest

from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.executors import slurm as module
from vd4rl_pomdp.sweeps.executors.slurm import SlurmCluster, SlurmOptions, parameters
from vd4rl_pomdp.sweeps.work import ClusterTask, Work

GRID = 'preset = "smoke"\n[collect]\ntask = "walker_walk"\nquality = "expert"\n'
SCRIPTS = {
    "squeue": "echo RUNNING\\|None; echo PENDING\\|PartitionTimeLimit",
    "sbatch": "echo Submitted batch job 7",
    "scancel": ":",
    "srun": ":",
}
TASK = ClusterTask(Work("join", ("list",), Path("log")), "/")


@pytest.fixture
def commands(tmp_path, monkeypatch):
    """Slurm's commands as scripts, which note how they are called."""
    pytest.importorskip("submitit")

    def write(**scripts: str) -> Path:
        for name, text in (SCRIPTS | scripts).items():
            script = tmp_path / "bin" / name
            script.parent.mkdir(exist_ok=True)
            script.write_text(
                f"#!/bin/sh\necho $$ > {tmp_path}/{name}.pid\necho {name} $* >> {tmp_path}/called\n{text}\n"
            )
            script.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
        return tmp_path

    return write


def cluster(folder: Path, **options) -> SlurmCluster:
    return SlurmCluster(SlurmOptions(**options), folder / "slurm")


def test_options_become_what_submitit_takes():
    asked = SlurmOptions("gpu", "lab", "high", "a100", 90, 2, 16, 62.5, 8, 50, ["--exclusive", "reservation=mine"])
    found = {name.removeprefix("slurm_"): value for name, value in parameters(asked).items()}
    assert {name: found[name] for name in ("partition", "account", "qos", "constraint", "time", "mem")} == {
        **{"partition": "gpu", "account": "lab", "qos": "high", "constraint": "a100", "time": 90, "mem": "64000M"}
    }
    assert (found["gpus_per_node"], found["cpus_per_task"], found["srun_args"]) == (2, 16, ["--cpus-per-task=16"])
    assert found["additional_parameters"] == {"requeue": True, "exclusive": True, "reservation": "mine"}
    assert found["signal_delay_s"] > 120, "time to end in"
    assert not {"partition", "account", "qos", "constraint", "mem", "gpus_per_node"} & {
        name.removeprefix("slurm_") for name in parameters(SlurmOptions(gpus=0))
    }


@pytest.mark.parametrize(
    ("executor", "missing", "told"),
    [
        ("slurm", "submitit", "needs submitit: pip install '.[slurm]' in a clone of vd4rl-pomdp"),
        ("ray", "ray", "needs Ray: pip install '.[ray]' in a clone of vd4rl-pomdp"),
    ],
)
def test_a_missing_extra_is_one_line(tmp_path, monkeypatch, capsys, executor, missing, told):
    (tmp_path / "grid.toml").write_text(GRID)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(SystemExit) as end:
        main(["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path / "out"), "--executor", executor])
    assert end.value.code == 2
    assert capsys.readouterr().err == f"error: --executor {executor} {told}\n"


def test_without_slurms_commands_one_is_told_where_to_start(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="--executor slurm finds no sbatch here"):
        cluster(tmp_path)


def test_the_package_loads_neither_submitit_nor_ray():
    import subprocess

    script = "import sys, vd4rl_pomdp.sweeps.executors as e; print({'submitit', 'ray', 'torch'} & sys.modules.keys())"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout == "set()\n"


def test_tasks_are_known_by_the_name_of_their_folder(commands, capsys):
    folder = commands()
    made = cluster(folder)
    made.submit(TASK, 3)
    assert made.live() == 2
    assert made.live() == 2
    assert capsys.readouterr().err == "warning: Slurm keeps tasks waiting: PartitionTimeLimit\n", "once"
    text = "".join(script.read_text() for script in (folder / "slurm").glob("*.sh"))
    name = made._own[1].partition("=")[2]
    assert f"--job-name={name}\n" in text
    assert "--array=0-2%3\n" in text
    assert cluster(folder / "other")._own != cluster(folder)._own == made._own


def test_stopping_takes_waiting_tasks_back_and_asks_running_ones_to_end(commands):
    folder = commands(squeue=":")
    cluster(folder).stop()
    told = [line for line in (folder / "called").read_text().splitlines() if line.startswith("scancel")]
    assert [line.split()[-1].partition("=")[0] for line in told] == ["--state", "--signal", "--name"]


def test_an_array_that_slurm_refuses_is_one_line(commands):
    folder = commands(sbatch="echo invalid partition >&2; exit 1")
    with pytest.raises(UserError, match=r"Slurm took no array .*invalid partition"):
        cluster(folder).submit(TASK, 2)


def test_commands_of_slurm_that_never_end_are_not_waited_for(commands, monkeypatch, capsys):
    monkeypatch.setattr(module, "ANSWER_S", 2.0)
    folder = commands(**dict.fromkeys(("squeue", "sbatch", "scancel"), "exec sleep 600"))
    made = cluster(folder)
    with pytest.raises(UnavailableError, match="Slurm does not answer: squeue has not ended after 2 s"):
        made.live()
    made.stop()
    assert (
        "warning: Slurm does not answer: scancel has not ended after 2 s; tasks may be left" in capsys.readouterr().err
    )
    alarm = signal.getsignal(signal.SIGALRM)
    for count in (1, 2):  # which submitit submits in two ways
        with pytest.raises(UnavailableError, match="Slurm does not answer: sbatch has not ended after 2 s"):
            made.submit(TASK, count)
    assert signal.getsignal(signal.SIGALRM) is alarm
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    for number in folder.glob("*.pid"):
        with pytest.raises(ProcessLookupError):  # it was killed
            os.kill(int(number.read_text()), 0)


def test_once_a_signal_asks_for_the_end_slurm_has_less_time(commands, monkeypatch):
    monkeypatch.setattr(module, "LAST_ANSWER_S", 0.5)
    monkeypatch.setattr(interrupt, "asked", lambda: True)
    with pytest.raises(UnavailableError, match=r"after 0\.5 s"):
        cluster(commands(squeue="exec sleep 600")).live()
