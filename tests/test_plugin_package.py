"""An installed package with one plug-in of each kind is found by the command line and recorded."""

import json
import os
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import pytest

from tests.helpers_data import write_fake_set

ROOT = Path(__file__).parents[1]
CODE = '''"""One part of each kind."""

from dataclasses import dataclass

import gymnasium
import numpy as np
from torch import nn

from finetune.algorithms import BC
from pretrain.objectives import Method
from vd4rl_pomdp.nn.frame import FrameEncoderPart, FrameOptions
from vd4rl_pomdp.nn.objective import InverseOptions, StateInverse
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.core.tasks import GymnasiumTask


@dataclass(frozen=True)
class TheirMethodOptions(InverseOptions):
    sharpness: float = 1.0
    """Factor of the states."""


class Sharp(StateInverse):
    """Their inverse model."""

    def representations(self, window):
        past, future = super().representations(window)
        return past * self.options.sharpness, future


METHOD = Method(Sharp, options=TheirMethodOptions, summary="their inverse model")


@dataclass(frozen=True)
class Column(Options):
    """A grey column over every frame."""

    column_grey: int = 9
    """Its pixel value."""

    def __call__(self, frames, key, number):
        frames[..., 3:9] = self.column_grey


@dataclass(frozen=True)
class SlowOptions(Options):
    slowness: float = 2.0
    """What divides the learning rate."""


class SlowBC(BC):
    """Their algorithm."""

    options = SlowOptions
    summary = "slow behaviour cloning"

    def __init__(self, policy, options, learning_rate, updates, generator):
        super().__init__(policy, options, learning_rate / options.slowness, updates, generator)


@dataclass(frozen=True)
class WideOptions(FrameOptions):
    stride_of_first: int = 8
    """Stride of the convolution."""


def wide(channels, size, options):
    return nn.Sequential(nn.Conv2d(channels, 4, 8, stride=options.stride_of_first), nn.ReLU())


WIDE = FrameEncoderPart(wide, WideOptions, summary="one convolution")


class Dot(gymnasium.Env):
    """Shows how far its first action has led."""

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0, 255, (1,))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform()
        return np.zeros(1), {}

    def step(self, action):
        self.place = float(np.clip(self.place + 0.1 * action[0], 0, 1))
        return np.zeros(1), self.place, False, False, {}

    def render(self):
        return np.full((84, 84), int(255 * self.place), np.uint8)


TASK = GymnasiumTask(Dot, decisions=20)
'''
PARTS = {
    "method": ("sharp", "METHOD", "sharpness", 2.0),
    "corruption": ("column", "Column", "column_grey", 7),
    "algorithm": ("slow_bc", "SlowBC", "slowness", 3.0),
    "frame_encoder": ("wide", "WIDE", "stride_of_first", 6),
    "task": ("dot", "TASK", None, None),
}
"""Kind: name, object, one of its options, and a value other than the default."""
ORIGIN = "their-parts 1.2"


@pytest.fixture
def python(tmp_path):
    """Runs Python with the package installed and returns its stdout."""
    site = tmp_path / "site"
    info = site / "their_parts-1.2.dist-info"
    info.mkdir(parents=True)
    (site / "their_parts.py").write_text(CODE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-parts\nVersion: 1.2\n")
    entries = (f"[vd4rl_pomdp.{kind}s]\n{name} = their_parts:{what}\n" for kind, (name, what, *_) in PARTS.items())
    (info / "entry_points.txt").write_text("\n".join(entries))
    environment = os.environ | {"PYTHONPATH": f"{site}{os.pathsep}{ROOT}", "COLUMNS": "200"}

    def run(*words: object) -> str:
        command = [sys.executable, *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def chosen(*kinds: str) -> list[object]:
    """Flags that choose the package's plug-ins of the given kinds and set their options."""
    words: list[object] = []
    for kind in kinds:
        name, _, option, value = PARTS[kind]
        words += [f"--{kind.replace('_', '-')}", name, f"--{option.replace('_', '-')}", value]
    return words


def test_installed_plugins_are_found_and_recorded_with_version(python, tmp_path):
    data, out = write_fake_set(tmp_path / "dot" / "random", [20, 25, 30], action_dim=2), tmp_path / "runs"
    common = ["--preset", "smoke", "--data", data]
    first, second = chosen("method", "corruption", "frame_encoder"), chosen("algorithm")
    python("-m", "vd4rl_pomdp", "pretrain", *first, *common, "--out", out / "pretrain")
    encoder = ["--encoder", out / "pretrain" / "encoder", "--workers", 1, "--eval-episodes", 2]
    python("-m", "vd4rl_pomdp", "finetune", *second, *encoder, *common, "--out", out / "finetune")
    of_encoders = ("corruption", "frame_encoder", "task")
    for stage, kinds, brought in (
        ("pretrain", ("method", *of_encoders), ()),
        ("finetune", ("algorithm",), ("method", *of_encoders)),
    ):
        record = json.loads((out / stage / "config.json").read_text())
        assert record["plugins"] == {f"{kind} {PARTS[kind][0]}": ORIGIN for kind in (*kinds, *brought)}
        assert record["sources"] == dict.fromkeys(record["plugins"], f"their_parts.py {file_hash(tmp_path)}")
        for name, _, option, value in (PARTS[kind] for kind in kinds):
            assert name in record["config"].values()
            assert option is None or record["config"][option] == value
    rows = (out / "finetune" / "episodes.csv").read_text().splitlines()[1:]
    assert len(rows) == 6, "two evaluations of two episodes, and a clean one"
    assert all(",dot," in row and ",slow_bc," in row and ",column," in row for row in rows)
    listed = {line.split()[0]: line for line in python("-m", "vd4rl_pomdp", "list").splitlines() if line.strip()}
    assert all(listed[name].endswith(f"[{ORIGIN}]") for name, *_ in PARTS.values())


def file_hash(place: Path) -> str:
    return sha256((place / "site" / "their_parts.py").read_bytes()).hexdigest()[:12]
