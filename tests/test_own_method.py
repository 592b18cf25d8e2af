"""The documentation's example of a method of one's own, executed as it stands."""

import csv
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

import pretrain.objectives
from pretrain.config import PRESETS
from pretrain.objectives import METHODS, Method, build_objective, get_method, register_method
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.nn.action_target import make_action_target
from vd4rl_pomdp.visibility import wrong_pairs

PAGE = Path(__file__).parents[1] / "docs" / "add_a_method.md"


@pytest.fixture
def script(tmp_path) -> Path:
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
    (tmp_path / "my_method.py").write_text(code)
    return tmp_path / "my_method.py"


def test_the_example_runs_through_every_stage(script, tmp_path):
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])
    runs = tmp_path / "runs"
    environment = os.environ | {"VD4RL_POMDP_CACHE": str(tmp_path / "cache")}
    for line in (
        f"pretrain --method past_to_frame --corruption patch --preset smoke --data {data} --out {runs}/pretrain",
        f"finetune --encoder {runs}/pretrain/encoder --preset smoke --data {data} --out {runs}/finetune --workers 1",
        f"report {runs} --out {tmp_path}/report",
    ):
        done = subprocess.run(
            [sys.executable, str(script), *line.split()], capture_output=True, text=True, env=environment, check=False
        )
        assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "report" / "summary.csv").open()))
    assert [row["method"] for row in rows] == ["past_to_frame"]


@pytest.fixture
def registry(monkeypatch):
    monkeypatch.setattr(pretrain.objectives, "METHODS", dict(METHODS))
    monkeypatch.setattr(pretrain.objectives, "_broken", {})


def test_the_example_sees_what_it_declares(script, registry):
    namespace = {"__name__": "my_method"}
    exec(compile(script.read_text(), str(script), "exec"), namespace)
    torch.manual_seed(0)
    config = replace(PRESETS["smoke"], method="past_to_frame", feature_dim=6, hidden_dim=5, head_dim=8)
    target = make_action_target("mse", torch.zeros(1, 2).numpy(), 4, 0)
    objective = build_objective(config, torch.zeros(1, 2), target)
    assert wrong_pairs(objective, [6, 6, 4]) == []
    objective.visible = lambda t, k, rows: ({t, t + k}, set())
    assert wrong_pairs(objective, [6])


def test_an_entry_point_offers_a_method(registry, monkeypatch):
    entry = EntryPoint("theirs", "tests.test_own_method:THEIRS", "vd4rl_pomdp.methods")
    monkeypatch.setattr(pretrain.objectives, "entry_points", lambda group: [entry])
    assert get_method("theirs") is THEIRS
    assert get_method("theirs") is THEIRS, "asking again registers nothing twice"


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_package:METHOD", "no_such_package:METHOD: ModuleNotFoundError"),
        ("tests.test_own_method:NOWHERE", "AttributeError"),
        ("tests.test_own_method:PAGE", "Path, not a pretrain.objectives.Method"),
    ],
)
def test_a_method_that_cannot_be_loaded_is_named_once_and_left_out(registry, monkeypatch, capsys, value, reason):
    offered = [
        EntryPoint("broken", value, "vd4rl_pomdp.methods"),
        EntryPoint("theirs", "tests.test_own_method:THEIRS", "vd4rl_pomdp.methods"),
    ]
    monkeypatch.setattr(pretrain.objectives, "entry_points", lambda group: offered)
    assert get_method("acro") is METHODS["acro"]
    assert get_method("theirs") is THEIRS
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: method 'broken' cannot be loaded")
    assert reason in line
    with pytest.raises(UserError, match="'broken' cannot be loaded"):
        get_method("broken")


def test_a_taken_name_is_refused(registry):
    with pytest.raises(UserError, match="'acro' exists already"):
        register_method("acro", THEIRS)


THEIRS = Method(METHODS["acro"].build)
