"""Real processes: how they end, what they print, what they may use, and that they end with their driver."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.sweeps.executors import local
from vd4rl_pomdp.sweeps.executors.local import LocalExecutor, LocalOptions
from vd4rl_pomdp.sweeps.work import Work


def until_ended(executor):
    found = []
    while not found:
        found = executor.ended()
        time.sleep(0.05)
    return found[0]


@pytest.mark.parametrize(
    ("words", "cause", "line"),
    [
        (["list"], "done", ""),
        (["data", "check", "nowhere"], "refused", "error: nowhere: no such folder"),
    ],
)
def test_a_process_says_why_it_ended(tmp_path, words, cause, line):
    executor = LocalExecutor(LocalOptions(jobs=1))
    work = Work("a", tuple(words), tmp_path / "logs" / "a.log")
    executor.start(work)
    assert not executor.fits(1)
    found = until_ended(executor)
    assert (found.name, found.cause) == ("a", cause)
    assert found.line.startswith(line)
    assert executor.fits(1)
    assert work.log.read_text().strip()


def test_a_signal_that_cannot_be_answered_is_a_kill(tmp_path):
    executor = LocalExecutor(LocalOptions(jobs=1))
    executor.start(Work("a", ("theory",), tmp_path / "a.log"))
    os.kill(executor._running[0].process.pid, signal.SIGKILL)
    assert until_ended(executor).cause == "killed"


def test_stop_ends_the_jobs_where_nothing_is_lost(tmp_path):
    executor = LocalExecutor(LocalOptions(jobs=2))
    for name in "ab":
        executor.start(Work(name, ("theory",), tmp_path / f"{name}.log"))
    time.sleep(3)
    executor.stop()
    assert {(end.name, end.cause in ("interrupted", "killed", "done")) for end in executor.ended()} == {
        ("a", True),
        ("b", True),
    }


def lives(process: int) -> bool:
    """Whether a process runs; one that ended may wait for a parent to ask how."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


DRIVER = """
import sys, time
from pathlib import Path
from vd4rl_pomdp.sweeps.executors.local import LocalExecutor, LocalOptions
from vd4rl_pomdp.sweeps.work import Work
executor = LocalExecutor(LocalOptions(jobs=1))
executor.start(Work("a", ("bench",), Path(sys.argv[1])))
print(executor._running[0].process.pid, flush=True)
time.sleep(100)
"""


def test_jobs_end_with_their_driver_however_it_ends(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(tmp_path / "a.log")], stdout=subprocess.PIPE, text=True
    ) as driver:
        child = int(driver.stdout.readline())
        assert lives(child)
        driver.kill()
        until = time.monotonic() + 60
        while lives(child) and time.monotonic() < until:
            time.sleep(0.1)
        assert not lives(child)


def test_jobs_share_out_the_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    assert [place.cores for place in local._places(LocalOptions(jobs=3))] == [(0, 1), (2, 3, 4), (5, 6, 7)]
    assert [place.cores for place in local._places(LocalOptions(jobs=16))] == [(n // 2,) for n in range(16)]
    assert len(local._places(LocalOptions())) == 1, "as many as there are GPUs, or one"


def test_jobs_share_the_gpus(monkeypatch):
    monkeypatch.setattr(local, "visible_gpus", lambda: ["2", "5"])
    places = local._places(LocalOptions(jobs_per_gpu=3))
    assert sorted(place.gpu for place in places) == ["2"] * 3 + ["5"] * 3
    executor = LocalExecutor(LocalOptions(jobs_per_gpu=2))
    assert (executor.slots, executor.largest) == (4, 2)
    assert {place.gpu for place in executor._choose(2)} in ({"2"}, {"5"}), "one memory"
    assert not executor.fits(3)
    with pytest.raises(UserError, match="is more than 2 GPUs take"):
        LocalExecutor(LocalOptions(jobs=3))


def test_a_job_is_shown_its_share_of_the_machine(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "visible_gpus", lambda: ["7"])
    seen = {}
    monkeypatch.setattr(local, "start_process", lambda work, environment, cores: seen.update(environment, cores=cores))
    LocalExecutor(LocalOptions()).start(Work("a", ("list",), tmp_path / "log"))
    assert seen["CUDA_VISIBLE_DEVICES"] == "7"
    assert seen["OMP_NUM_THREADS"] == str(len(os.sched_getaffinity(0))) == str(len(seen["cores"]))
    assert json.dumps(sorted(seen["cores"]))
