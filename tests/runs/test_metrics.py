"""Metrics: means, metrics.jsonl, and its mirrors in wandb and TensorBoard, also for interrupted runs."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from tensorboardX.proto.event_pb2 import Event
from wandb.proto.wandb_internal_pb2 import Record

from finetune.train import finetune as run_finetune
from pretrain.train import pretrain as run_pretrain
from tests.helpers_stages import contents, run_until_cut, smoke_finetune, smoke_pretrain
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.metrics import Means, MetricsLog, mirrors_of, read_metrics, wandb_names
from vd4rl_pomdp.runs.run import RunFolder


@pytest.mark.parametrize("name", ["step", "eval/return/none"])
def test_reserved_metric_names_are_rejected(name):
    with pytest.raises(UserError, match=f"is called '{name}', which metrics.jsonl uses already"):
        Means().add({"loss": torch.tensor(1.0), name: torch.tensor(2.0)})


def test_means_copy_values_in_float32():
    means, weight = Means(), torch.nn.Parameter(torch.tensor(1.0))
    for _ in range(1000):
        means.add({"weight": weight, "half": torch.tensor(1.0, dtype=torch.bfloat16)})
    with torch.no_grad():
        weight.fill_(9.0)
    assert not any(total.requires_grad for total, _ in means.state_dict().values()), "an autograd graph is kept"
    assert means.take() == {"weight": 1.0, "half": 1.0}


def test_adding_metrics_does_not_synchronise():
    """Reading the value of a meta tensor raises; on a GPU reading would synchronise."""
    means = Means()
    for _ in range(2):
        means.add({"loss": torch.zeros((), device="meta")})
    with pytest.raises((NotImplementedError, RuntimeError)):
        means.take()


def test_resumed_log_drops_rows_after_checkpoint(tmp_path):
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


FINETUNE = {"updates": 4, "eval_every": 2, "checkpoint_every": 2, "batch_size": 4, "eval_length": 2, "log_every": 1}
LABELS = {"method": "mik+a", "task": "walker_walk", "quality": "expert", "corruption": "patch"}


@dataclass(frozen=True)
class Config:
    out: Path
    data: Path = Path("data")
    seed: int = 0
    max_k: int = 1
    wandb: str = "off"
    tensorboard: bool = False


def run_at(out: Path, **changes: Any) -> RunFolder:
    return RunFolder(out, "pretrain", Config(out, **changes), {"data": "abc"})


def open_log(run: RunFolder, step: int = 0) -> MetricsLog:
    run.path.mkdir(exist_ok=True)
    return MetricsLog(run.path / "metrics.jsonl", step, mirrors_of(run, LABELS, {}))


def wandb_records(run: Path) -> Iterator[Record]:
    """The records of a run's one .wandb file: LevelDB's log format, in blocks of 32 KiB, after a header of 7 bytes."""
    (file,) = run.glob("wandb/offline-run-*/*.wandb")
    content, place, whole = file.read_bytes(), 7, b""
    while place + 7 <= len(content):
        if (left := -place % 32768) and left < 7:
            place += left
        _, length, kind = struct.unpack("<IHB", content[place : place + 7])
        whole += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):
            yield Record.FromString(whole)
            whole = b""


def wandb_rows(run: Path) -> list[dict[str, float]]:
    records = wandb_records(run)
    rows = [{i.key or i.nested_key[0]: json.loads(i.value_json) for i in r.history.item} for r in records]
    return [{name: v for name, v in row.items() if not name.startswith("_")} for row in rows if row]


def tensorboard_numbers(run: Path) -> dict[tuple[str, int], float]:
    """Values by (tag, step) in the run's event file, whose records are prefixed by their length."""
    (file,) = (run / "tensorboard").iterdir()
    content, place, shown = file.read_bytes(), 0, {}
    while place < len(content):
        (length,) = struct.unpack("<Q", content[place : place + 8])
        event = Event.FromString(content[place + 12 : place + 12 + length])
        shown |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
        place += 16 + length
    return shown


def assert_all_mirrored(run: Path) -> list[dict[str, float]]:
    """Assert that both mirrors hold every row of metrics.jsonl once and in order, and return the rows."""
    rows = read_metrics(run / "metrics.jsonl")
    assert wandb_rows(run) == rows
    expected = {(n.replace("+", "_"), r["step"]): v for r in rows for n, v in r.items() if n != "step"}
    shown = tensorboard_numbers(run)
    assert shown.keys() == expected.keys()
    assert all(shown[place] == pytest.approx(expected[place], rel=1e-6) for place in expected)
    return rows


def test_trackers_get_config_and_all_rows_of_a_resumed_run(encoder, data, tmp_path, monkeypatch):
    changes = FINETUNE | {"wandb": "offline", "tensorboard": True}
    # tracked only after resuming
    run_until_cut(monkeypatch, 2, run_finetune, smoke_finetune(encoder, data, tmp_path / "run", **FINETUNE))
    run = run_finetune(smoke_finetune(encoder, data, tmp_path / "run", **changes)).path
    first = next(record.run for record in wandb_records(run) if record.HasField("run"))
    assert first.run_id == (run / "wandb" / "id").read_text()
    assert (first.project, first.job_type) == ("vd4rl-pomdp", "finetune")
    assert {"finetune", "mik+a", "patch+zero_frames", "walker_walk", "expert", "td3_bc"} == set(first.tags)
    config = {item.key: json.loads(item.value_json) for item in first.config.update}
    stored = json.loads((run / "config.json").read_text())
    assert (stored["config"] | {"wandb": "offline", "tensorboard": True}).items() <= config.items()
    labels = {name: config[name] for name in ("method", "corruption", "task", "quality", "stage")}
    assert labels == {**LABELS, "corruption": "patch+zero_frames", "stage": "finetune"}
    assert config["pretraining"] == json.loads((encoder / "config.json").read_text())["pretrain"]
    rows = assert_all_mirrored(run)
    assert "eval/score/none" in rows[-1]
    untracked = contents(run_finetune(smoke_finetune(encoder, data, tmp_path / "untracked", **FINETUNE)).path)
    tracked = contents(run)
    assert [name for name in untracked if untracked[name] != tracked.get(name)] == ["config.json"], "only flags differ"


KILLED = """
import os, signal, sys
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.runs.metrics import MetricsLog
write = MetricsLog.write
def kill_at_40(self, step, metrics):
    write(self, step, metrics)
    if step == 40:
        os.kill(os.getpid(), signal.SIGKILL)
MetricsLog.write = kill_at_40
if __name__ == "__main__":
    main(sys.argv[1:])
"""


def test_trackers_get_all_rows_of_a_killed_run(data, tmp_path):
    out, script = tmp_path / "run", tmp_path / "killed.py"
    script.write_text(KILLED)
    changes = {"method": "no_history", "log_every": 1, "checkpoint_every": 30, "steps": 50, "wandb": "offline"}
    words = ["pretrain", "--preset", "smoke", "--data", data, "--out", out, "--corruption", "patch", "--tensorboard"]
    words += [word for name, value in changes.items() for word in (f"--{name.replace('_', '-')}", value)]
    apart = {name: value for name, value in os.environ.items() if name != "WANDB_SERVICE"}  # not this process's
    command = [sys.executable, script, *words]
    killed = subprocess.run(list(map(str, command)), env=apart | {"PYTHONPATH": os.getcwd()}, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert len(read_metrics(out / "metrics.jsonl")) == 40
    run_pretrain(smoke_pretrain(data, out, corruption="patch", tensorboard=True, **changes))
    assert [row["step"] for row in assert_all_mirrored(out)] == list(range(1, 51))


@pytest.fixture
def wandb(monkeypatch) -> MagicMock:
    """Stands in for wandb; its `init` returns a run whose server knows no row."""
    monkeypatch.setitem(sys.modules, "wandb", fake := MagicMock())
    fake.init.return_value.summary = {}
    return fake


@pytest.mark.parametrize("place", ["init", "log", "finish"])
def test_wandb_failure_warns_once(tmp_path, wandb, capsys, place):
    faulty = wandb.init if place == "init" else getattr(wandb.init.return_value, place)
    faulty.side_effect = RuntimeError(f"{place}\nbroke")
    log = open_log(run_at(tmp_path, wandb="online"))
    for step in (1, 2, 3):
        log.write(step, {"loss": 0.5})
    log.close()
    warnings = capsys.readouterr().err.splitlines()
    assert warnings == [f"warning: wandb fails ({place} broke); the run continues, and {tmp_path} has all metrics"]
    assert faulty.call_count == 1
    assert len(read_metrics(tmp_path / "metrics.jsonl")) == 3


def test_tensorboard_failure_warns_once(tmp_path, monkeypatch, capsys):
    """Runs in this thread: tensorboardX's writer would wait for a thread that died."""
    log = open_log(run_at(tmp_path, tensorboard=True))

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tensorboardX.event_file_writer.EventsWriter.flush", full)
    for step in range(1, 9):
        log.write(step, {"loss": 1.0})
    log.close()
    assert capsys.readouterr().err.count("warning: TensorBoard fails ([Errno 28] No space left on device)") == 1


@pytest.mark.parametrize(
    ("changes", "module"), [({"wandb": "offline"}, "wandb"), ({"tensorboard": True}, "tensorboardX")]
)
def test_missing_tracker_names_its_extra(tmp_path, monkeypatch, capsys, changes, module):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    open_log(run_at(tmp_path, **changes)).write(1, {"loss": 0.5})
    assert "; `pip install '.[tracking]'` in the package's folder); the run continues" in capsys.readouterr().err
    assert read_metrics(tmp_path / "metrics.jsonl") == [{"step": 1, "loss": 0.5}]


def test_resumed_online_run_sends_missing_rows(tmp_path, wandb):
    run, other = (run_at(tmp_path / name, wandb="online") for name in "ab")
    log, tracked = open_log(run), wandb.init.return_value
    for step in (1, 2, 3, 5):
        log.write(step, {"loss": step / 10})
    tracked.summary = {"step": 3, "loss": 0.3}
    tracked.log.reset_mock()
    open_log(run, 5).write(6, {"loss": 0.6})
    assert [call.args[0]["step"] for call in tracked.log.call_args_list] == [3, 5, 6]
    open_log(other)
    asked = [call.kwargs for call in wandb.init.call_args_list]
    assert asked[0]["id"] == asked[1]["id"] != asked[2]["id"]
    assert all((words["resume"], words["mode"]) == ("allow", "online") for words in asked)


def test_seeds_share_a_wandb_group(tmp_path):
    one, other, wide = (wandb_names(run_at(tmp_path, **c), LABELS, {}) for c in ({}, {"seed": 1}, {"max_k": 15}))
    assert one["group"] == other["group"] != wide["group"]
    assert (one["name"], other["name"]) == tuple(f"pretrain mik+a walker_walk expert patch seed {i}" for i in (0, 1))
    card = {"settings": {"max_k": 1}, "seed": 0, "method": "mik+a"}
    cards = [card, card | {"seed": 1}, card | {"settings": {"max_k": 2}}]
    assert len({wandb_names(run_at(tmp_path), LABELS, card)["group"] for card in cards}) == 2
