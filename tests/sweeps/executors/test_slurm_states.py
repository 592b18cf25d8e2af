"""What the Slurm executor makes of the queue's words, and what it asks for, without Slurm."""

import errno
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import OutOfMemoryError, UnavailableError, UserError
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.executors import slurm as module
from vd4rl_pomdp.sweeps.executors import slurm_queue
from vd4rl_pomdp.sweeps.executors.allocation import Allocation
from vd4rl_pomdp.sweeps.executors.handover import Handover
from vd4rl_pomdp.sweeps.executors.slurm import SlurmExecutor
from vd4rl_pomdp.sweeps.executors.slurm_queue import SlurmOptions, TaskState, parameters
from vd4rl_pomdp.sweeps.work import DONE, FAILED, INTERRUPTED, KILLED, Ended, Work

GRID = 'preset = "smoke"\n[collect]\ntask = "walker_walk"\nquality = "expert"\n'


class FakeSlurm:
    """A queue, and what was submitted."""

    def __init__(self, monkeypatch) -> None:
        self.queue, self.arrays = {}, []
        monkeypatch.setattr(module, "require_slurm", lambda: None)
        monkeypatch.setattr(module, "read_queue", lambda: self.queue)
        monkeypatch.setattr(module, "submit", self._submit)
        monkeypatch.setattr(module, "FILES_S", 0.0)
        monkeypatch.setattr(module, "QUEUE_S", 0.0)

    def _submit(self, folder, tasks, options) -> None:
        self.arrays.append([[work.name for work in Handover(folder).left(task.number).values()] for task in tasks])
        self.queue |= {
            (folder.name, task.number): TaskState("PENDING", f"7_{task.number}", "Priority") for task in tasks
        }

    def put(self, name: str, reason: str = "None") -> None:
        self.queue = {key: TaskState(name, state.job, reason) for key, state in self.queue.items()}


@pytest.fixture
def fake(monkeypatch) -> FakeSlurm:
    return FakeSlurm(monkeypatch)


def work(tmp_path, name: str, slots: int = 1, words: tuple[str, ...] = ("list",)) -> Work:
    return Work(name, words, tmp_path / "logs" / f"{name}.log", slots)


def executor(tmp_path, **changes) -> SlurmExecutor:
    return SlurmExecutor(SlurmOptions(**changes), tmp_path / "slurm")


@pytest.mark.parametrize(
    ("state", "cause"),
    [
        *[("OUT_OF_MEMORY", OutOfMemoryError.cause), ("PREEMPTED", KILLED), ("NODE_FAIL", KILLED), ("TIMEOUT", KILLED)],
        *[("CANCELLED", KILLED), ("BOOT_FAIL", KILLED), ("DEADLINE", KILLED), ("COMPLETED", INTERRUPTED)],
    ],
)
def test_a_task_that_ended_without_telling_says_why_by_its_state(fake, tmp_path, state, cause):
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    for waiting in ("PENDING", "RUNNING", "COMPLETING", "REQUEUED"):
        assert made.ended() == []
        fake.put(waiting)
    fake.put(state)
    assert made.ended() == [Ended("job", cause, f"Slurm says {state} of task 7_0")]
    assert made.ended() == []


def test_a_task_that_failed_is_told_by_its_last_line_and_one_that_slurm_forgot_was_killed(fake, tmp_path):
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    made._tasks[0].array.folder.joinpath("7_0_0_log.out").write_text("Traceback\nImportError: no torch\n")
    fake.put("FAILED")
    assert made.ended() == [Ended("job", FAILED, "ImportError: no torch")]
    made.start(work(tmp_path, "job"))
    made.ended()
    fake.queue = {}
    assert [ended.cause for ended in made.ended()] == [KILLED]


def test_what_was_told_counts_although_the_task_has_died_since(fake, tmp_path):
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    (task,) = made._tasks
    task.array.end(task.mine["job"], Ended("job", DONE, ""))
    fake.put("NODE_FAIL")
    assert made.ended() == [Ended("job", DONE, "")]


def test_while_slurm_does_not_answer_nothing_has_ended(fake, tmp_path):
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    fake.queue = None
    assert made.ended() == []
    with pytest.raises(UserError, match="Slurm does not answer"):
        executor(tmp_path)


def test_jobs_fill_the_places_of_tasks_and_one_that_needs_more_memory_takes_more_of_them(fake, tmp_path):
    assert executor(tmp_path, jobs_per_task=4, gpus=2).largest == 2, "of one GPU's memory"
    made = executor(tmp_path, jobs_per_task=4, tasks=2)
    assert (made.slots, made.largest) == (8, 4)
    for name, slots in {"a": 1, "b": 1, "large": 2, "c": 1}.items():
        assert made.fits(slots)
        made.start(work(tmp_path, name, slots))
    made.ended()
    assert fake.arrays == [[["a", "b", "large"], ["c"]]]
    made.start(work(tmp_path, "d"))
    made.ended()
    assert len(fake.arrays) == 1
    assert (made.fits(2), made.fits(3)) == (True, False)


def test_a_new_driver_takes_over_what_is_in_the_queue_but_no_other_command_of_that_name(fake, tmp_path):
    executor(tmp_path).start(work(tmp_path, "never submitted"))
    first = executor(tmp_path)
    first.start(work(tmp_path, "job"))
    first.ended()
    second = executor(tmp_path)
    second.start(work(tmp_path, "job"))
    second.ended()
    assert len(fake.arrays) == 1
    (task,) = first._tasks
    task.array.end(task.mine["job"], Ended("job", DONE, ""))
    assert second.ended() == [Ended("job", DONE, "")]
    first.ended()
    third = executor(tmp_path, tasks=1)
    third.start(work(tmp_path, "job", words=("list", "--json")))
    third.start(work(tmp_path, "never submitted"))
    third.ended()
    assert len(third._tasks[0].array.left(0)) == 2, "a task that is there is used"


def test_what_was_stopped_while_it_waited_was_not_killed(fake, tmp_path, monkeypatch):
    def cancel(jobs, *options):
        if "--state=PENDING" in options:
            fake.put("CANCELLED")

    monkeypatch.setattr(module, "cancel", cancel)
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    made.stop()
    assert [ended.cause for ended in made.ended()] == [INTERRUPTED]


def test_a_queue_that_does_not_answer_while_all_is_stopped_ends_no_patience(fake, tmp_path, monkeypatch):
    told, answers = [], [None, None, None, "RUNNING", None, "COMPLETED"]

    def read_queue():
        answer = answers.pop(0) if answers else "COMPLETED"
        return None if answer is None else {key: TaskState(answer, "7_0", "") for key in fake.queue}

    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    monkeypatch.setattr(module, "read_queue", read_queue)
    monkeypatch.setattr(module, "cancel", lambda jobs, *options: told.append((jobs, *options)))
    made.stop()
    assert told == [(["7_0"], "--state=PENDING"), (["7_0"], "--signal=TERM"), ([],)]


def test_what_a_task_may_wait_for_in_vain_is_told_once(fake, tmp_path, capsys):
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    assert capsys.readouterr().err == ""
    fake.put("PENDING", "PartitionTimeLimit")
    made.ended()
    made.ended()
    assert capsys.readouterr().err == "warning: Slurm keeps task 7_0 waiting: PartitionTimeLimit\n"


def test_options_become_what_submitit_takes():
    asked = SlurmOptions("gpu", "lab", "high", "a100", 90, 2, 16, 62.5, 8, 50, ["--exclusive", "reservation=mine"])
    found = parameters(asked)
    assert {name: found[name] for name in ("partition", "account", "qos", "constraint", "time", "mem")} == {
        **{"partition": "gpu", "account": "lab", "qos": "high", "constraint": "a100", "time": 90, "mem": "64000M"}
    }
    assert (found["gpus_per_node"], found["cpus_per_task"], found["srun_args"]) == (2, 16, ["--cpus-per-task=16"])
    assert found["additional_parameters"] == {"requeue": True, "exclusive": True, "reservation": "mine"}
    assert found["signal_delay_s"] > 120, "time to end in"
    assert (
        not {"partition", "account", "qos", "constraint", "mem", "gpus_per_node"}
        & parameters(SlurmOptions(gpus=0)).keys()
    )


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
        executor(tmp_path)


def test_the_package_loads_neither_submitit_nor_ray():
    import subprocess

    script = "import sys, vd4rl_pomdp.sweeps.executors as e; print({'submitit', 'ray', 'torch'} & sys.modules.keys())"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout == "set()\n"


def test_a_disk_that_is_full_at_a_submission_is_waited_for(fake, tmp_path, monkeypatch, capsys):
    """submitit writes a file for each task: nothing is in the queue then, and it is no refusal of Slurm's."""
    full, submit = [True], module.submit

    class Full:
        def __init__(self, folder, **options):
            self.folder = folder

        def update_parameters(self, **options): ...

        def submit_array(self, tasks):
            if full:
                raise OSError(errno.ENOSPC, "No space left on device")
            submit(self.folder, tasks, None)

    monkeypatch.setitem(sys.modules, "submitit", SimpleNamespace(SlurmExecutor=Full))
    monkeypatch.setattr(module, "submit", slurm_queue.submit)
    monkeypatch.setattr(module, "AGAIN_S", 0.0)
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    assert made.ended() == []
    assert "the disk is full" in capsys.readouterr().err
    full.clear()
    made.ended()
    assert fake.arrays == [[["job"]]]


def test_a_signal_during_a_submission_waits_until_the_array_is_known(fake, tmp_path, monkeypatch):
    submit = module.submit

    def submitted(folder, tasks, options):
        submit(folder, tasks, options)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(module, "submit", submitted)
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    with interrupt.handled(), pytest.raises(interrupt.Interrupted):
        made.ended()
    assert [task.key for task in made._tasks] == list(fake.queue)
    assert made._live() == ["7_0"], "what stopping takes out of the queue"


@pytest.fixture
def hanging(tmp_path, monkeypatch) -> Path:
    """Slurm's commands, none of which ever ends; each leaves the number of its process here."""
    for name in ("squeue", "sbatch", "scancel", "srun"):
        script = tmp_path / "bin" / name
        script.parent.mkdir(exist_ok=True)
        script.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/{name}.pid\nexec sleep 600\n")
        script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setattr(slurm_queue, "ANSWER_S", 2.0)
    return tmp_path


def test_commands_of_slurm_that_never_end_are_not_waited_for(hanging):
    pytest.importorskip("submitit")
    with pytest.raises(UnavailableError, match="Slurm does not answer: see what squeue says"):
        executor(hanging)
    with pytest.raises(UnavailableError, match="Slurm does not answer: scancel has not ended after 2 s"):
        slurm_queue.cancel(["7_0"])
    alarm = signal.getsignal(signal.SIGALRM)
    tasks = [Allocation(hanging / "array", number, 1) for number in range(2)]
    for count in (1, 2):  # which submitit submits in two ways
        with pytest.raises(UnavailableError, match="Slurm does not answer: sbatch has not ended after 2 s"):
            slurm_queue.submit(hanging / "array", tasks[:count], SlurmOptions())
    assert signal.getsignal(signal.SIGALRM) is alarm
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    for number in hanging.glob("*.pid"):
        with pytest.raises(ProcessLookupError):  # it was killed
            os.kill(int(number.read_text()), 0)


def test_an_array_that_slurm_may_have_taken_is_submitted_by_another_name(fake, tmp_path, monkeypatch, capsys):
    submit, names = module.submit, []

    def unanswered(folder, tasks, options):
        names.append(folder.name)
        raise UnavailableError("Slurm does not answer: sbatch has not ended")

    monkeypatch.setattr(module, "submit", unanswered)
    monkeypatch.setattr(module, "AGAIN_S", 0.0)
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    assert made.ended() == []
    assert "warning: Slurm does not answer: sbatch has not ended; trying again" in capsys.readouterr().err
    monkeypatch.setattr(module, "submit", submit)
    made.ended()
    assert fake.arrays == [[["job"]]], "with its jobs"
    ((name, _),) = fake.queue
    assert name not in names
    assert [path.name for path in (tmp_path / "slurm").iterdir()] == [name], "an array of the old name finds nothing"


def test_a_slurm_that_falls_silent_is_told_once_and_stopping_waits_for_it_no_longer(
    fake, tmp_path, monkeypatch, capsys
):
    made = executor(tmp_path)
    made.start(work(tmp_path, "job"))
    made.ended()
    monkeypatch.setattr(module, "read_queue", lambda: None)
    made.ended()
    made.ended()
    assert capsys.readouterr().err.count("warning: Slurm does not answer: see what squeue says") == 1

    def cancel(jobs, *options):
        raise UnavailableError("Slurm does not answer: scancel has not ended")

    monkeypatch.setattr(module, "cancel", cancel)
    made.stop()
    assert "scancel has not ended; see what squeue has of" in capsys.readouterr().err


def test_once_a_signal_asks_for_the_end_slurm_has_less_time(hanging, monkeypatch):
    monkeypatch.setattr(slurm_queue, "LAST_ANSWER_S", 0.5)
    monkeypatch.setattr(interrupt, "asked", lambda: True)
    with pytest.raises(UnavailableError, match=r"after 0\.5 s"):
        slurm_queue.cancel(["7_0"])


def test_how_an_arrays_jobs_ended_is_listed_once_a_look(fake, tmp_path, monkeypatch):
    looks, ended = [], Handover.ended
    made = executor(tmp_path, tasks=5)
    for name in "abcde":
        made.start(work(tmp_path, name))
    made.ended()
    monkeypatch.setattr(Handover, "ended", lambda array: looks.append(array) or ended(array))
    made.ended()
    assert len(looks) == 1
