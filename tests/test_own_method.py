"""The documentation's example of a method of one's own, executed as it stands."""

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pretrain.build import build_objective
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from tests.helpers_data import write_fake_set
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
def registry():
    with METHODS.isolated():
        yield


def test_the_example_sees_what_it_declares(script, registry):
    namespace = {"__name__": "my_method"}
    exec(compile(script.read_text(), str(script), "exec"), namespace)
    torch.manual_seed(0)
    config = PretrainConfig.of("smoke", method="past_to_frame", feature_dim=6, hidden_dim=5, head_dim=8)
    target = make_action_target("mse", torch.zeros(1, 2).numpy(), 4, 0)
    objective = build_objective(config, 2, target)
    assert wrong_pairs(objective, [6, 6, 4]) == []
    objective.visible = lambda t, k, rows: ({t, t + k}, set())
    assert wrong_pairs(objective, [6])
