"""The process of a job: a cluster may send it signals that are meant for the task that started it."""

import signal

from tests.sweeps.executors.waiting import until
from vd4rl_pomdp.sweeps.work import INTERRUPTED, KILLED, Ended, Work, ended, start_process

GRID = """
import time
from pathlib import Path
from vd4rl_pomdp.runs import interrupt
here = Path(__file__).parent
with interrupt.deferred():
    (here / "begun").touch()
    while not interrupt.asked():
        time.sleep(0.05)
    (here / "asked").touch()
    while not (here / "go").exists():
        time.sleep(0.05)
    (here / "written").touch()
"""


def test_a_job_imports_these_packages_whatever_the_working_directory_holds(tmp_path, monkeypatch):
    (tmp_path / "pretrain").mkdir()
    (tmp_path / "pretrain" / "__init__.py").write_text("raise ImportError('of another project')")
    monkeypatch.chdir(tmp_path)
    work = Work("job", ("pretrain", "--method", "nothing"), tmp_path / "log")
    assert ended(work, start_process(work, {}).wait(120)).cause == "refused"
    assert "unknown method 'nothing'" in work.log.read_text()


def test_what_an_earlier_attempt_printed_is_not_told_of_the_next(tmp_path):
    work = Work("job", ("list",), tmp_path / "log")
    work.log.write_text("error: the disk is full\n")
    process = start_process(work, {})
    process.kill()
    assert ended(work, process.wait(60)) == Ended("job", KILLED, "")


def test_a_job_that_is_ended_while_it_imports_its_file_was_interrupted(tmp_path):
    file = tmp_path / "own.py"
    file.write_text(
        "import time\nfrom pathlib import Path\nPath(__file__).with_name('begun').touch()\ntime.sleep(60)\n"
    )
    work = Work("job", ("list",), tmp_path / "log", own_file={"init_main_from_path": str(file)})
    process = start_process(work, {})
    until((tmp_path / "begun").exists)
    process.terminate()
    assert ended(work, process.wait(60)).cause == INTERRUPTED


def test_a_job_that_writes_its_checkpoint_is_ended_by_no_further_signal(tmp_path):
    (tmp_path / "grid.py").write_text(GRID)
    words = ("sweep", "run", str(tmp_path / "grid.py"), "--out", str(tmp_path / "out"), "--dry-run")
    work = Work("job", words, tmp_path / "log")
    process = start_process(work, {})
    until((tmp_path / "begun").exists)
    process.send_signal(signal.SIGUSR2)
    process.terminate()
    until((tmp_path / "asked").exists)
    process.terminate()
    process.send_signal(signal.SIGUSR2)
    (tmp_path / "go").touch()
    assert ended(work, process.wait(60)).cause == INTERRUPTED
    assert (tmp_path / "written").exists()
