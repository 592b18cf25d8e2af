"""Pretraining and fine-tuning: cut anywhere and started again, they end in the files of an uninterrupted run."""

import csv
import hashlib
from dataclasses import replace
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
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.runs import checkpoint

VARYING = ("timing.json", "pretrain_timing.json", "machine.json")


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
    """A file's bytes without seconds and run paths."""
    text = path.read_bytes()
    if path.name == "state.json":
        import re

        return re.sub(rb'\["seconds", [0-9.e-]+\]', b"", text)
    if path.name == "config.json":
        return b"\n".join(line for line in text.splitlines() if b'"out"' not in line and b'"encoder":' not in line)
    return text


class CutError(Exception):
    pass


def cut_at(monkeypatch, module: str, number: int) -> None:
    """Raise in place of writing the `number`-th checkpoint."""
    calls = []

    def save(folder, state):
        calls.append(state)
        if len(calls) == number:
            raise CutError
        checkpoint.save_checkpoint(folder, state)

    monkeypatch.setattr(f"{module}.save_checkpoint", save)


def smoke_pretrain(data: Path, out: Path, **changes: object) -> pretrain.config.PretrainConfig:
    return replace(pretrain.config.PRESETS["smoke"], data=data, out=out, corruption="patch+zero_frames", **changes)


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if method.trained])
def test_pretraining_resumes_to_the_bit(data, tmp_path, monkeypatch, method):
    whole = run_pretrain(smoke_pretrain(data, tmp_path / "whole", method=method))
    cut = smoke_pretrain(data, tmp_path / "cut", method=method)
    with monkeypatch.context() as patch:
        cut_at(patch, "pretrain.train", 2)
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


def smoke_finetune(encoder: Path, data: Path, out: Path, **changes: object) -> finetune.config.FinetuneConfig:
    return replace(finetune.config.PRESETS["smoke"], encoder=encoder, data=data, out=out, workers=1, **changes)


def finetune_cut_and_whole(monkeypatch, encoder: Path, data: Path, out: Path, **changes: object) -> Path:
    """Fine-tune in one go, and again with a cut at the second checkpoint; both must agree. Returns the whole run."""
    whole = run_finetune(smoke_finetune(encoder, data, out / "whole", **changes))
    cut = smoke_finetune(encoder, data, out / "cut", **changes)
    with monkeypatch.context() as patch:
        cut_at(patch, "finetune.train", 2)
        with pytest.raises(CutError):
            run_finetune(cut)
    run_finetune(cut)
    assert contents(out / "cut") == contents(whole.path)
    return whole.path


@pytest.mark.parametrize(("algorithm", "views"), [("td3_bc", 2), ("drqv2_bc", 1), ("bc", 1), ("td3_bc", 0)])
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
    frozen = FrozenEncoder(encoder, dataset, CorruptionConfig("patch"), 4, "fp32", 0)
    z = frozen.episode(1, 0, frozen.corruption(0)).numpy()
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
    cached = torch.cat([frozen.episode(i, 0, frozen.corruption(0)) for i in range(dataset.num_episodes)])
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
    for wrong in ({"m": -1}, {"n": -1}, {"max_k": 0}, {"homer_codes": -1}):
        with pytest.raises(UserError, match="must be at least"):
            run_pretrain(smoke_pretrain(data, tmp_path / "e", **wrong))
    assert not any((tmp_path / name).exists() for name in "abcde")


def test_td3_bc_finds_the_better_action_and_bc_the_common_one():
    """One state, two actions: the rarer one is paid. TD3+BC must lean to it, BC to their mean."""
    from finetune.algorithms import ALGORITHMS
    from finetune.features import FeatureBatch
    from vd4rl_pomdp.nn.policy import Policy

    chosen = {}
    for name, build in ALGORITHMS.items():
        torch.manual_seed(0)
        config = replace(finetune.config.PRESETS["smoke"], hidden_dim=32, learning_rate=3e-3, alpha=25.0)
        policy = Policy(2, 1, 32)
        algorithm = build(policy, config, torch.Generator().manual_seed(0))
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


def test_policy_statistics_are_those_of_the_features():
    from vd4rl_pomdp.nn.policy import Standardise

    features = torch.randn(2, 500, 3) * torch.tensor([1.0, 5.0, 0.1]) + 2
    standardise = Standardise(3)
    standardise.fit(features)
    flat = standardise(features).reshape(-1, 3).numpy()
    assert np.allclose(flat.mean(0), 0, atol=1e-4)
    assert np.allclose(flat.std(0), 1, atol=0.02)
