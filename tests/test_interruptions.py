"""All stages survive full disks, signals, concurrent starts and changed inputs, and resume bit-exactly."""

import errno
import multiprocessing
import os
import resource
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import finetune.trainer
from finetune.algorithms import bc, td3_bc
from finetune.features import _ENCODED, FrozenEncoder
from finetune.train import finetune as run_finetune
from pretrain.train import Trainer
from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import fake_rows, write_fake_set, write_rows
from tests.helpers_stages import contents, smoke_finetune, smoke_pretrain
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.runs.interrupt import Terminated
from vd4rl_pomdp.runs.loop import Loop
from vd4rl_pomdp.runs.metrics import EVALUATION, read_metrics
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.studies.navigation.collect import MazeCollectConfig
from vd4rl_pomdp.studies.navigation.collect import collect as collect_maze
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.runs import RAW_PREFIX
from vd4rl_pomdp.studies.navigation.train import COMPONENTS
from vd4rl_pomdp.studies.navigation.train import train as run_navigation

FINETUNE = {
    "eval_episodes": 2,
    "updates": 12,
    "eval_every": 6,
    "checkpoint_every": 4,
    "batch_size": 4,
    "eval_length": 2,
    "log_every": 3,
}


@pytest.fixture(scope="module")
def finetuned(data, encoder, tmp_path_factory) -> Path:
    """A finished run with `FINETUNE`."""
    return run_finetune(smoke_finetune(encoder, data, tmp_path_factory.mktemp("finetuned") / "run", **FINETUNE)).path


@pytest.fixture(scope="module")
def maze(tmp_path_factory) -> Path:
    """A maze dataset with random frames."""
    rows = fake_rows([30] * 4, action_dim=2, noise=100)
    rows["physics"] = np.random.default_rng(0).normal(size=(120, 4))
    return write_rows(tmp_path_factory.mktemp("maze"), rows, {"task": "three_curtains"})


Stage = tuple[Callable[[Any], Any], Callable[[Path], Any], Any]
"""The stage's function, its config for a folder, and the class whose `update` is one step."""


@pytest.fixture(params=["pretrain", "finetune", "navigation"], scope="module")
def stage(request) -> Stage:
    if request.param == "navigation":
        given = {"steps": 8, "log_every": 4, "checkpoint_every": 4, "precision": "fp32"}
        config = NavigationConfig.of("smoke", data=request.getfixturevalue("maze"), **given)
        return run_navigation, lambda out: replace(config, out=out), Trainer
    data = request.getfixturevalue("data")
    if request.param == "pretrain":
        changes = {"method": "no_history", "checkpoint_every": 4}
        return run_pretrain, lambda out: smoke_pretrain(data, out, **changes), Trainer
    encoder, changes = request.getfixturevalue("encoder"), FINETUNE | {"algorithm": "bc"}
    return run_finetune, lambda out: smoke_finetune(encoder, data, out, **changes), bc.BC


@pytest.fixture(scope="module")
def whole(stage, tmp_path_factory) -> dict[str, str]:
    """Files of an uninterrupted run."""
    run, config, _ = stage
    return contents(run(config(tmp_path_factory.mktemp("whole") / "run")).path)


def at_update(monkeypatch, learner: Any, number: int, then: Callable[[], None]) -> None:
    """Call `then` at the start of a run's update `number`."""
    update, calls = learner.update, []

    def changed(self, *arguments):
        calls.append(1)
        if len(calls) == number:
            then()
        return update(self, *arguments)

    monkeypatch.setattr(learner, "update", changed)


def test_run_resumes_bit_exactly_after_sigterm(stage, whole, tmp_path, monkeypatch):
    run, config, learner = stage
    with monkeypatch.context() as patch:
        at_update(patch, learner, 7, lambda: signal.raise_signal(signal.SIGTERM))
        with pytest.raises(Terminated):
            run(config(tmp_path / "cut"))
    assert max(int(path.stem) for path in (tmp_path / "cut" / "checkpoints").iterdir()) == 7
    assert not list((tmp_path / "cut").glob(".*"))
    run(config(tmp_path / "cut"))
    assert contents(tmp_path / "cut") == whole


def test_run_resumes_bit_exactly_after_sigkill(stage, whole, tmp_path):
    """Killed between two checkpoints."""
    run, config, learner = stage

    def killed() -> None:
        at_update(pytest.MonkeyPatch(), learner, 6, lambda: os.kill(os.getpid(), signal.SIGKILL))
        run(config(tmp_path / "cut"))

    child = multiprocessing.get_context("fork").Process(target=killed)
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert [path.name for path in (tmp_path / "cut" / "checkpoints").iterdir()] == ["4.pt"]
    run(config(tmp_path / "cut"))
    assert contents(tmp_path / "cut") == whole


def rows_of_means(steps: list[dict[str, torch.Tensor]], every: int) -> list[dict[str, float]]:
    """Means of each scalar over the steps that logged it, for every `every` steps and the rest."""
    rows = []
    for start in range(0, len(steps), every):
        part = steps[start : start + every]
        given = {name: [logs[name].item() for logs in part if name in logs] for logs in part for name in logs}
        means = {name: sum(values) / len(values) for name, values in given.items()}
        rows.append({"step": start + len(part)} | means)
    return rows


def test_metric_rows_are_means_since_the_previous_row(stage, tmp_path, monkeypatch):
    """Also if a signal ends the run between two rows and two checkpoints."""
    run, config, learner = stage
    config = replace(config(tmp_path / "run"), log_every=4, checkpoint_every=3)
    if learner is bc.BC:
        config, learner = type(config).of(**flat(config) | {"algorithm": "td3_bc"}), td3_bc.TD3BC
    update, steps = learner.update, []

    def watched(self, *arguments):
        if len(steps) == 4:
            signal.raise_signal(signal.SIGTERM)
        given = update(self, *arguments)
        steps.append(given[0] if isinstance(given, tuple) else given)
        return given

    monkeypatch.setattr(learner, "update", watched)
    with pytest.raises(Terminated):
        run(config)
    assert len(steps) == 5
    run(config)
    rows = read_metrics(config.out / "metrics.jsonl")
    found = [row for row in rows if not any(name.startswith(EVALUATION) for name in row)]
    expected = rows_of_means(steps, 4)
    assert {name for logs in steps for name in logs} == {name for row in expected for name in row} - {"step"}
    for row, means in zip(found, expected, strict=True):
        assert {name: row[name] for name in means} == pytest.approx(means, rel=1e-5)
        errors = {f"{what}{rows}" for what in COMPONENTS for rows in ("", "_hidden")}
        assert set(row) - set(means) <= errors | {f"{RAW_PREFIX}{error}" for error in errors}


def test_nan_loss_ends_the_run(stage, tmp_path, monkeypatch):
    """Later steps are finite, and the row is written later."""
    run, config, learner = stage
    update, calls = learner.update, []

    def diverging(self, *arguments):
        calls.append(1)
        given = update(self, *arguments)
        logs = given[0] if isinstance(given, tuple) else given
        if len(calls) == 1:
            logs[next(iter(logs))] = torch.tensor(float("nan"))
        return given

    monkeypatch.setattr(learner, "update", diverging)
    with pytest.raises(FloatingPointError, match=r"is nan in the row of step [345]"):
        run(config(tmp_path / "run"))
    assert len(calls) > 1


def fill_disk(monkeypatch, end: str, number: int) -> None:
    """Fill the disk while writing the `number`-th file whose name ends with `end`."""
    write, calls = Path.write_bytes, []

    def limited(path: Path, content: bytes) -> int:
        calls.extend([1] * path.name.endswith(end))
        if path.name.endswith(end) and len(calls) == number:
            write(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", limited)


@pytest.mark.parametrize(("end", "number"), [(".pt.tmp", 2), (".model.safetensors.tmp", 1)])
def test_run_resumes_bit_exactly_after_full_disk(stage, whole, tmp_path, monkeypatch, end, number):
    run, config, _ = stage
    with monkeypatch.context() as patch:
        fill_disk(patch, end, number)
        with pytest.raises(UserError, match="the disk is full: free some space and re-run the same command"):
            run(config(tmp_path / "cut"))
    run(config(tmp_path / "cut"))
    assert contents(tmp_path / "cut") == whole


def test_run_resumes_after_full_disk_at_start(data, tmp_path, monkeypatch):
    config = smoke_pretrain(data, tmp_path / "run", method="no_history")
    write = Path.write_text

    def full(path: Path, content: str, **options: Any) -> int:
        if path.name == ".machine.json.tmp":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, content, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(UserError, match="the disk is full"):
            run_pretrain(config)
    assert run_pretrain(config).finished


def test_stages_reject_a_run_in_use(stage, tmp_path):
    run, config, _ = stage
    with owned(tmp_path / "run"), pytest.raises(UserError, match="run: is in use by process"):
        run(config(tmp_path / "run"))
    assert not list((tmp_path / "run").iterdir())


def test_collections_reject_a_dataset_in_use(tmp_path):
    configs = [
        (collect, CollectConfig("walker_walk", "random", tmp_path / "set", workers=1)),
        (collect_maze, MazeCollectConfig.of("smoke", maze="no_curtain", out=tmp_path / "set", workers=1)),
    ]
    for run, config in configs:
        with owned(tmp_path / "set"), pytest.raises(UserError, match="set: is in use by process"):
            run(config)
        assert not list((tmp_path / "set").iterdir())


def test_resuming_with_changed_inputs_is_rejected(encoder, finetuned, data, tmp_path):
    other = write_fake_set(tmp_path / "other" / "walker_walk" / "expert", [20, 30, 25])
    acro = run_pretrain(smoke_pretrain(data, tmp_path / "acro", method="acro")).path / "encoder"
    inputs = read_json(finetuned / "config.json")["inputs"]
    fingerprint = open_dataset(data).fingerprint
    assert read_json(encoder / "config.json")["pretrain"]["data"] == inputs["data"] == fingerprint
    assert read_json(encoder.parent / "config.json")["inputs"] == {"data": fingerprint}
    pretraining = shutil.copytree(encoder.parent, tmp_path / "pretrain")
    finetuning = shutil.copytree(finetuned, tmp_path / "finetune")
    attempts = [
        (run_pretrain, smoke_pretrain(other, pretraining), "data"),
        (run_finetune, smoke_finetune(encoder, other, finetuning, **FINETUNE), "data"),
        (run_finetune, smoke_finetune(acro, data, finetuning, **FINETUNE), "encoder"),
    ]
    for finished in (True, False):
        before = contents(tmp_path)
        for run, config, name in attempts:
            with pytest.raises(UserError, match=f"the content of --{name} .* is not what this run started"):
                run(config)
        assert contents(tmp_path) == before
        if finished:
            moved = shutil.copytree(encoder, tmp_path / "moved")
            assert run_finetune(smoke_finetune(moved, data, finetuning, **FINETUNE)).finished
            (pretraining / "timing.json").unlink()
            (finetuning / "timing.json").unlink()


def test_run_without_checkpoints_keeps_its_evaluations(encoder, finetuned, data, tmp_path):
    config = smoke_finetune(encoder, data, shutil.copytree(finetuned, tmp_path / "run"), **FINETUNE)
    (config.out / "timing.json").unlink()
    shutil.rmtree(config.out / "checkpoints")
    before = (config.out / "episodes.csv").read_bytes()
    with pytest.raises(UserError, match=r"run: has evaluations, but their checkpoints are missing: restore them"):
        run_finetune(config)
    assert (config.out / "episodes.csv").read_bytes() == before


def test_features_are_encoded_once_over_resumptions(encoder, finetuned, data, tmp_path, monkeypatch):
    config = smoke_finetune(encoder, data, tmp_path / "cut", **FINETUNE)
    encode, encoded = FrozenEncoder.frames, []
    monkeypatch.setattr(FrozenEncoder, "frames", lambda *words: (encoded.append(words), encode(*words))[1])
    with monkeypatch.context() as patch:
        fill_disk(patch, ".pt.tmp", 1)
        _ENCODED.clear()
        with pytest.raises(UserError):
            run_finetune(config)
    _ENCODED.clear()  # as in another process
    run_finetune(config)
    assert len(encoded) == 3, "one call per episode"
    assert not (config.out / "features.npy").exists()
    assert contents(config.out) == contents(finetuned)


def test_failed_append_leaves_a_run_unchanged(finetuned, tmp_path):
    path = shutil.copy(finetuned / "episodes.csv", tmp_path / "episodes.csv")
    before, rows = path.read_bytes(), read_episodes(path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 100, limits[1]))  # in the second row
    try:
        with pytest.raises(UserError, match="file too large"):
            append_episodes(path, rows)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before


@pytest.mark.parametrize(("evaluation", "rows_written"), [(1, 1), (2, 2), (2, None)])
def test_interrupted_evaluation_is_repeated(encoder, finetuned, data, tmp_path, monkeypatch, evaluation, rows_written):
    """Also in the last evaluation, which includes clean episodes, and after its row of metrics."""
    config = smoke_finetune(encoder, data, tmp_path / "cut", **FINETUNE)
    append, evaluations = finetune.trainer.append_episodes, []

    def cut(path: Path, rows: list[dict[str, Any]]) -> None:
        evaluations.append(rows)
        if len(evaluations) < evaluation or rows_written is None:
            append(path, rows)
            return
        append(path, rows[:rows_written])
        raise KeyboardInterrupt

    def show(self, **shown: float) -> None:
        if len(evaluations) == evaluation:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(finetune.trainer, "append_episodes", cut)
        patch.setattr(Loop, "show", show)
        with pytest.raises(KeyboardInterrupt):
            run_finetune(config)
    if evaluation == 2:
        monkeypatch.setattr(td3_bc.TD3BC, "update", lambda *_: pytest.fail("the last checkpoint is kept"))
    run_finetune(config)
    assert contents(config.out) == contents(finetuned)
    assert [row["step"] for row in read_episodes(config.out / "episodes.csv")] == [6, 6, 12, 12, 12, 12]
