"""One owner at a time: by death, by heartbeat, and said in one line."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import filelock
import pytest
from filelock import SoftFileLease

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import ownership
from vd4rl_pomdp.runs.ownership import in_use, owned

HOLDER = """
import socket, sys, time
from pathlib import Path
if sys.argv[2:]:
    socket.gethostname = lambda: sys.argv[2]
from vd4rl_pomdp.runs import ownership
ownership.LEASE_S = 1.2
with ownership.owned(Path(sys.argv[1])):
    print("owned", flush=True)
    time.sleep(60)
"""


def hold(folder: Path, *host: str) -> subprocess.Popen:
    """A process that owns a folder, on this machine or on one of another name."""
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    words = [sys.executable, "-c", HOLDER, folder, *host]
    holder = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "owned\n"
    return holder


def end(holder: subprocess.Popen) -> None:
    holder.send_signal(signal.SIGKILL)
    holder.wait()


def test_a_second_process_is_told_who_holds_a_folder_until_that_one_dies(tmp_path, monkeypatch):
    monkeypatch.setattr(ownership, "LEASE_S", 1.2)
    holder = hold(tmp_path / "run")
    told = rf"run: is in use by process {holder.pid} on {socket.gethostname()} since \d{{4}}-\d\d-\d\d .* UTC; wait"
    with pytest.raises(UserError, match=told), owned(tmp_path / "run"):
        pass
    end(holder)
    with owned(tmp_path / "run"):
        assert json.loads((tmp_path / "run" / ".owner.json").read_text())["pid"] == os.getpid()
    assert not list((tmp_path / "run").iterdir())


def test_an_owner_on_another_machine_lives_while_its_heart_beats(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ownership, "LEASE_S", 1.2)
    holder = hold(tmp_path / "run", "elsewhere")
    with pytest.raises(UserError, match=f"process {holder.pid} on elsewhere since"), owned(tmp_path / "run"):
        pass
    assert "waiting for a sign of its life" in capsys.readouterr().err
    end(holder)
    with owned(tmp_path / "run") as owner:
        owner.check()


@pytest.mark.parametrize("host", [(), ("elsewhere",)])
def test_a_dead_owner_frees_the_folder_where_names_cannot_be_exchanged_too(tmp_path, monkeypatch, host):
    """On NFS and the like filelock leaves the lock of a dead process."""
    monkeypatch.setattr(ownership, "LEASE_S", 1.2)
    monkeypatch.setattr(filelock._soft, "exchange_names", lambda *names: False)
    end(hold(tmp_path / "run", *host))
    with owned(tmp_path / "run") as owner:
        owner.check()


def test_a_process_with_the_number_of_a_dead_owner_does_not_keep_its_folder(tmp_path, monkeypatch):
    """As in a container that is started again, whose first process has the same number each time."""
    monkeypatch.setattr(ownership, "LEASE_S", 1.2)
    monkeypatch.setattr(filelock._soft, "exchange_names", lambda *names: False)
    end(hold(tmp_path))
    note = json.loads((tmp_path / ".owner.json").read_text())
    (tmp_path / ".owner.json").write_text(json.dumps(note | {"pid": os.getpid()}))
    assert not in_use(tmp_path)
    with owned(tmp_path) as owner:
        assert in_use(tmp_path)
        owner.check()


def test_a_note_without_a_sign_of_life_holds_nothing(tmp_path):
    """As after a power cut: the number of the process that died is another's by now."""
    holder = hold(tmp_path)
    assert in_use(tmp_path)
    note = (tmp_path / ".owner.json").read_text()
    end(holder)
    assert not in_use(tmp_path)
    (tmp_path / ".owner.json").write_text(json.dumps(json.loads(note) | {"pid": os.getpid()}))
    os.utime(tmp_path / ".lock", (0, 0))
    assert not in_use(tmp_path)


def test_two_owners_in_one_process_are_two(tmp_path):
    with owned(tmp_path), pytest.raises(UserError, match=f"in use by process {os.getpid()}"), owned(tmp_path):
        pass


def test_an_owner_whose_folder_was_taken_writes_no_more(tmp_path):
    with owned(tmp_path) as owner:
        owner.check()
        note = tmp_path / ".owner.json"
        note.write_text(note.read_text().replace('"pid": ', '"pid": 9'))
        with pytest.raises(UserError, match=r"was taken over by process 9\d+ on"):
            owner.check()
        note.unlink()
        with pytest.raises(UserError, match="was removed or taken over"):
            owner.check()


def test_a_folder_that_may_not_be_written_says_so(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(UserError, match=r"run: may not be used \(permission denied\); ask its owner"):
        owned(tmp_path / "run").__enter__()


def test_a_lock_names_its_owner_on_the_disk_at_once(tmp_path, monkeypatch):
    """A network file system shows others an empty one until then, which would be broken after EMPTY_S."""
    synchronised, fsync = set(), os.fsync

    def noted(handle):
        synchronised.add(os.fstat(handle).st_ino)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", noted)
    with owned(tmp_path):
        assert (tmp_path / ".lock").stat().st_ino in synchronised


def test_of_two_that_find_a_dead_lock_one_removes_it_and_no_later_one(tmp_path, monkeypatch):
    monkeypatch.setattr(ownership, "EMPTY_S", 0.05)
    lease, lock, breaking = SoftFileLease(tmp_path / ".lock"), tmp_path / ".lock", tmp_path / ".lock.break"
    lock.touch()
    breaking.touch()
    assert not ownership._broken(lease, tmp_path, lambda: True), "another process is at it"
    assert lock.exists()
    os.utime(breaking, (0, 0))
    assert not ownership._broken(lease, tmp_path, lambda: True), "the other was killed at it"
    assert not breaking.exists()
    assert not ownership._broken(lease, tmp_path, lambda: False), "by now it is a successor's"
    assert lock.exists()
    assert ownership._broken(lease, tmp_path, lambda: True)
    assert not lock.exists()
    assert not breaking.exists()
    lock.touch()
    with owned(tmp_path) as owner:
        owner.check()
    assert not list(tmp_path.iterdir())
