import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import checkpoint, files
from vd4rl_pomdp.runs.checkpoint import Checkpoints, fitting, pack, unpack
from vd4rl_pomdp.runs.metrics import MetricsLog

FILES = {"a": b"first", "b": b"second" * 100}


def at(step: int) -> dict[str, bytes]:
    return {name: content + b"%d" % step for name, content in FILES.items()}


@pytest.fixture
def two(tmp_path) -> Checkpoints:
    """A run with checkpoints 1 and 2."""
    kept = Checkpoints(tmp_path)
    for step in (1, 2):
        kept.add(step, at(step), 0.5 * step)
    return kept


def names(path: Path) -> list[str]:
    return sorted(p.name for p in (path / "checkpoints").iterdir())


def test_nested_state_comes_back_as_it_was(tmp_path):
    model = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    state = {"model": model.state_dict(), "optimiser": optimiser.state_dict(), "step": 3, "note": "x", "none": None}
    Checkpoints(tmp_path).add(3, pack(state), 1.0)
    found = Checkpoints(tmp_path).newest()
    loaded = unpack(found.files)
    fresh = torch.optim.Adam(torch.nn.Linear(3, 2).parameters())
    fresh.load_state_dict(loaded["optimiser"])
    assert torch.equal(fresh.state_dict()["state"][0]["exp_avg"], optimiser.state_dict()["state"][0]["exp_avg"])
    assert (loaded["step"], loaded["none"], found.step, found.seconds) == (3, None, 3, 1.0)
    assert not list(tmp_path.rglob("*.pt"))


def test_the_two_newest_are_kept(two, tmp_path):
    assert names(tmp_path) == ["1", "2"]
    two.add(13, at(13), 2.0)
    assert names(tmp_path) == ["13", "2"]
    two.prune(1)
    assert names(tmp_path) == ["13"]
    assert two.newest().files == at(13)


@pytest.mark.parametrize("damage", ["cut", "missing", "manifest", "no manifest", "bit"])
def test_a_damaged_newest_one_costs_a_line_and_the_steps_since_the_one_before(two, tmp_path, capsys, damage):
    newest = tmp_path / "checkpoints" / "2"
    if damage == "cut":
        (newest / "b").write_bytes(at(2)["b"][:10])
    elif damage == "bit":
        (newest / "b").write_bytes(b"S" + at(2)["b"][1:])
    elif damage == "manifest":
        (newest / "manifest.json").write_text("{")
    else:
        (newest / ("a" if damage == "missing" else "manifest.json")).unlink()
    assert two.newest().files == at(1)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"warning: {newest}: is damaged")
    two.add(2, at(2), 1.0)
    assert two.newest().files == at(2)


def test_where_none_is_whole_it_is_said(two, tmp_path):
    for step in ("1", "2"):
        (tmp_path / "checkpoints" / step / "a").write_bytes(b"")
    with pytest.raises(UserError, match=r"checkpoints/2: this checkpoint is damaged .* remove .*checkpoints to start"):
        two.newest()
    assert names(tmp_path) == ["1", "2"]
    assert Checkpoints(tmp_path / "new").newest() is None


def test_another_format_is_refused(two, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", 99)
    with pytest.raises(UserError, match=r"format \d+, this version writes format 99"):
        two.newest()


def test_a_state_of_another_config_is_one_sentence(tmp_path):
    Checkpoints(tmp_path).add(1, pack({"step": 1}), 0.0)
    found = Checkpoints(tmp_path).newest()
    with (
        pytest.raises(UserError, match=r"checkpoints/1: this checkpoint does not fit the run \('updates'\)"),
        fitting(found),
    ):
        unpack(found.files)["updates"]


def test_memory_that_runs_out_while_one_is_restored_does_not_make_it_anothers(tmp_path):
    Checkpoints(tmp_path).add(1, pack({"step": 1}), 0.0)
    with pytest.raises(torch.OutOfMemoryError), fitting(Checkpoints(tmp_path).newest()):
        raise torch.OutOfMemoryError("CUDA out of memory")


def killed_at(number: int, action) -> bool:
    """Run an action in a forked process that dies right before its `number`-th file system call; whether it did."""
    child = os.fork()
    if child == 0:
        calls = []

        def count(event: str, arguments: tuple) -> None:
            if event == "open" or event.startswith(("os.", "shutil.")):
                calls.append(event)
                if len(calls) == number:
                    os._exit(9)

        sys.addaudithook(count)
        try:
            action()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_whatever_moment_a_kill_takes_the_newest_whole_checkpoint_is_found(tmp_path, capsys):
    number, found = 0, set()
    while True:
        number += 1
        run = tmp_path / str(number)
        kept = Checkpoints(run)
        for step in (1, 2):
            kept.add(step, at(step), 0.0)
        if not killed_at(number, lambda kept=kept: kept.add(3, at(3), 0.0)):
            break
        for _ in range(2):  # a second kill, while the rest of the first one is still there
            killed_at(max(1, number - 2), lambda kept=kept: kept.add(3, at(3), 0.0))
        step = kept.newest().step
        found.add(step)
        assert kept.newest().files == at(step)
        kept.add(3, at(3), 0.0)
        kept.add(4, at(4), 0.0)
        assert kept.newest().files == at(4)
        assert names(run) == ["3", "4"]
    assert number > 12
    assert found == {2, 3}


def full_disk(monkeypatch, left: int) -> None:
    """Let `left` bytes be written, then have the disk full."""
    write, space = Path.write_bytes, [left]

    def limited(path: Path, content: bytes) -> int:
        write(path, content[: max(0, space[0])])
        space[0] -= len(content)
        if space[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return len(content)

    monkeypatch.setattr(Path, "write_bytes", limited)


@pytest.mark.parametrize("left", [0, 3, 8, 400, 650])
def test_a_full_disk_is_one_sentence_and_takes_nothing(two, tmp_path, monkeypatch, left):
    with monkeypatch.context() as patch:
        full_disk(patch, left)
        with pytest.raises(UserError, match=r"checkpoints/3: the disk is full: free some space and re-run the same"):
            two.add(3, at(3), 0.0)
    assert names(tmp_path) == ["1", "2"]
    assert two.newest().files == at(2)
    two.add(3, at(3), 0.0)
    assert two.newest().files == at(3)


def test_a_disk_that_is_really_full(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", disk], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"cannot mount a small file system here: {mounted.stderr.strip()}")
    try:
        kept = Checkpoints(disk / "run")
        kept.add(1, {"a": b"x" * 20_000}, 0.0)
        with pytest.raises(UserError, match="the disk is full"):
            kept.add(2, {"a": b"y" * 60_000}, 0.0)
        assert kept.newest().step == 1
        with pytest.raises(UserError, match="the disk is full"):
            files.write_json(disk / "large.json", "z" * 60_000)
        assert [path.name for path in disk.iterdir()] == ["run"]
    finally:
        subprocess.run(["umount", disk], check=True)


def test_metrics_after_the_checkpoint_are_dropped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = MetricsLog(path, 0)
    for step in (1, 2, 3):
        log.write(step, {"loss": step / 2})
    path.open("a").write('{"step": 4, "lo')
    MetricsLog(path, 2).write(3, {"loss": 9.0})
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"step": 1, "loss": 0.5},
        {"step": 2, "loss": 1.0},
        {"step": 3, "loss": 9.0},
    ]
    with pytest.raises(FloatingPointError, match="loss is nan in the row of step 4"):
        log.write(4, {"loss": float("nan")})
