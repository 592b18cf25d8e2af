"""Pretraining and fine-tuning: cut anywhere and started again, they end in the files of an uninterrupted run."""

import csv
import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import finetune.config
import pretrain.config
from finetune.features import FrozenEncoder
from finetune.train import finetune as run_finetune
from pretrain.objectives import METHODS
from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import append_episodes, drop_episodes_after, evaluate_run, read_episodes
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.runs.checkpoint import Checkpoints
from vd4rl_pomdp.runs.metrics import read_metrics

VARYING = ("timing.json", "pretrain_timing.json", "machine.json", "manifest.json")


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("sys.argv", ["vd4rl-pomdp", "test"])
    torch.set_num_threads(1)


@pytest.fixture
def data(tmp_path) -> Path:
    return write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])


def contents(folder: Path) -> dict[str, str]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name not in VARYING)
    return {p.relative_to(folder).as_posix(): hashlib.sha256(_stable(p)).hexdigest() for p in files}


def _stable(path: Path) -> bytes:
    """A file's bytes without run paths."""
    text = path.read_bytes()
    if path.name == "results.json":
        return b"\n".join(line for line in text.splitlines() if b'"command"' not in line)
    if path.name == "config.json":
        return b"\n".join(line for line in text.splitlines() if b'"out"' not in line and b'"encoder":' not in line)
    return text


class CutError(Exception):
    pass


def cut_at(monkeypatch, number: int) -> None:
    """Raise in place of writing the `number`-th checkpoint."""
    calls, add = [], Checkpoints.add

    def cut(self, *arguments):
        calls.append(arguments)
        if len(calls) == number:
            raise CutError
        add(self, *arguments)

    monkeypatch.setattr(Checkpoints, "add", cut)


def smoke_pretrain(data: Path, out: Path, **changes: object) -> pretrain.config.PretrainConfig:
    return pretrain.config.PretrainConfig.of("smoke", data=data, out=out, corruption="patch+zero_frames", **changes)


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if method.trained])
def test_pretraining_resumes_to_the_bit(data, tmp_path, monkeypatch, method):
    whole = run_pretrain(smoke_pretrain(data, tmp_path / "whole", method=method))
    cut = smoke_pretrain(data, tmp_path / "cut", method=method)
    with monkeypatch.context() as patch:
        cut_at(patch, 2)
        with pytest.raises(CutError):
            run_pretrain(cut)
    assert not (tmp_path / "cut" / "encoder").exists()
    run_pretrain(cut)
    assert contents(tmp_path / "cut") == contents(whole.path)
    again = run_pretrain(cut)
    assert contents(again.path) == contents(whole.path)


@pytest.fixture
def encoder(data, tmp_path) -> Path:
    return run_pretrain(smoke_pretrain(data, tmp_path / "pretrained")).path / "encoder"


def test_an_encoder_tells_how_it_was_pretrained_and_an_older_one_still_loads(encoder, data):
    settings = load_encoder(encoder)[1].settings
    assert (settings["method"], settings["max_k"], settings["corruption"], settings["task"]) == (
        *("mik+a", 3, "patch+zero_frames", "walker_walk"),
    )
    assert not {"seed", "data", "out", "device", "log_every", "checkpoint_every", "wandb"} & set(settings)
    config = json.loads((encoder / "config.json").read_text())
    del config["pretrain"]["settings"]
    (encoder / "config.json").write_text(json.dumps(config))
    assert load_encoder(encoder)[1].settings == {}


def smoke_finetune(encoder: Path, data: Path, out: Path, **changes: object) -> finetune.config.FinetuneConfig:
    return finetune.config.FinetuneConfig.of("smoke", encoder=encoder, data=data, out=out, workers=1, **changes)


def finetune_cut_and_whole(monkeypatch, encoder: Path, data: Path, out: Path, **changes: object) -> Path:
    """Fine-tune in one go, and again with a cut at the second checkpoint; both must agree. Returns the whole run."""
    whole = run_finetune(smoke_finetune(encoder, data, out / "whole", **changes))
    cut = smoke_finetune(encoder, data, out / "cut", **changes)
    with monkeypatch.context() as patch:
        cut_at(patch, 2)
        with pytest.raises(CutError):
            run_finetune(cut)
    run_finetune(cut)
    assert contents(out / "cut") == contents(whole.path)
    return whole.path


@pytest.mark.parametrize(("algorithm", "views"), [("td3_bc", 2), ("drqv2_bc", 1), ("iql", 1), ("bc", 1), ("td3_bc", 0)])
def test_finetuning_resumes_to_the_bit(encoder, data, tmp_path, monkeypatch, algorithm, views):
    changes = {"algorithm": algorithm, "views": views, "eval_length": 2, "updates": 30, "eval_every": 15}
    changes |= {"checkpoint_every": 10, "batch_size": 4}
    whole = finetune_cut_and_whole(monkeypatch, encoder, data, tmp_path, **changes)
    rows = list(csv.DictReader((whole / "episodes.csv").open()))
    assert [row["step"] for row in rows] == ["15", "30"]
    assert {row["method"] for row in rows} == {"mik+a"}
    assert not (whole / "features.npy").exists()


@pytest.fixture
def with_states(tmp_path) -> Path:
    return write_fake_set(tmp_path / "own" / "walker_walk" / "expert", [20, 25, 30], physics_dim=18)


@pytest.mark.parametrize("method", ["bc", "drq_bc", "state"])
def test_references_resume_to_the_bit(with_states, tmp_path, monkeypatch, method):
    made = run_pretrain(smoke_pretrain(with_states, tmp_path / "made", method=method)).path / "encoder"
    changes = {"updates": 12, "eval_every": 6, "checkpoint_every": 4, "batch_size": 4, "eval_length": 2}
    whole = finetune_cut_and_whole(monkeypatch, made, with_states, tmp_path, **changes)
    trained = (whole / "encoder" / "model.safetensors").read_bytes()
    assert (trained != (made / "model.safetensors").read_bytes()) == (method != "state")
    rows = list(csv.DictReader((whole / "episodes.csv").open()))
    assert {row["algorithm"] for row in rows} == {{"bc": "bc", "drq_bc": "drqv2_bc", "state": "td3_bc"}[method]}


def test_the_state_reference_reads_pose_and_velocity_and_needs_a_set_that_has_them(with_states, data, tmp_path):
    encoder, _ = load_encoder(
        run_pretrain(smoke_pretrain(with_states, tmp_path / "s", method="state")).path / "encoder"
    )
    dataset = open_dataset(with_states)
    frozen = FrozenEncoder(encoder, dataset, CorruptionConfig.of("patch"), 4, "fp32", 0)
    z = frozen.episode(1, frozen.view(0)).numpy()
    rows = slice(int(dataset.episode_start[1]), int(dataset.episode_end[1]))
    assert z.shape == (25, 17)
    assert np.allclose(z, np.delete(dataset.physics[rows], 1, axis=1))
    with pytest.raises(UserError, match="stores no simulator states"):
        run_pretrain(smoke_pretrain(data, tmp_path / "none", method="state"))
    with pytest.raises(UserError, match="drq_bc has no memory"):
        run_pretrain(smoke_pretrain(data, tmp_path / "gru", method="drq_bc", history="gru"))


def test_exact_batches_agree_with_cached_features(encoder, data):
    """Without corruption and shift both modes must give the same representation for the same row."""
    from finetune.features import ExactSampler

    dataset = open_dataset(data)
    network, _ = load_encoder(encoder)
    frozen = FrozenEncoder(network, dataset, CorruptionConfig(), 0, "fp32", 0)
    cached = torch.cat([frozen.episode(i, frozen.view(0)) for i in range(dataset.num_episodes)])
    sampler = ExactSampler(frozen, 16, 3, 0.99, torch.Generator().manual_seed(0))
    index = torch.randint(dataset.num_transitions, (16,), generator=torch.Generator().manual_seed(0))
    batch = sampler.sample()
    rows = sampler._starts[index]
    torch.testing.assert_close(batch.z, cached[rows], atol=1e-5, rtol=1e-4)
    next_rows = torch.minimum(rows + 3, dataset.episode_end[dataset.episode[rows]] - 1)
    torch.testing.assert_close(batch.next_z, cached[next_rows], atol=1e-5, rtol=1e-4)


def test_another_config_in_the_same_folder_is_refused_and_nothing_is_lost(data, tmp_path):
    run_pretrain(smoke_pretrain(data, tmp_path / "run"))
    before = contents(tmp_path / "run")
    with pytest.raises(UserError, match=r"another config \(seed\)"):
        run_pretrain(smoke_pretrain(data, tmp_path / "run", seed=1))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="not empty"):
        run_pretrain(smoke_pretrain(data, tmp_path / "full"))
    assert contents(tmp_path / "run") == before


def test_user_slips_are_one_line(data, encoder, tmp_path):
    with pytest.raises(UserError, match=r"unknown method 'mikado'.*mik\+a"):
        run_pretrain(smoke_pretrain(data, tmp_path / "a", method="mikado"))
    with pytest.raises(UserError, match=r"episode 0 .*20 rows"):
        run_pretrain(smoke_pretrain(data, tmp_path / "b", window=21))
    with pytest.raises(UserError, match="unknown algorithm"):
        run_finetune(smoke_finetune(encoder, data, tmp_path / "c", algorithm="ppo"))
    other = write_fake_set(tmp_path / "humanoid_walk" / "expert", [20, 20], action_dim=21)
    with pytest.raises(UserError, match="6 action dimensions"):
        run_finetune(smoke_finetune(encoder, other, tmp_path / "d"))
    assert not any((tmp_path / name).exists() for name in "abcd")


BELOW = {
    **{"m": -1, "n": -1, "max_k": 0, "homer_codes": -1, "steps": -1, "window": 1, "feature_dim": 0, "hidden_dim": 0},
    **{"gru_layers": 0, "head_dim": 0, "history_window": -1, "self_prediction": -1.0, "l2_states": float("nan")},
    **{"patch_size": 0, "patch_count": -1, "patch_fill": 256, "zeroed_frames": -1},
}
BELOW_IN_BOTH = {
    **{"seed": -1, "batch_size": 0, "learning_rate": float("nan"), "shift": -1, "log_every": 0, "checkpoint_every": 0},
}
BELOW_IN_FINETUNING = {
    **{"updates": 0, "gamma": 1.5, "n_step": 0, "alpha": -1.0, "views": -1, "eval_every": 0, "eval_episodes": 0},
    **{"eval_length": -1, "hidden_dim": 0, "expectile": 1.1, "temperature": -1.0},
}


@pytest.mark.parametrize(("field", "value"), [*BELOW.items(), *BELOW_IN_BOTH.items()])
def test_numbers_out_of_range_stop_pretraining_before_it_begins(data, tmp_path, field, value):
    with pytest.raises(UserError, match=f"--{field.replace('_', '-')} is {value}; it must be at least"):
        run_pretrain(smoke_pretrain(data, tmp_path / "out", **{field: value}))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("field", "value"), [*BELOW_IN_FINETUNING.items(), *BELOW_IN_BOTH.items()])
def test_numbers_out_of_range_stop_finetuning_before_it_begins(data, tmp_path, field, value):
    with pytest.raises(UserError, match=f"--{field.replace('_', '-')} is {value}; it must be at least"):
        run_finetune(smoke_finetune(tmp_path / "encoder", data, tmp_path / "out", **{field: value}))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patch_size": 85}, "exceeds the image"),
        ({"zeroed_frames": 4}, "cannot zero 4 of 3"),
        ({"device": "meta"}, "unknown device 'meta'"),
        ({"frame_encoder": "state"}, "unknown frame encoder 'state'"),
        ({"task": "cheetah_run"}, "is a set of walker_walk, not of cheetah_run"),
    ],
)
def test_what_does_not_fit_leaves_no_run_behind(data, tmp_path, change, message):
    with pytest.raises(UserError, match=message):
        run_pretrain(smoke_pretrain(data, tmp_path / "out", **change))
    assert not (tmp_path / "out").exists()


def test_a_set_without_transitions_and_a_missing_gpu_leave_no_finetuning_behind(encoder, data, tmp_path):
    single = write_fake_set(tmp_path / "single" / "walker_walk", [1, 1])
    for given, change in ((single, {}), (data, {"device": "cuda:99"})):
        with pytest.raises(UserError, match=r"holds no transition|no such GPU"):
            run_finetune(smoke_finetune(encoder, given, tmp_path / "out", **change))
        assert not (tmp_path / "out").exists()


def test_rows_are_named_after_the_set_that_the_policy_learned_from(encoder, data, tmp_path):
    other = write_fake_set(tmp_path / "walker_walk" / "medium", [20, 25])
    run = run_finetune(smoke_finetune(encoder, other, tmp_path / "out", updates=2, batch_size=4, eval_length=2))
    assert {row["quality"] for row in csv.DictReader((run.path / "episodes.csv").open())} == {"medium"}


def test_a_checkpoint_of_another_config_is_one_line(encoder, data, tmp_path):
    changes = {"updates": 2, "batch_size": 4, "eval_length": 2}
    narrow, wide = (
        smoke_finetune(encoder, data, tmp_path / name, hidden_dim=units, **changes)
        for name, units in (("narrow", 8), ("wide", 16))
    )
    for config in (narrow, wide):
        run_finetune(config)
        (config.out / "timing.json").unlink()
    shutil.rmtree(wide.out / "checkpoints")
    shutil.copytree(narrow.out / "checkpoints", wide.out / "checkpoints")
    with pytest.raises(UserError, match=r"wide/checkpoints/2: this checkpoint does not fit the run") as caught:
        run_finetune(wide)
    assert "\n" not in str(caught.value)


def test_a_row_lacks_what_no_step_since_the_row_before_gave(encoder, data, tmp_path, monkeypatch):
    """The actor learns at every other update only; also where a run is cut in between."""
    changes = {"updates": 6, "log_every": 1, "checkpoint_every": 1, "eval_every": 6, "batch_size": 4, "eval_length": 2}
    whole = finetune_cut_and_whole(monkeypatch, encoder, data, tmp_path, **changes)
    assert ["actor_loss" in row for row in read_metrics(whole / "metrics.jsonl")] == [False, True] * 3


def test_an_evaluation_names_its_step_and_touches_no_other_file(encoder, data, tmp_path):
    run = run_finetune(smoke_finetune(encoder, data, tmp_path / "run", updates=2, batch_size=4, eval_length=2))
    (run.path / "timing.json").unlink()  # an unfinished run has a step, too
    with pytest.raises(UserError, match="--episodes is 0"):
        evaluate_run(run.path, None, 0, 1)
    with pytest.raises(UserError, match="unknown corruption 'fog'"):
        evaluate_run(run.path, "fog", 1, 1)
    with pytest.raises(UserError, match="holds no evaluated run"):
        evaluate_run(encoder.parent, None, 1, 1)
    assert [row["step"] for row in evaluate_run(run.path, None, 1, 1)] == [2]
    (run.path / "labels.json").write_text("{}")
    with pytest.raises(UserError, match=r"labels\.json: has no 'method'"):
        evaluate_run(run.path, None, 1, 1)
    thesis = tmp_path / "thesis.csv"
    thesis.write_text("a,b\n1,2\n")
    with pytest.raises(UserError, match="has no column 'method'"):
        append_episodes(thesis, [])
    assert thesis.read_text() == "a,b\n1,2\n"


def test_a_line_that_was_cut_is_dropped_with_what_follows_the_checkpoint(tmp_path):
    path = tmp_path / "episodes.csv"
    row = dict.fromkeys(("method", "task", "quality", "corruption", "algorithm"), "x")
    row |= dict.fromkeys(("seed", "episode", "episode_seed", "return", "length", "score"), 1)
    append_episodes(path, [row | {"step": 1}, row | {"step": 2}])
    path.write_text(path.read_text() + "mik+a,walker_w")
    with pytest.raises(UserError, match="a row is not whole"):
        read_episodes(path)
    drop_episodes_after(path, 1)
    assert [row["step"] for row in read_episodes(path)] == [1]


def test_features_that_are_a_pipe_are_refused(encoder, data, tmp_path, monkeypatch):
    config = smoke_finetune(encoder, data, tmp_path / "out")
    with monkeypatch.context() as patch:
        cut_at(patch, 1)
        with pytest.raises(CutError):
            run_finetune(config)
    path = config.out / "features.npy"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(UserError, match=r"features\.npy: is no regular file .* remove it"):
        run_finetune(config)


def test_a_cut_run_whose_evaluations_are_gone_does_not_go_on(encoder, data, tmp_path, monkeypatch):
    config = smoke_finetune(encoder, data, tmp_path / "out", eval_every=10, checkpoint_every=10, eval_length=2)
    with monkeypatch.context() as patch:
        cut_at(patch, 3)
        with pytest.raises(CutError):
            run_finetune(config)
    rows = (config.out / "episodes.csv").read_text().splitlines(keepends=True)
    (config.out / "episodes.csv").write_text(rows[0] + rows[2])
    with pytest.raises(UserError, match=r"episodes\.csv: lacks the evaluation at update 10"):
        run_finetune(config)
    (config.out / "episodes.csv").write_text("".join(rows))
    assert run_finetune(config).finished


@pytest.mark.parametrize("cell", ["nan", "inf", "many", "9" * 200_000], ids=["nan", "inf", "word", "endless"])
def test_a_damaged_table_of_episodes_is_named_and_kept(tmp_path, cell):
    path = tmp_path / "episodes.csv"
    row = dict.fromkeys(("method", "task", "quality", "corruption", "algorithm"), "x")
    row |= dict.fromkeys(("seed", "episode", "episode_seed", "return", "length"), 1)
    append_episodes(path, [row | {"step": 1, "score": cell}])
    before = path.read_bytes()
    for read in (lambda: read_episodes(path), lambda: drop_episodes_after(path, 1)):
        with pytest.raises(UserError, match=r"episodes\.csv: (a row is not whole|the score of seed 1)"):
            read()
    assert path.read_bytes() == before


def test_an_encoder_of_another_image_size_is_refused(data, encoder, tmp_path):
    shutil.copytree(encoder, tmp_path / "small")
    config = json.loads((tmp_path / "small" / "config.json").read_text())
    config["encoder"]["size"] = 64
    (tmp_path / "small" / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"small: this encoder reads pictures of 64x64 pixels, the data set has 84x84"):
        run_finetune(smoke_finetune(tmp_path / "small", data, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_what_reads_rewards_finds_the_better_action_and_bc_the_common_one():
    """One state, two actions: the rarer one is paid. TD3+BC, DrQ-v2+BC and IQL must lean to it, BC to their mean."""
    from finetune.algorithms import ALGORITHMS
    from finetune.features import FeatureBatch
    from vd4rl_pomdp.nn.policy import Policy

    chosen = {}
    for name, build in ALGORITHMS.items():
        torch.manual_seed(0)
        policy, options = Policy(2, 1, 32), build.options.fill({"alpha": 25.0})
        algorithm = build(policy, options, 3e-3, 300, torch.Generator().manual_seed(0))
        action = torch.where(torch.arange(64) % 4 == 0, 0.5, -0.5)[:, None]
        batch = FeatureBatch(
            torch.zeros(64, 2), action, (action[:, 0] > 0).float(), torch.zeros(64), torch.zeros(64, 2)
        )
        for _ in range(300):
            algorithm.update(batch)
        chosen[name] = policy(torch.zeros(1, 2)).item()
    assert chosen["bc"] == pytest.approx(-0.25, abs=0.02)
    assert chosen["td3_bc"] > 0.2
    assert chosen["drqv2_bc"] > 0.2
    assert chosen["iql"] > 0.1


def test_policy_statistics_are_those_of_the_features():
    from vd4rl_pomdp.nn.policy import Standardise

    features = torch.randn(2, 500, 3) * torch.tensor([1.0, 5.0, 0.1]) + 2
    standardise = Standardise(3)
    standardise.fit(features)
    flat = standardise(features).reshape(-1, 3).numpy()
    assert np.allclose(flat.mean(0), 0, atol=1e-4)
    assert np.allclose(flat.std(0), 1, atol=0.02)
