"""A process that the kernel killed for want of memory is told from one that was killed otherwise."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vd4rl_pomdp.core.errors import OutOfMemoryError
from vd4rl_pomdp.sweeps import oom
from vd4rl_pomdp.sweeps.oom import oom_kills
from vd4rl_pomdp.sweeps.work import FAILED, KILLED, Work, ended

VERSION_1 = Path("/sys/fs/cgroup/memory")
GREEDY = """
import subprocess, sys
from pathlib import Path
from vd4rl_pomdp.sweeps.work import Work, ended
from vd4rl_pomdp.sweeps.oom import oom_kills
before = oom_kills()
process = subprocess.run([sys.executable, "-c", "bytearray(10**9)"])
print(ended(Work("job", (), Path("log")), process.returncode, before).cause)
"""


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """A system's files of control groups, without any."""
    monkeypatch.setattr(oom, "_OWN", tmp_path / "own")
    monkeypatch.setattr(oom, "_GROUPS", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("own", "path", "text"),
    [
        ("0::/slurm/job_7\n", "slurm/job_7/memory.events", "low 0\noom 3\noom_kill {}\noom_group_kill 0\n"),
        ("4:memory:/slurm/job_7\n0::/\n", "memory/slurm/job_7/memory.oom_control", "under_oom 0\noom_kill {}\n"),
        ("0::/\n", "memory.events", "oom_kill {}\n"),
        ("4:memory:/docker/77\n", "memory/memory.oom_control", "oom_kill {}\n"),
    ],
)
def test_the_kernels_count_is_found(groups, own, path, text):
    assert oom_kills() == 0
    (groups / "own").write_text(own)
    assert oom_kills() == 0
    file = groups / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text.format(2))
    assert oom_kills() == 2
    work = Work("job", ("list",), groups / "log")
    assert ended(work, -signal.SIGKILL, 1).cause == OutOfMemoryError.cause
    assert ended(work, -signal.SIGKILL, 2).cause == ended(work, -signal.SIGTERM, 1).cause == KILLED
    assert ended(work, 1, 1).cause == FAILED


def test_a_process_of_a_group_with_too_little_memory_is_out_of_memory():
    """The kernel's own doing, where this process may make groups of version 1."""
    group = VERSION_1 / f"vd4rl_pomdp_test_{os.getpid()}"
    if not os.access(VERSION_1, os.W_OK) or not (VERSION_1 / "memory.limit_in_bytes").exists():
        pytest.skip("may make no control group of version 1 here")
    group.mkdir()
    try:
        (group / "memory.limit_in_bytes").write_text(str(200 * 2**20))
        join = f"from pathlib import Path; Path({str(group / 'cgroup.procs')!r}).write_text('0')\n"
        told = subprocess.run([sys.executable, "-c", join + GREEDY], capture_output=True, text=True)
        assert told.stdout.strip() == OutOfMemoryError.cause, told.stderr
    finally:
        group.rmdir()
