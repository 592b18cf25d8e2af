"""Pretraining: recorded settings and invalid input. `test_interruptions.py` covers interrupted runs."""

import json
import math

import pytest
import torch

from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import write_fake_set
from tests.helpers_stages import smoke_pretrain
from vd4rl_pomdp.cli import run_to_end
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn import load_encoder


def test_encoder_records_its_pretraining_settings(encoder):
    settings = load_encoder(encoder)[1].settings
    assert (settings["method"], settings["max_k"], settings["corruption"], settings["task"]) == (
        *("mik+a", 3, "patch+zero_frames", "walker_walk"),
    )
    assert not {"seed", "data", "out", "device", "log_every", "checkpoint_every", "wandb"} & set(settings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "mikado"}, r"unknown method 'mikado'.*mik\+a"),
        ({"window": 21}, "episode 0 .*20 rows"),
        ({"method": "curl", "batch_size": 1}, "--batch-size is 1; curl contrasts windows: give it 2"),
        ({"patch_size": 85}, "exceeds the image"),
        ({"zeroed_frames": 4}, "cannot zero 4 of 3"),
        ({"device": "meta"}, "unknown device 'meta'"),
        ({"frame_encoder": "state"}, "stores no simulator states"),
        ({"task": "cheetah_run"}, "is a dataset of walker_walk, not of cheetah_run"),
    ],
)
def test_invalid_pretraining_settings_leave_no_run(data, tmp_path, change, message):
    with pytest.raises(UserError, match=message):
        run_pretrain(smoke_pretrain(data, tmp_path / "out", **change))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", ["mik+a", "random"])
def test_dataset_without_transitions_is_rejected(tmp_path, method):
    """Other advice, such as fewer codes or a shorter window, would not help."""
    data = write_fake_set(tmp_path / "walker_walk" / "expert", (1, 1, 1), complete_last=False)
    with pytest.raises(UserError, match="a single row: choose another dataset"):
        run_pretrain(smoke_pretrain(data, tmp_path / "out", method=method))
    assert not (tmp_path / "out").exists()


def test_out_of_memory_is_reported(data, tmp_path):
    words = ["pretrain", "--preset", "smoke", "--data", str(data), "--method", "mik+a", "--out", str(tmp_path / "out")]
    end = run_to_end([*words, "--hidden-dim", "1000000"])
    assert end.code == 2
    assert end.line.startswith("error: out of memory")


def test_encoder_with_non_finite_weights_is_marked_and_not_saved(data, tmp_path, monkeypatch):
    config = smoke_pretrain(data, tmp_path / "out", steps=2)

    def ruin(objective):
        ruin.steps += 1
        if ruin.steps == config.steps:
            torch.nn.init.constant_(next(objective.parameters()), math.inf)

    ruin.steps = 0
    monkeypatch.setattr("vd4rl_pomdp.nn.objective.Objective.after_step", ruin)
    with pytest.raises(FloatingPointError, match="out: weights are not finite after step 2"):
        run_pretrain(config)
    assert json.loads((config.out / "diverged.json").read_text())["step"] == 2
    assert not (config.out / "encoder").exists()
