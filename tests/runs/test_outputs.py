"""Commands neither overwrite nor write into a run, policy, encoder or dataset, or a folder in use."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from tests.helpers_bad_input import RUN, SET, VALID, WITHOUT_OUT, rejection
from tests.helpers_data import file_bytes, write_fake_set
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.outputs import built, in_use, kept_in, owned, refuse_foreign, refuse_inside


def fill(folder: Path, **files: str) -> Path:
    folder.mkdir(parents=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return folder


@pytest.fixture
def kept(tmp_path) -> dict[str, Path]:
    """One folder of every kind that owns its files."""
    run = {"stage": "finetune", "config": {}, "versions": {}, "git_commit": "", "command": ""}
    return {
        "a run": fill(tmp_path / RUN, config__json=json.dumps(run), episodes__csv=""),
        "an encoder": fill(tmp_path / "encoder", config__json="{}", model__safetensors=""),
        "a policy": fill(tmp_path / "policy", config__json='{"task": "cheetah_run"}', curve__csv=""),
        "a data set": write_fake_set(tmp_path / SET),
        "a data set ": fill(tmp_path / "collecting", collection__json="{}"),
    }


def test_foreign_config_files_are_no_runs(tmp_path):
    for name, text in {"package": "[1]", "broken": "{"}.items():
        assert kept_in(fill(tmp_path / name, config__json=text)) is None
    assert kept_in(tmp_path / "nowhere") is None


def test_output_inside_owned_folders_is_rejected(kept, tmp_path):
    for what, folder in kept.items():
        with pytest.raises(UserError, match=f"lies inside .* holds {what.strip()}; choose another folder"):
            refuse_inside(folder / ".." / folder.name / "not" / "there" / "yet.csv")
    (tmp_path / "link").symlink_to(kept["a run"])
    with pytest.raises(UserError, match="lies inside"):
        refuse_inside(tmp_path / "link" / "new")
    (tmp_path / "loop").symlink_to("loop")
    refuse_inside(tmp_path / "loop" / "new")  # inside no owned folder; writing there reports the loop
    with pytest.raises(UserError, match="is not empty and holds no report"):
        refuse_foreign(fill(tmp_path / "papers", thesis__tex="words"), "report", "summary.csv")
    for mine in (tmp_path / "new", fill(tmp_path / "empty"), fill(tmp_path / "earlier", summary__csv="")):
        refuse_foreign(mine, "report", "summary.csv")


NAMES = [name for name in VALID if name not in WITHOUT_OUT and " --" not in name]
FILES = ("evaluate", "data view", "navigation policy")
"""Commands whose --out is a file."""


@pytest.mark.parametrize("name", NAMES)
def test_commands_do_not_write_into_owned_folders(name, kept, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fill(tmp_path / "trained", config__json='{"task": "walker_walk"}', curve__csv="decisions,return_mean\n")
    for folder in kept.values():
        places = [folder / "inside"] if name not in FILES else [folder / "inside.csv", folder / "not" / "there.csv"]
        if name not in (*FILES, "pretrain", "finetune", "navigation train"):  # these check their data first
            places.append(folder)
        for out in places:
            before = file_bytes(tmp_path)
            error = rejection([*name.split(), *VALID[name], "--out", str(out)])
            assert str(out) in error
            assert "choose another " in error
            assert file_bytes(tmp_path) == before


def test_all_commands_with_out_are_covered(capsys):
    from vd4rl_pomdp.cli import COMMANDS

    with_out = set()
    for name in COMMANDS:
        with pytest.raises(SystemExit):
            main([*name.split(), "--help"])
        if "--out " in capsys.readouterr().out:
            with_out.add(name)
    assert with_out == set(NAMES)


HOLDER = """
import sys, time
from pathlib import Path
from unittest.mock import MagicMock
from vd4rl_pomdp.runs.outputs import owned
with owned(Path(sys.argv[1])):
    print("owned", flush=True)
    time.sleep(60)
"""


@pytest.mark.filterwarnings("ignore:flock not supported")
def test_killed_process_on_a_disk_without_locks_leaves_a_named_file(tmp_path, monkeypatch):
    (tmp_path / ".lock").write_text("process 7 on host")
    monkeypatch.setattr("fcntl.flock", MagicMock(side_effect=OSError(errno.ENOSYS, "Function not implemented")))
    with pytest.raises(UserError, match=rf"process 7 on host; wait .*delete {tmp_path}/\.lock"), owned(tmp_path):
        pass
    (tmp_path / ".lock").unlink()
    with owned(tmp_path):
        pass


def test_folder_in_use_names_its_process_until_it_dies(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, tmp_path / "run"], stdout=subprocess.PIPE, text=True, env=environment
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "owned\n"
        assert in_use(tmp_path / "run")
        line = rf"run: is in use by process {holder.pid} on {socket.gethostname()} since \d{{4}}-\d\d-\d\d .* UTC; wait"
        with pytest.raises(UserError, match=line), owned(tmp_path / "run"):
            pass
        holder.send_signal(signal.SIGKILL)
    assert not in_use(tmp_path / "run")
    with owned(tmp_path / "run"):
        assert in_use(tmp_path / "run")
    assert not list((tmp_path / "run").iterdir())


def test_folder_on_a_read_only_disk_counts_as_in_use(tmp_path, monkeypatch):
    def acquire(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("filelock.FileLock.acquire", acquire)
    assert in_use(fill(tmp_path / "run", __lock=""))


def build(place: Path, meanwhile: Callable[[], object] = lambda: None) -> None:
    with built(place) as made:
        fill(made, a="1")
        assert not place.exists() or not list(place.iterdir())
        meanwhile()


def test_built_folder_appears_complete_or_not_at_all(tmp_path):
    def fail() -> None:
        raise UserError("no")

    with pytest.raises(UserError, match="no"):
        build(tmp_path / "deep" / "out", fail)
    assert list(tmp_path.iterdir()) == []
    build(tmp_path / "new")
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "a"]
    hidden = fill(tmp_path / "hidden", __DS_Store="of a file manager")
    with pytest.raises(UserError, match=r"hidden: is not empty \(holds .DS_Store\); choose another folder"):
        build(hidden)


def test_built_folder_is_no_mount_point(tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path) == tmp_path / "disk")
    with pytest.raises(UserError, match="disk: is a mount point; choose a folder in it"):
        build(tmp_path / "disk")


def test_built_folder_may_be_a_link_and_replaces_nothing(tmp_path):
    out, link = fill(tmp_path / "deep" / "out"), tmp_path / "link"
    link.symlink_to(out)
    with pytest.raises(UserError, match=r"link: cannot be used \(directory not empty\)"):
        build(link, (out / "b").touch)
    assert [path.name for path in out.iterdir()] == ["b"]
    (out / "b").unlink()
    build(link)
    assert [path.name for path in out.iterdir()] == ["a"]
    assert link.is_symlink()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "deep", "link", "out"]
