"""What wandb and TensorBoard get of a run, also of one that was cut, and that nothing which fails there reaches it."""

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
from types import ModuleType
from typing import Any

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog
from wandb.proto.wandb_internal_pb2 import Record

from finetune.train import finetune as run_finetune
from pretrain.train import pretrain as run_pretrain
from tests.helpers_stages import CutError, contents, cut_at, smoke_finetune, smoke_pretrain
from vd4rl_pomdp.runs.metrics import MetricsLog, read_metrics
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.runs.sinks import names, open_sinks

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


def wandb_records(file: Path) -> Iterator[Record]:
    """The records of a .wandb file: LevelDB's log format, in blocks of 32 KiB, after a header of 7 bytes."""
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


def wandb_parts(run: Path) -> list[tuple[Any, list[dict[str, float]]]]:
    """Of each part of a run: its run record, and its rows."""
    parts = []
    for file in sorted(run.glob("wandb/offline-run-*/*.wandb")):
        records = list(wandb_records(file))
        rows = [{i.key or i.nested_key[0]: json.loads(i.value_json) for i in r.history.item} for r in records]
        rows = [{name: v for name, v in row.items() if not name.startswith("_")} for row in rows if row]
        parts.append((next(r.run for r in records if r.HasField("run")), rows))
    return parts


def events(run: Path) -> list[Event]:
    """All whole events of a run's files, in the order of writing; each record is framed by its length."""
    found = []
    for file in sorted((run / "tensorboard").iterdir(), key=lambda path: path.stat().st_mtime_ns):
        content, place = file.read_bytes(), 0
        while place < len(content):
            (length,) = struct.unpack("<Q", content[place : place + 8].ljust(8, b"\xff"))
            if place + 16 + length > len(content):
                break
            found.append(Event.FromString(content[place + 12 : place + 12 + length]))
            place += 16 + length
    return found


def shown_numbers(run: Path) -> tuple[list[int], dict[tuple[str, int], float]]:
    """Where the parts of a run begin, and what TensorBoard shows: a beginning hides later steps of earlier parts."""
    starts: list[int] = []
    shown: dict[tuple[str, int], float] = {}
    for event in events(run):
        if event.session_log.status == SessionLog.START:
            starts.append(event.step)
            shown = {place: value for place, value in shown.items() if place[1] < event.step}
        shown |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
    return starts, shown


def assert_all_shown(run: Path, shown: dict[tuple[str, int], float]) -> None:
    rows = read_metrics(run / "metrics.jsonl")
    expected = {(n.replace("+", "_"), r["step"]): v for r in rows for n, v in r.items() if n != "step"}
    assert shown.keys() == expected.keys()
    assert all(shown[place] == pytest.approx(expected[place], rel=1e-6) for place in expected)


def sorted_rows(rows: list[dict[str, float]]) -> list[str]:
    return sorted(json.dumps(row, sort_keys=True) for row in rows)


def cut_and_go_on(monkeypatch, config: Any) -> Path:
    with monkeypatch.context() as patch:
        cut_at(patch, 2)
        with pytest.raises(CutError):
            run_finetune(config)
    return run_finetune(config).path


@pytest.mark.usefixtures("own_cache")
def test_wandb_gets_the_whole_config_and_every_row_of_one_run(encoder, data, tmp_path, monkeypatch):
    run = cut_and_go_on(monkeypatch, smoke_finetune(encoder, data, tmp_path / "run", wandb="offline", **FINETUNE))
    (first, before), (second, after) = wandb_parts(run)
    assert first.run_id == second.run_id == (run / "wandb" / "id").read_text()
    assert (first.project, first.job_type) == ("vd4rl-pomdp", "finetune")
    assert {"finetune", "mik+a", "patch+zero_frames", "walker_walk", "expert", "td3_bc"} == set(first.tags)
    config = {item.key: json.loads(item.value_json) for item in first.config.update}
    stored = json.loads((run / "config.json").read_text())
    assert stored["config"].items() <= config.items()
    told = {name: config[name] for name in ("method", "corruption", "task", "quality", "stage")}
    assert told == {**LABELS, "corruption": "patch+zero_frames", "stage": "finetune"}
    pretrained = json.loads((encoder / "config.json").read_text())["pretrain"]
    assert config["pretraining"] == pretrained
    assert config["pretraining"]["settings"]["max_k"] == 3
    rows = read_metrics(run / "metrics.jsonl")
    untracked = contents(run_finetune(smoke_finetune(encoder, data, tmp_path / "untracked", **FINETUNE)).path)
    del untracked["config.json"]
    assert untracked.items() <= contents(run).items()
    assert sorted_rows(before + after) == sorted_rows(rows)
    assert before
    assert after[-1] == rows[-1]
    assert "eval/score/none" in rows[-1]


@pytest.mark.usefixtures("own_cache")
def test_tensorboard_gets_every_row_and_hides_what_a_cut_run_writes_again(encoder, data, tmp_path, monkeypatch):
    run = cut_and_go_on(monkeypatch, smoke_finetune(encoder, data, tmp_path / "run", tensorboard=True, **FINETUNE))
    starts, shown = shown_numbers(run)
    assert starts == [1, 3]
    assert_all_shown(run, shown)


KILLED = """
import os, signal, sys
from pathlib import Path
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.runs.metrics import MetricsLog
write = MetricsLog.write
def kill_at_40(self, step, metrics):
    write(self, step, metrics)
    if step == 40:
        for children in Path("/proc/self/task").glob("*/children"):  # wandb's process, which might still write
            for child in children.read_text().split():
                os.kill(int(child), signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGKILL)
MetricsLog.write = kill_at_40
if __name__ == "__main__":
    main(sys.argv[1:])
"""


def assert_all_logged(run: Path) -> list[dict[str, float]]:
    """All rows of a run's metrics.jsonl are in wandb's files, each once and with its step; returns them."""
    rows = read_metrics(run / "metrics.jsonl")
    assert sorted_rows([row for _, part in wandb_parts(run) for row in part]) == sorted_rows(rows)
    return rows


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="this system does not list children")
@pytest.mark.usefixtures("own_cache")
def test_a_killed_run_lacks_no_row_once_it_is_resumed(data, tmp_path):
    out, script = tmp_path / "run", tmp_path / "killed.py"
    script.write_text(KILLED)
    changes = {"method": "no_history", "log_every": 1, "checkpoint_every": 30, "steps": 50, "wandb": "offline"}
    words = ["pretrain", "--preset", "smoke", "--data", data, "--out", out, "--corruption", "patch", "--tensorboard"]
    words += [word for name, value in changes.items() for word in (f"--{name.replace('_', '-')}", value)]
    command = [sys.executable, script, *words]
    unflushed = {"WANDB__TRANSACTION_LOG_FLUSH_INTERVAL": "0"}  # else a slow machine's wandb may have written them
    apart = {name: value for name, value in os.environ.items() if name != "WANDB_SERVICE"}  # a process of its own
    environment = apart | {"PYTHONPATH": os.getcwd()} | unflushed
    killed = subprocess.run(list(map(str, command)), env=environment, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert len(read_metrics(out / "metrics.jsonl")) == 40
    (file,) = out.glob("wandb/offline-run-*/*.wandb")
    assert sum(record.HasField("history") for record in wandb_records(file)) < 30  # it lacks rows before the checkpoint
    run_pretrain(smoke_pretrain(data, out, corruption="patch", tensorboard=True, **changes))
    assert [row["step"] for row in assert_all_logged(out)] == list(range(1, 51))
    assert_all_shown(out, shown_numbers(out)[1])


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize("left", [0.001, 0.5, 0.9999])
def test_files_that_end_within_a_record_are_mended_and_their_rows_written_again(data, tmp_path, monkeypatch, left):
    """`wandb sync` reads nothing of a folder with a part that names no run, and nothing behind a cut record."""
    changes = {"method": "no_history", "log_every": 1, "checkpoint_every": 8, "steps": 24}
    config = smoke_pretrain(data, tmp_path / "run", wandb="offline", tensorboard=True, **changes)
    with monkeypatch.context() as patch:
        cut_at(patch, 2)
        with pytest.raises(CutError):
            run_pretrain(config)
    (first,) = config.out.glob("wandb/offline-run-*/*.wandb")
    (events_file,) = config.out.glob("tensorboard/*")
    cut = {file: int(left * file.stat().st_size) for file in (first, events_file)}
    for file, size in cut.items():
        os.truncate(file, size)
    run_pretrain(config)
    assert_all_logged(config.out)
    assert_all_shown(config.out, shown_numbers(config.out)[1])
    assert first.exists() == (left >= 0.5)
    assert not first.exists() or first.stat().st_size < cut[first]


@pytest.mark.usefixtures("own_cache")
def test_a_run_that_is_mirrored_from_its_second_part_on_is_mirrored_whole(data, tmp_path, monkeypatch):
    changes = {"method": "no_history", "log_every": 1, "checkpoint_every": 2, "steps": 6}
    with monkeypatch.context() as patch:
        cut_at(patch, 2)
        with pytest.raises(CutError):
            run_pretrain(smoke_pretrain(data, tmp_path / "run", **changes))
    run = run_pretrain(smoke_pretrain(data, tmp_path / "run", wandb="offline", tensorboard=True, **changes)).path
    assert len(assert_all_logged(run)) == 6
    assert_all_shown(run, shown_numbers(run)[1])


class Faulty(ModuleType):
    """A wandb that fails at one of its calls."""

    def __init__(self, place: str) -> None:
        super().__init__("wandb")
        self._place = place
        self.calls: list[str] = []
        self.summary: dict[str, float] = {}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*_: Any, **__: Any) -> Any:
            self.calls.append(name)
            if name == self._place:
                raise RuntimeError(f"{name}\nbroke")
            return self

        return call


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize("place", ["Settings", "init", "define_metric", "log", "finish"])
def test_a_failing_wandb_warns_once_and_changes_nothing(data, tmp_path, monkeypatch, capsys, place):
    changes = {"method": "no_history", "steps": 4, "log_every": 1, "checkpoint_every": 2}
    whole = run_pretrain(smoke_pretrain(data, tmp_path / "whole", **changes)).path
    monkeypatch.setitem(sys.modules, "wandb", faulty := Faulty(place))
    tracked = run_pretrain(smoke_pretrain(data, tmp_path / "tracked", wandb="online", **changes)).path
    warnings = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert warnings == [f"warning: wandb fails ({place} broke); the run goes on, {tracked} has it all"]
    assert faulty.calls.count(place) == 1
    expected = contents(whole)
    assert {name: content for name, content in contents(tracked).items() if name in expected} | {
        "config.json": expected["config.json"]
    } == expected


def test_a_disk_that_fills_under_tensorboard_warns_once(tmp_path, monkeypatch, capsys):
    """In this thread: tensorboardX's writer would wait for one that has died."""
    (sink,) = open_sinks(run_at(tmp_path, tensorboard=True), LABELS, {})
    sink.write(1, {"loss": 1.0})

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tensorboardX.event_file_writer.EventsWriter.flush", full)
    for step in range(2, 30):
        sink.write(step, {"loss": 1.0})
    sink.close()
    assert capsys.readouterr().err.count("warning: TensorBoard fails ([Errno 28] No space left on device)") == 1


@pytest.mark.parametrize(
    ("changes", "module"), [({"wandb": "offline"}, "wandb"), ({"tensorboard": True}, "tensorboardX")]
)
def test_what_is_not_installed_is_named_with_what_brings_it(tmp_path, monkeypatch, capsys, changes, module):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    log = MetricsLog(tmp_path / "metrics.jsonl", 0, open_sinks(run_at(tmp_path, **changes), LABELS, {}))
    log.write(1, {"loss": 0.5})
    log.close()
    assert "; `pip install '.[tracking]'` in the package's folder); the run goes on" in capsys.readouterr().err
    assert read_metrics(tmp_path / "metrics.jsonl") == [{"step": 1, "loss": 0.5}]


def test_a_run_that_goes_on_online_is_the_same_run_of_wandb(tmp_path, monkeypatch):
    asked: list[dict[str, Any]] = []
    monkeypatch.setitem(sys.modules, "wandb", fake := Faulty("nothing"))
    fake.init = lambda **words: asked.append(words) or fake  # type: ignore[attr-defined]
    one, other = (run_at(tmp_path / folder, wandb="online") for folder in "ab")
    for run in (one, one, other):
        open_sinks(run, LABELS, {})
    ids = [words["id"] for words in asked]
    assert ids[0] == ids[1] != ids[2]
    assert all((words["resume"], words["mode"]) == ("allow", "online") for words in asked)


def test_online_rows_are_sent_again_from_the_last_step_on_that_the_server_has(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", fake := Faulty("nothing"))
    fake.summary, sent = {"step": 3, "loss": 0.3}, []
    fake.log = lambda row: sent.append(row["step"])  # type: ignore[attr-defined]
    (sink,) = open_sinks(run_at(tmp_path, wandb="online"), LABELS, {})
    sink.resume(5, [{"step": step, "loss": step / 10} for step in (1, 2, 3, 5)])
    sink.write(6, {"loss": 0.6})
    assert sent == [3, 5, 6]


def test_seeds_of_one_experiment_share_a_group_and_other_settings_do_not(tmp_path):
    one, other, wide = (names(run_at(tmp_path, **c), LABELS, {}) for c in ({}, {"seed": 1}, {"max_k": 15}))
    assert one["group"] == other["group"] != wide["group"]
    assert (one["name"], other["name"]) == tuple(f"pretrain mik+a walker_walk expert patch seed {i}" for i in (0, 1))
    card = {"settings": {"max_k": 1}, "seed": 0, "method": "mik+a"}
    groups = {names(run_at(tmp_path), LABELS, card | c)["group"] for c in ({}, {"seed": 1}, {"settings": {"max_k": 2}})}
    assert len(groups) == 2


def test_names_are_as_long_as_wandb_takes(tmp_path):
    told = names(run_at(tmp_path, seed=2**31 - 1), LABELS | {"method": "m" * 300}, {})
    assert (len(told["name"]), len(told["group"]), max(map(len, told["tags"]))) == (128, 128, 64)
    assert told["name"].endswith(" seed 2147483647")
