"""The process of a job: a cluster may send it signals that are meant for the task that started it."""

import signal

from tests.sweeps.executors.waiting import until
from vd4rl_pomdp.sweeps.work import INTERRUPTED, Work, ended, start_process

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
