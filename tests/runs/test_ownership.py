"""One owner at a time: a second one is refused in one line, and the system frees what a killed one owned."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from vd4rl_pomdp.core.errors import InUseError, UserError
from vd4rl_pomdp.runs.outputs import in_use, owned

HOLDER = """
import sys, time
from pathlib import Path
from vd4rl_pomdp.runs.outputs import owned
with owned(Path(sys.argv[1])):
    print("owned", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_told_who_holds_a_folder_until_that_one_dies(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, tmp_path / "run"], stdout=subprocess.PIPE, text=True, env=environment
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "owned\n"
        assert in_use(tmp_path / "run")
        told = rf"run: is in use by process {holder.pid} on {socket.gethostname()} since \d{{4}}-\d\d-\d\d .* UTC; wait"
        with pytest.raises(InUseError, match=told), owned(tmp_path / "run"):
            pass
        holder.send_signal(signal.SIGKILL)
    assert not in_use(tmp_path / "run")
    with owned(tmp_path / "run"):
        assert in_use(tmp_path / "run")
    assert not list((tmp_path / "run").iterdir())


def test_two_owners_in_one_process_are_two(tmp_path):
    assert not in_use(tmp_path / "none")
    with owned(tmp_path), pytest.raises(UserError, match=f"in use by process {os.getpid()}"), owned(tmp_path):
        pass


def test_a_folder_that_may_not_be_written_says_so(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(UserError, match=r"run: may not be used \(permission denied\); ask its owner"):
        owned(tmp_path / "run").__enter__()
