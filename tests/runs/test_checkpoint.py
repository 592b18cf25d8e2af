"""Checkpoints restore what was saved; an interrupted write never loses the newest complete one."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import checkpoint
from vd4rl_pomdp.runs.checkpoint import Checkpoints, pack, unpack


def at(step: int) -> dict[str, Any]:
    return {"step": step, "weights": torch.full((50,), float(step))}


def newest(kept: Checkpoints) -> dict[str, Any]:
    """The state from which a run would resume."""
    taken: list[dict[str, Any]] = []
    kept.restore(taken.append)
    (state,) = taken
    assert torch.equal(state["weights"], at(state["step"])["weights"])
    return state


@pytest.fixture
def checkpoints(tmp_path) -> Checkpoints:
    """A run with checkpoints 1 and 2."""
    kept = Checkpoints(tmp_path)
    for step in (1, 2):
        kept.add(step, at(step), 0.5 * step)
    return kept


def names(path: Path) -> list[str]:
    return sorted(p.name for p in (path / "checkpoints").iterdir())


def test_pack_and_unpack_nested_state():
    model = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    state = {"model": model.state_dict(), "optimiser": optimiser.state_dict(), "step": 3, "note": "x", "none": None}
    loaded = unpack(pack(state))
    fresh = torch.optim.Adam(torch.nn.Linear(3, 2).parameters())
    fresh.load_state_dict(loaded["optimiser"])
    assert torch.equal(fresh.state_dict()["state"][0]["exp_avg"], optimiser.state_dict()["state"][0]["exp_avg"])
    assert (loaded["step"], loaded["note"], loaded["none"]) == (3, "x", None)
    assert len(pack({"row": torch.zeros(1000, 1000)[0]})) < 10_000, "a slice does not store its base"
    with pytest.raises(UserError, match="a checkpoint cannot store noise/0, which is a float64: use a tensor"):
        pack({"noise": [np.float64(1.0)]})


def test_two_newest_checkpoints_are_kept(checkpoints, tmp_path):
    assert checkpoints.restore(lambda state: None) == 1.0
    checkpoints.add(13, at(13), 2.0)
    assert names(tmp_path) == ["13.pt", "2.pt"]
    checkpoints.prune(1)
    assert names(tmp_path) == ["13.pt"]
    assert newest(checkpoints)["step"] == 13
    assert Checkpoints(tmp_path / "new").restore(lambda state: None) is None


@pytest.mark.parametrize("damage", ["cut", "bit", "empty"])
def test_damaged_checkpoint_falls_back_to_previous_one(checkpoints, tmp_path, capsys, damage):
    path = tmp_path / "checkpoints" / "2.pt"
    content = path.read_bytes()
    place = content.index(at(2)["weights"].numpy().tobytes())
    flipped = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    path.write_bytes({"cut": content[:-100], "bit": flipped, "empty": b""}[damage])
    assert newest(checkpoints)["step"] == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {path}: is damaged")
    checkpoints.add(2, at(2), 1.0)
    assert newest(checkpoints)["step"] == 2
    for step in (1, 2):
        (tmp_path / "checkpoints" / f"{step}.pt").write_bytes(b"")
    with pytest.raises(UserError, match=r"2.pt: this checkpoint is damaged .* remove .*checkpoints to start"):
        newest(checkpoints)
    assert names(tmp_path) == ["1.pt", "2.pt"]


def test_checkpoint_of_another_format_or_config_is_rejected(checkpoints, monkeypatch):
    with pytest.raises(UserError, match=r"2\.pt: this checkpoint does not fit the run \('updates'\)"):
        checkpoints.restore(lambda state: state["updates"])
    with pytest.raises(torch.OutOfMemoryError):  # not mistaken for a checkpoint that does not fit
        checkpoints.restore(lambda state: (_ for _ in ()).throw(torch.OutOfMemoryError("CUDA out of memory")))
    monkeypatch.setattr(checkpoint, "FORMAT", 99)
    with pytest.raises(UserError, match=r"format \d+, this version writes format 99"):
        newest(checkpoints)


def killed_at(number: int, action) -> bool:
    """Run an action in a fork that dies before its `number`-th file system call; return whether it died."""
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
def test_kill_at_any_system_call_keeps_a_complete_checkpoint(tmp_path):
    number, found = 0, set()
    while True:
        number += 1
        run = tmp_path / str(number)
        kept = Checkpoints(run)
        for step in (1, 2):
            kept.add(step, at(step), 0.0)
        if not killed_at(number, lambda kept=kept: kept.add(3, at(3), 0.0)):
            break
        for _ in range(2):  # a second kill, while files of the first attempt remain
            killed_at(max(1, number - 2), lambda kept=kept: kept.add(3, at(3), 0.0))
        found.add(newest(kept)["step"])
        kept.add(3, at(3), 0.0)
        kept.add(4, at(4), 0.0)
        assert newest(kept)["step"] == 4
        assert names(run) == ["3.pt", "4.pt"]
    assert number > 6
    assert found == {2, 3}
