"""A run folder has one owner, resumes only the same run, and is identified by what it computes."""

import copy
import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.runs.test_checkpoint import killed_at
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import run as module
from vd4rl_pomdp.runs.files import read_json, write_csv, write_json
from vd4rl_pomdp.runs.run import RunFolder, identity, recipe


@dataclass(frozen=True)
class Config:
    out: Path
    data: Path = Path("data")
    seed: int = 0
    workers: int = 1
    log_every: int = 50


INPUTS = {"data": "abc"}


def begin(out: Path, inputs: dict[str, str] = INPUTS, **changes: object) -> RunFolder:
    return RunFolder(out, "stage", Config(out, **changes), inputs, collection={"task": "mine"})


def test_only_the_same_run_resumes(tmp_path):
    with begin(tmp_path) as run:
        assert not any(path.name.endswith(".tmp") for path in tmp_path.iterdir())
        run.finish()
    record = read_json(tmp_path / "config.json")
    assert (record["format"], record["stage"], record["inputs"]) == (module.FORMAT, "stage", INPUTS)
    assert (record["config"]["seed"], record["collection"]) == (0, {"task": "mine"})
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert before.keys() == {"config.json", "machine.json", "timing.json"}
    with begin(tmp_path, data=Path("moved"), workers=7, log_every=9) as again:
        assert again.finished
    with pytest.raises(UserError, match=r"a different config \(seed\)"):
        begin(tmp_path, seed=1)
    with pytest.raises(
        UserError, match=r"the content of --data data is not what this run started with \(abc, now xyz\)"
    ):
        begin(tmp_path, {"data": "xyz"})
    with pytest.raises(UserError, match=r"stage stage"):
        RunFolder(tmp_path, "other", Config(tmp_path), INPUTS)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    write_json(tmp_path / "config.json", record | {"format": 99})
    with pytest.raises(UserError, match=f"run of format 99, this version writes format {module.FORMAT}"):
        begin(tmp_path)


def test_run_without_a_later_setting_resumes_with_its_implied_value(tmp_path):
    @dataclass(frozen=True)
    class Later(Config):
        keep_newest: bool = False

    with begin(tmp_path):
        pass
    with RunFolder(tmp_path, "stage", Later(tmp_path), INPUTS):
        pass
    assert read_json(tmp_path / "config.json")["config"].get("keep_newest", False) is False
    with pytest.raises(UserError, match=r"a different config \(keep_newest\)"):
        RunFolder(tmp_path, "stage", Later(tmp_path, keep_newest=True), INPUTS)


@pytest.mark.parametrize("content", ["thesis.txt", "config.json"])
def test_foreign_folder_is_rejected(tmp_path, content):
    (tmp_path / content).write_text("{}")
    with pytest.raises(UserError, match="is not empty and holds no run"):
        begin(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [content]


def test_record_lists_machines_and_commits_of_resumptions(tmp_path, monkeypatch):
    now = {}
    monkeypatch.setattr(module, "machine", lambda device: {"processor": now["processor"]})
    monkeypatch.setattr(module, "git_commit", lambda: now["git_commit"])
    starts = [("A", "lost"), ("A", "one"), ("A", "one"), ("B", "one"), ("B", "one"), ("B", "two"), ("A", "one")]
    for processor, commit in starts:
        now |= {"processor": processor, "git_commit": commit}
        with begin(tmp_path) as run:
            if commit != "lost":
                run.save(1, {})
    record, machine = (read_json(tmp_path / f"{name}.json") for name in ("config", "machine"))
    later = [(part["processor"], part["git_commit"]) for part in machine["continued"]]
    assert (record["git_commit"], machine["processor"]) == ("one", "A")
    assert later == [("B", "one"), ("B", "two"), ("A", "one")]
    assert machine["continued"][0]["versions"] == record["versions"]


def test_run_in_use_is_rejected(tmp_path):
    with begin(tmp_path) as run:
        second = begin(tmp_path)
        with pytest.raises(UserError, match=f"in use by process {os.getpid()}"), second:
            pass
        run.finish()
    with second:
        assert second.finished


def _begin_and_save(out: Path) -> None:
    with begin(out) as run:
        run.save(1, {"step": 1})


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_run_killed_at_any_system_call_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "git_commit", lambda: "")  # else hundreds of subprocesses
    monkeypatch.setattr(module, "versions", dict)
    for number in range(1, 200):
        out = tmp_path / str(number)
        if not killed_at(number, lambda out=out: _begin_and_save(out)):
            break
        with begin(out) as run:
            assert json.loads((out / "config.json").read_text())["inputs"] == INPUTS
            assert (out / "machine.json").exists()
            run.restore(lambda state: None)
            run.save(2, {"step": 2})
    assert 10 < number < 199


def test_resuming_removes_the_mark_of_divergence(tmp_path):
    with begin(tmp_path) as run:
        run.mark_diverged(1, "loss is nan")
    assert (tmp_path / "diverged.json").exists()
    with begin(tmp_path):
        assert not (tmp_path / "diverged.json").exists()


def test_timing_adds_up_over_resumptions(tmp_path):
    with begin(tmp_path) as run:
        run._started -= 100.0
        run.save(1, {})
        run._started -= 1000.0  # after the checkpoint, so it is lost
    with begin(tmp_path) as again:
        again.restore(lambda state: None)
        again._started -= 10.0
        again.finish(total_seconds=again.seconds)
    timing = read_json(tmp_path / "timing.json")
    assert 110 <= timing["seconds"] < 200
    assert timing["total_seconds"] >= timing["seconds"] - 0.1


def test_files_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        with begin(tmp_path / "run") as run:
            run.save(1, {"step": 1})
            write_csv(tmp_path / "run" / "rows.csv", ["a"], [])
            modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "run").rglob("*")}
    finally:
        os.umask(before)
    assert {name for name, mode in modes.items() if mode not in (0o640, 0o750)} == set()
    assert {".lock", "1.pt", "config.json", "checkpoints"} < set(modes)


RECORD = {
    "format": 3,
    "stage": "finetune",
    "config": {"seed": 0, "updates": 40, "out": "a", "data": "d", "encoder": "e", "device": "auto", "log_every": 5},
    "inputs": {"data": "f00d", "encoder": "beef"},
}
CARD = {"settings": {"steps": 20, "method": "acro"}, "seed": 0, "data": "f00d"}
BOTH, NEITHER, IDENTITY = (True, True), (False, False), (False, True)
"""Whether a change gives another recipe and another identity."""


def _changed(value, place, new):
    value = inner = copy.deepcopy(value)
    *folders, name = place.split(".")
    for folder in folders:
        inner = inner[folder]
    inner[name] = new
    return value


@pytest.mark.parametrize(
    ("place", "new", "other"),
    [
        *(("config.out", "b", NEITHER), ("config.device", "cuda", NEITHER), ("config.log_every", 9, NEITHER)),
        *(("inputs.encoder", "x", NEITHER), ("inputs.data", "0ff", IDENTITY), ("card.data", "0ff", IDENTITY)),
        ("inputs.weights", "x", IDENTITY),
        *(("config.seed", 1, BOTH), ("config.updates", 41, BOTH), ("format", 4, BOTH), ("stage", "pretrain", BOTH)),
        *(("card.seed", 1, BOTH), ("card.settings.steps", 21, BOTH), ("card.settings.future_frames", "newest", BOTH)),
        # settings of later versions count only where they differ from the earlier behaviour
        *(("config.future_frames", "all", NEITHER), ("config.future_frames", "newest", BOTH)),
        *(("config.view_seed", None, NEITHER), ("config.view_seed", 0, BOTH), ("config.view_seed", 1, BOTH)),
    ],
)
def test_recipe_and_identity_depend_on_settings(place, new, other):
    changed = _changed(RECORD | {"card": CARD}, place, new)
    both = ((function(RECORD, CARD), function(changed, changed["card"])) for function in (recipe, identity))
    assert tuple(before != after for before, after in both) == other


def test_identity_hashes_image_folder_content():
    def named(exogenous, content):
        return identity(_changed(_changed(RECORD, "config.exogenous", exogenous), "inputs.exogenous", content), {})

    assert named("cifar", "f1") == named("cifar", "f1") != named("cifar", "f2")
    assert named("textures", "textures") == identity(_changed(RECORD, "config.exogenous", "textures"), {})
