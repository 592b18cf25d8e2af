"""Damaged and special files raise a UserError: no blocking on pipes, no recursion errors, no wrong types."""

import os

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import build, parse_json, read_tensors, regular
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.nn.encoder import EncoderCard
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.runs.metrics import read_metrics

NESTED = "[" * 100_000 + "]" * 100_000


def test_pipes_folders_and_devices_are_rejected(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, type(tmp_path)("/dev/zero")):
        with pytest.raises(UserError, match="not a regular file"):
            regular(path)
        with pytest.raises(UserError, match="not a regular file"):
            read_json(path)
    assert regular(tmp_path / "missing") == tmp_path / "missing"


def test_deeply_nested_json_is_rejected(tmp_path):
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(NESTED)
    (tmp_path / "a.json").write_text(NESTED)
    with pytest.raises(UserError, match=r"a\.json: cannot be read as JSON \(it is nested too deeply\)"):
        read_json(tmp_path / "a.json")


CARD = {"method": "acro", "task": "t", "quality": "q", "corruption": {}, "seed": 0, "steps": 1, "preset": "smoke"}


def test_values_must_have_declared_types():
    assert build(EncoderCard, CARD | {"action_loss": 1}).action_loss == 1
    assert build(EncoderCard, CARD).action_loss is None
    for wrong in ({"seed": "0"}, {"seed": True}, {"corruption": []}, {"action_loss": "x"}, {"task": None}):
        with pytest.raises(TypeError):
            build(EncoderCard, CARD | wrong)
    with pytest.raises(TypeError, match="corruption_mode"):
        build(CorruptionConfig, {"corruption_mode": "sometimes"})


@pytest.mark.parametrize("line", ["[]", '{"loss": 1.0}', '{"step": "1"}', NESTED, "nonsense"], ids=range(5))
def test_damaged_metrics_line_is_rejected(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_text(f'{{"step": 1, "loss": 0.5}}\n{line}\n')
    with pytest.raises(UserError, match=r"metrics\.jsonl: a line is not JSON of numbers"):
        read_metrics(tmp_path / "metrics.jsonl")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_tensors_are_rejected(tmp_path, value):
    save_file({"good": torch.arange(3), "bad": torch.tensor([1.0, value])}, tmp_path / "a.safetensors")
    with pytest.raises(UserError, match="'bad' is not finite"):
        read_tensors(tmp_path / "a.safetensors")
