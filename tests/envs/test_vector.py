"""Asynchronous vectors of environments, in a process of their own: what hangs must not hang the tests."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).with_name("vector_script.py")


def test_processes_that_work_do_and_those_that_would_hang_are_refused(tmp_path):
    shown = tmp_path / "shown.txt"
    with shown.open("w") as file:
        process = subprocess.Popen([sys.executable, SCRIPT], stdout=file, stderr=file, start_new_session=True)
    try:
        assert process.wait(timeout=240) == 0, shown.read_text()
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert shown.read_text().splitlines()[-1] == "as expected"
