"""The stages use the seeds and settings that they are given, and pages state those that matter."""

import re
from pathlib import Path

import pytest
import torch

from finetune.train import finetune
from finetune.trainer import FinetuneTrainer
from pretrain.train import make_batches, make_objective
from pretrain.train import pretrain as run_pretrain
from tests.finetune.test_features import noise_set
from tests.helpers_data import write_fake_set
from tests.helpers_stages import smoke_finetune, smoke_pretrain
from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.options import RUNTIME_FIELDS, flag_of
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.sweeps.driver import PATIENCE_S

DOCS = Path(__file__).parents[1] / "docs"
LENGTHS = (20, 25)


@pytest.fixture
def data(tmp_path) -> Path:
    """A set of random pictures, on which shifts, masks and precisions change features."""
    return write_fake_set(tmp_path / "walker_walk" / "expert", LENGTHS, noise=84)


def test_pretraining_seeds_differ_and_methods_share_batches_and_masks(data, tmp_path):
    def made(data=data, **changes):
        config, dataset = smoke_pretrain(data, Path(), **changes), open_dataset(data)
        batches = make_batches(dataset, config, objective := make_objective(dataset, config))
        return objective, batches.sample().key, batches.view.observe(torch.arange(8)).clone()

    (one, keys, seen), (_, *same), (other, *others) = made(method="ah"), made(method="mik+a"), made(method="ah", seed=1)
    assert torch.equal(keys, same[0])
    assert torch.equal(seen, same[1]), "equal shifts and masks"
    assert not torch.equal(keys, others[0])
    assert not torch.equal(seen, others[1])
    assert not torch.equal(one.encoder.frame.project[0].weight, other.encoder.frame.project[0].weight)
    assert not torch.equal(one.target.centers, other.target.centers)
    noise_set(tmp_path / "odd", 0.9, LENGTHS)
    assert torch.equal(made(tmp_path / "odd", method="ah")[0].target.centers, one.target.centers), "of actions taken"


def test_pretraining_settings_change_the_encoder(data, tmp_path):
    def weights(name, change):
        given = {"method": "no_history", "corruption": "none", "steps": 2} | change
        run = run_pretrain(smoke_pretrain(data, tmp_path / name, **given))
        return (run.path / "encoder/model.safetensors").read_bytes()

    changes = {"plain": {}, "rate": {"learning_rate": 1e-3}, "bf16": {"precision": "bf16"}, "still": {"shift": 0}}
    assert len({weights(name, change) for name, change in changes.items()}) == len(changes)


@pytest.fixture
def encoder(data, tmp_path) -> Path:
    return run_pretrain(smoke_pretrain(data, tmp_path / "pretrained", steps=2)).path / "encoder"


def built(encoder: Path, data: Path, out: Path, **changes: object) -> FinetuneTrainer:
    one = FinetuneTrainer(smoke_finetune(encoder, data, out, batch_size=4, **changes), {}, None)
    with one.run:
        one.build()
    return one


def test_finetuning_seeds_and_settings_reach_their_parts(encoder, data, tmp_path):
    plain, seed, bf16, still = (
        built(encoder, data, tmp_path / str(change), **{"views": 2, "view_seed": 0, "random_histories": 0.5} | change)
        for change in ({"n_step": 2, "gamma": 0.5}, {"seed": 1, "n_step": 2}, {"precision": "bf16"}, {"shift": 0})
    )
    assert torch.equal(plain.sampler.features, seed.sampler.features)
    assert torch.equal(plain.sampler.ends, seed.sampler.ends), "the same random histories"
    assert not torch.equal(plain.algorithm.policy.net[0].weight, seed.algorithm.policy.net[0].weight)
    assert not torch.equal(plain.algorithm.draws.get_state(), plain.sampler.draws.get_state())
    assert not torch.equal(plain.sampler.draws.get_state(), seed.sampler.draws.get_state())
    rows = slice(plain.dataset.num_rows)  # full histories
    for changed in (bf16, still):
        assert not torch.equal(plain.sampler.features[:, rows], changed.sampler.features[:, rows])
    reward, discount, _ = plain.dataset.n_step_returns(plain.dataset.transition_rows, 2, 0.5)
    torch.testing.assert_close(plain.sampler.data[:, -2:], torch.stack([reward, discount], 1))
    scaled = plain.algorithm.policy.standardise(plain.sampler.features.flatten(0, 1))
    assert scaled.mean(0).abs().max() < 1e-3, "statistics of all views"


def test_update_precision_changes_the_policy(encoder, data, tmp_path):
    def weights(precision):
        few = {"updates": 4, "batch_size": 4, "eval_episodes": 0, "update_precision": precision}
        run = finetune(smoke_finetune(encoder, data, tmp_path / precision, **few))
        return (run.path / "policy/model.safetensors").read_bytes()

    assert weights("fp32") != weights("bf16")


def test_training_in_bf16_warns_where_the_cpu_has_no_kernels(encoder, data, tmp_path, monkeypatch, capsys):
    def warned(kernels, precision):
        monkeypatch.setattr(hardware, "bf16_kernels", lambda: kernels)
        place = tmp_path / f"{kernels}_{precision}"
        run_pretrain(smoke_pretrain(data, place / "pretrained", steps=1, precision=precision))
        both = {"precision": precision, "update_precision": precision}
        finetune(smoke_finetune(encoder, data, place / "tuned", updates=1, batch_size=4, eval_episodes=0, **both))
        hardware.warn_of_slow_bf16(torch.device("cuda"), **both)
        lines = [line for line in capsys.readouterr().err.splitlines() if "no bf16 kernels" in line]
        return [line.partition("a new run with ")[2] for line in lines]

    assert warned(False, "bf16") == ["--precision fp32", "--precision fp32 --update-precision fp32"]
    assert warned(True, "bf16") == warned(False, "fp32") == []


def test_runs_page_names_the_flags_that_may_change():
    (line,) = re.findall(r"These flags may change: (.*)", (DOCS / "runs.md").read_text())
    assert set(re.findall(r"`(--[a-z-]+)`", line)) == {flag_of(name) for name in RUNTIME_FIELDS - {"data", "encoder"}}


def test_sweeps_page_states_how_long_jobs_may_take_to_end():
    assert "writes a checkpoint within two minutes" in (DOCS / "sweeps.md").read_text()
    assert PATIENCE_S == 120
