"""Ctrl-C and SIGTERM: a checkpoint where possible, one line, the right exit code, and no process left."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers_data import write_fake_set
from tests.runs.test_workers import alive
from vd4rl_pomdp.runs import interrupt

SLOW_STEPS = """
import sys, time
from pretrain.train import Trainer
from vd4rl_pomdp.cli import main
update = Trainer.update
def slow(self):
    logs = update(self)
    if self.step == 3:
        print("in step 3", flush=True)
    time.sleep(0.2)
    return logs
Trainer.update = slow
if __name__ == "__main__":
    main(sys.argv[1:])
"""
SLOW_JOBS = """
import sys
from tests.runs.test_workers import print_pid_and_sleep
from vd4rl_pomdp.cli import main, stages
from vd4rl_pomdp.runs.workers import run_jobs
stages.list_parts = lambda words, program: list(run_jobs(print_pid_and_sleep, [0, 1], 2))
if __name__ == "__main__":
    main(["list"])
"""
HANGING = """
import sys, time
from vd4rl_pomdp.cli import main, stages
from vd4rl_pomdp.runs import interrupt
def hang(words, program):
    with interrupt.deferred():
        print("hanging", flush=True)
        time.sleep(60)
stages.list_parts = hang
main(["list"])
"""


def start(folder: Path, script: str, *words: object) -> subprocess.Popen:
    """Start a program in a new process group, as a terminal does."""
    file = folder / "program.py"
    file.write_text(script)
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    return subprocess.Popen(
        [sys.executable, file, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )


def stderr_lines(program: subprocess.Popen) -> list[str]:
    """Wait for a program and return its lines on stderr, without progress."""
    _, error = program.communicate(timeout=60)
    return [line for line in error.splitlines() if " steps  " not in line]


def test_sigint_saves_a_checkpoint_of_the_current_step(tmp_path):
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])
    words = ["pretrain", "--preset", "smoke", "--method", "acro", "--data", data, "--out", tmp_path / "run"]
    program = start(tmp_path, SLOW_STEPS, *words)
    assert program.stdout.readline() == "in step 3\n"
    program.send_signal(signal.SIGINT)
    kept = f"interrupted: {tmp_path / 'run'} keeps step 3; re-run the same command to resume"
    assert stderr_lines(program) == [kept]
    assert program.returncode == 130
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == ["3.pt"]
    assert not list((tmp_path / "run").glob(".*"))


def test_sigterm_during_worker_start_ends_all_processes(tmp_path):
    program = start(tmp_path, SLOW_JOBS)
    children = Path(f"/proc/{program.pid}/task/{program.pid}/children")
    if not children.exists():
        program.kill()
        pytest.skip("this system does not list children")
    while len(pids := children.read_text().split()) < 3:  # two workers and the resource tracker
        time.sleep(0.01)
    os.killpg(program.pid, signal.SIGTERM)  # as scancel and a terminal's Ctrl-C do
    assert stderr_lines(program) == ["terminated: re-run the same command to resume"]
    assert program.returncode == 143
    while any(alive(int(pid)) for pid in pids):  # the resource tracker ends once its caller is gone
        time.sleep(0.01)


def test_second_signal_ends_program_immediately(tmp_path):
    program = start(tmp_path, HANGING)
    assert program.stdout.readline() == "hanging\n"
    while program.poll() is None:
        program.send_signal(signal.SIGTERM)
        time.sleep(0.2)
    assert program.returncode == -signal.SIGTERM
    assert stderr_lines(program) == []


def test_signal_handlers_are_restored():
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    handlers = [signal.getsignal(number) for number in interrupt.SIGNALS]
    try:
        with pytest.raises(interrupt.Interrupted), interrupt.handled():
            signal.raise_signal(signal.SIGINT)
        for number in (signal.SIGTERM, signal.SIGHUP):
            with pytest.raises(interrupt.Terminated) as end, interrupt.handled():
                signal.raise_signal(number)
            assert end.value.code == 143
        assert [signal.getsignal(number) for number in interrupt.SIGNALS] == handlers
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup sets it
        with interrupt.handled():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_are_deferred_within_a_step():
    steps = []

    def in_a_step() -> None:
        with interrupt.handled(), interrupt.deferred():
            signal.raise_signal(signal.SIGINT)
            steps.append(1)
            interrupt.check("step 1")
            steps.append(2)

    def in_an_evaluation() -> None:
        with interrupt.handled(), interrupt.deferred(), interrupt.deferred(False):
            signal.raise_signal(signal.SIGTERM)
            steps.append(3)

    with pytest.raises(interrupt.Interrupted, match="step 1"):
        in_a_step()
    with pytest.raises(interrupt.Terminated):
        in_an_evaluation()
    assert steps == [1]
    assert not interrupt.asked()
