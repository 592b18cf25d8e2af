import json

import pytest
import torch

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs.checkpoint import load_checkpoint, restore_checkpoint, save_checkpoint
from vd4rl_pomdp.runs.metrics import MetricsLog


def test_nested_state_comes_back_as_it_was(tmp_path):
    model = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    state = {"model": model.state_dict(), "optimiser": optimiser.state_dict(), "step": 3, "note": "x", "none": None}
    save_checkpoint(tmp_path / "checkpoint", state)
    loaded = load_checkpoint(tmp_path / "checkpoint")
    fresh = torch.optim.Adam(torch.nn.Linear(3, 2).parameters())
    fresh.load_state_dict(loaded["optimiser"])
    assert torch.equal(fresh.state_dict()["state"][0]["exp_avg"], optimiser.state_dict()["state"][0]["exp_avg"])
    assert loaded["step"] == 3
    assert loaded["none"] is None
    assert not list(tmp_path.rglob("*.pt"))


def test_a_cut_exchange_leaves_the_old_checkpoint_readable(tmp_path):
    folder = tmp_path / "checkpoint"
    save_checkpoint(folder, {"step": 1})
    save_checkpoint(folder, {"step": 2})
    folder.rename(tmp_path / "checkpoint.old")  # cut between the two renames of an exchange
    (tmp_path / "checkpoint.new").mkdir()
    assert load_checkpoint(folder) == {"step": 2}
    save_checkpoint(folder, {"step": 3})
    assert load_checkpoint(folder) == {"step": 3}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint"]


def test_damage_is_one_sentence(tmp_path):
    folder = tmp_path / "checkpoint"
    assert load_checkpoint(folder) is None
    save_checkpoint(folder, {"step": 1, "x": torch.zeros(3)})
    (folder / "state.safetensors").write_bytes(b"\x80\x04pickle")
    with pytest.raises(UserError, match="damaged or of another format"):
        load_checkpoint(folder)
    save_checkpoint(folder, {"step": 1})
    with pytest.raises(UserError, match=r"another format or config \('updates'\)"):
        restore_checkpoint(folder, lambda state: state["updates"])


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
    with pytest.raises(FloatingPointError, match="loss is nan at step 4"):
        log.write(4, {"loss": float("nan")})
