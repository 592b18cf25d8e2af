"""A run folder: begun by one process, gone on with as the same run only."""

import json
import os
import pydoc
import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.helpers_data import write_fake_set
from tests.runs.test_checkpoint import killed_at
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.format import read_rows
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard, EncoderConfig
from vd4rl_pomdp.nn.encoder_folder import load_encoder, save_encoder
from vd4rl_pomdp.policies.actor import Actor, read_actor
from vd4rl_pomdp.runs import ownership
from vd4rl_pomdp.runs import run as module
from vd4rl_pomdp.runs.files import read_json, write_csv, write_json
from vd4rl_pomdp.runs.run import RunFolder


@dataclass(frozen=True)
class Config:
    out: Path
    data: Path = Path("data")
    seed: int = 0
    workers: int = 1
    log_every: int = 50


INPUTS = {"data": "abc"}


def begin(out: Path, inputs: dict[str, str] = INPUTS, **changes: object) -> RunFolder:
    return RunFolder(out, "stage", Config(out, **changes), inputs)


def test_the_record_holds_format_config_and_inputs(tmp_path):
    with begin(tmp_path):
        record = read_json(tmp_path / "config.json")
    assert record["format"] == module.FORMAT
    assert (record["stage"], record["inputs"], record["config"]["seed"]) == ("stage", INPUTS, 0)
    assert (tmp_path / "machine.json").exists()
    assert not list(tmp_path.glob(".*"))


def test_only_the_same_run_goes_on_wherever_its_data_lies(tmp_path):
    with begin(tmp_path) as run:
        run.finish()
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    with begin(tmp_path, data=Path("moved"), workers=7, log_every=9) as again:
        assert again.finished
    with pytest.raises(UserError, match=r"another config \(seed\)"):
        begin(tmp_path, seed=1)
    with pytest.raises(UserError, match=r"other content of --data \(data was abc and is xyz\); give it what it began"):
        begin(tmp_path, {"data": "xyz"})
    with pytest.raises(UserError, match=r"stage stage"):
        RunFolder(tmp_path, "other", Config(tmp_path), INPUTS)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


@dataclass(frozen=True)
class Later(Config):
    future_frames: str = "all"


def test_a_run_from_before_a_setting_goes_on_with_what_it_did(tmp_path):
    with begin(tmp_path) as run:
        run.finish()
    assert RunFolder(tmp_path, "stage", Later(tmp_path), INPUTS).finished
    with pytest.raises(UserError, match=r"another config \(future_frames\)"):
        RunFolder(tmp_path, "stage", Later(tmp_path, future_frames="newest"), INPUTS)


@pytest.mark.parametrize("stored", [1, 99])
def test_a_run_of_another_format_is_refused(tmp_path, stored):
    with begin(tmp_path):
        pass
    record = read_json(tmp_path / "config.json")
    write_json(
        tmp_path / "config.json",
        {k: v for k, v in record.items() if k != "format"} | ({"format": 99} if stored == 99 else {}),
    )
    with pytest.raises(UserError, match=f"run of format {stored}, this version writes format {module.FORMAT}"):
        begin(tmp_path)


@pytest.mark.parametrize("content", ["thesis.txt", "config.json"])
def test_a_folder_with_something_else_is_refused(tmp_path, content):
    (tmp_path / content).write_text("{}")
    with pytest.raises(UserError, match="is not empty and holds no run"):
        begin(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [content]


def test_what_a_run_goes_on_with_is_recorded_where_it_is_new(tmp_path, monkeypatch):
    now = {"processor": "A", "git_commit": "one"}
    monkeypatch.setattr(module, "machine", lambda device: {"processor": now["processor"]})
    monkeypatch.setattr(module, "git_commit", lambda: now["git_commit"])
    for processor, commit in (("A", "one"), ("A", "one"), ("B", "one"), ("B", "one"), ("B", "two"), ("A", "one")):
        now |= {"processor": processor, "git_commit": commit}
        with begin(tmp_path) as run:
            run.save(1, {})
    told = read_json(tmp_path / "machine.json")
    later = [(part["processor"], part["git_commit"]) for part in told["continued"]]
    assert (told["processor"], later) == ("A", [("B", "one"), ("B", "two"), ("A", "one")])
    assert told["continued"][0]["versions"] == read_json(tmp_path / "config.json")["versions"]
    monkeypatch.setattr(module, "code_of", lambda parts: {"plugins": {}, "sources": {"method mine": "mine.py 2"}})
    with begin(tmp_path):
        pass
    assert read_json(tmp_path / "config.json")["sources"] == {}
    assert read_json(tmp_path / "machine.json")["continued"][-1]["sources"] == {"method mine": "mine.py 2"}
    write_json(tmp_path / "machine.json", told | {"continued": 7})
    with pytest.raises(UserError, match=r"machine\.json: is damaged"), begin(tmp_path):
        pass


def test_the_record_of_a_run_that_has_kept_nothing_is_of_the_start_that_counts(tmp_path, monkeypatch):
    for commit, size in (("one", 1), ("two", 2), ("three", 2)):
        monkeypatch.setattr(module, "git_commit", lambda commit=commit: commit)
        monkeypatch.setattr(module, "machine", lambda device, commit=commit: {"processor": commit})
        told = {"plugins": {}, "sources": {"method mine": f"mine.py {size}"}}
        monkeypatch.setattr(module, "code_of", lambda parts, told=told: told)
        with begin(tmp_path) as run:
            if commit != "one":
                run.save(1, {})
    record, told = (read_json(tmp_path / f"{name}.json") for name in ("config", "machine"))
    assert (record["git_commit"], record["sources"], told["processor"]) == ("two", {"method mine": "mine.py 2"}, "two")
    assert [part["git_commit"] for part in told["continued"]] == ["three"]


def test_a_second_owner_is_refused_and_finds_the_end_of_the_first(tmp_path):
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
def test_a_run_that_is_killed_at_its_beginning_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(ownership, "EMPTY_S", 0.05)
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


def test_seconds_of_all_parts_add_up(tmp_path):
    with begin(tmp_path) as run:
        run._started -= 100.0
        run.save(1, {})
        run._started -= 1000.0  # lost with what follows the checkpoint
    with begin(tmp_path) as again:
        again.restore(lambda state: None)
        again._started -= 10.0
        again.finish(total_seconds=again.seconds)
    timing = read_json(tmp_path / "timing.json")
    assert 110 <= timing["seconds"] < 200
    assert timing["total_seconds"] >= timing["seconds"] - 0.1


def test_all_files_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        with begin(tmp_path / "run") as run:
            run.save(1, {"step": 1})
            write_csv(tmp_path / "run" / "rows.csv", ["a"], [])
            modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "run").rglob("*")}
    finally:
        os.umask(before)
    assert {name for name, mode in modes.items() if mode not in (0o640, 0o750)} == set()
    assert {".lock", ".owner.json", "state.safetensors", "config.json", "checkpoints"} < set(modes)


def test_what_may_not_be_read_is_not_called_damaged(tmp_path, monkeypatch):
    with begin(tmp_path) as run:
        run.save(1, {"step": 1})
    read = Path.read_bytes

    def refuse(path: Path) -> bytes:
        if path.name == "state.json":
            raise PermissionError(13, "Permission denied")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with (
        pytest.raises(UserError, match=r"state.json: may not be used \(permission denied\); ask its owner"),
        begin(tmp_path) as run,
    ):
        run.restore(lambda state: None)


READERS = {
    "model.safetensors": lambda folder: load_encoder(folder / "encoder"),
    "config.json": lambda folder: load_encoder(folder / "encoder"),
    "0_fake.hdf5": lambda folder: read_rows(folder / "set" / "0_fake.hdf5"),
    "reward.npy": lambda folder: open_dataset(folder / "set", folder / "cache"),
    "meta.json": lambda folder: open_dataset(folder / "set", folder / "cache"),
    "actor.safetensors": lambda folder: read_actor(folder / "actor.safetensors"),
}


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
    """An encoder, a set with its store, and an actor."""
    folder = tmp_path_factory.mktemp("foreign")
    config = EncoderConfig(channels=9, size=84, action_dim=6, frame_encoder="nature", feature_dim=8)
    card = EncoderCard("acro", "walker_walk", "expert", {"corruption": "none"}, 0, 1, "smoke")
    save_encoder(folder / "encoder", Encoder(config), card)
    open_dataset(write_fake_set(folder / "set"), folder / "cache")
    Actor({"mean.weight": np.zeros((3, 2), np.float32)}, {"task": "first_person"}).save(folder / "actor.safetensors")
    return folder


@pytest.mark.parametrize("name", READERS)
def test_a_file_of_someone_else_is_neither_called_damaged_nor_to_be_made_again(foreign, monkeypatch, name):
    def refusing(open_file):
        def refuse(path, *arguments, **options):
            if Path(os.fspath(path)).name == name:
                raise PermissionError(13, "Permission denied")
            return open_file(path, *arguments, **options)

        return refuse

    for place in ("io.open", "builtins.open", "h5py.File", "safetensors.safe_open"):
        monkeypatch.setattr(place, refusing(pydoc.locate(place)))
    with pytest.raises(UserError, match=rf"{name}: may not be used \(permission denied\); ask its owner for access"):
        READERS[name](foreign)
