"""The training loop gives objectives corrupted observations, progress and an update after each step."""

from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.curl import CURL
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from pretrain.train import Trainer, build_objective, build_target, make_batches, make_objective
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.nn import Encoder, EncoderConfig


@pytest.fixture
def trainer(tmp_path) -> Trainer:
    dataset = open_dataset(write_fake_set(tmp_path / "set", [20, 25]), tmp_path / "cache")
    torch.manual_seed(0)
    encoder = Encoder(EncoderConfig(6, "nature", 8))
    config = PretrainConfig.of("smoke", method="curl", data=Path(), out=Path(), corruption="patch", learning_rate=1e-2)
    objective = CURL(encoder, None, config.options, 0)
    return Trainer(objective, make_batches(dataset, config, objective), config)


def test_curl_momentum_encoder_is_updated_every_step(trainer: Trainer):
    objective = trainer.objective
    for _ in range(2):
        old = [p.clone() for p in objective.momentum_encoder.parameters()]
        trainer.update()
        for was, slow, fast in zip(
            old, objective.momentum_encoder.parameters(), objective.encoder.parameters(), strict=True
        ):
            torch.testing.assert_close(slow, was.lerp(fast, 0.05))
            assert not torch.equal(slow, was)


def test_objective_receives_training_progress(trainer: Trainer):
    received, loss = [], trainer.objective.loss
    trainer.objective.loss = lambda window, progress: (received.append(progress), loss(window, progress))[1]
    for _ in range(3):
        trainer.update()
    assert received == [0.0, 1 / 20, 2 / 20]


def test_objective_sees_corrupted_rows_of_one_episode(trainer: Trainer):
    window = trainer.batches.sample()
    hidden = (window.obs.view(2, 8, 3, 3, 84, 84) == 0).all(3)
    assert (hidden.flatten(3).sum(3) >= 16 * 16).all()
    assert (window.key.diff(dim=1) == 1).all()


SHARED = {"acro": "observation", "driml": "observation", "homer": "observation", "curl": None}


def test_random_shift_is_shared_as_the_method_declares(tmp_path):
    """One bright pixel reveals the shift; methods that shift images themselves receive unshifted ones."""
    dataset = open_dataset(
        write_fake_set(tmp_path / "walker_walk" / "set", [20, 25], physics_dim=18), tmp_path / "cache"
    )
    dataset.frames = torch.zeros_like(dataset.frames)
    dataset.frames[..., 40, 40] = 255
    pixels = make_objective(dataset, PretrainConfig.of("smoke", method="random"))
    methods = [name for name, method in METHODS.items() if not method.reads_state]
    for method, asked in (*((name, {}) for name in methods), ("acro", {"shift_shared": True})):
        config = PretrainConfig.of("smoke", method=method, **asked)
        obs = make_batches(dataset, config, pixels).view.observe(torch.arange(24).view(4, 6))
        places = obs[:, :, 0].flatten(2).int().argmax(2)
        assert (obs.view(4, 6, 9, -1).int().argmax(3) == places[..., None]).all(), "one shift per observation"
        shared = "window" if asked else SHARED.get(method, "window")
        assert (places == 40 * 84 + 40).all() == (shared is None), method
        assert ((places == places[:, :1]).all()).item() == (shared != "observation"), method
        assert len(places[:, 0].unique()) > 1 or shared is None, method


@pytest.mark.parametrize(("method", "changes"), [("mik+a", {}), ("random", {"history": "gru"}), ("random", {})])
def test_state_frame_encoder_reads_standardised_partly_hidden_states(tmp_path, method, changes):
    """Hidden coordinates are zero, and redrawn whenever a row enters a batch."""
    dataset = open_dataset(write_fake_set(tmp_path / "walker_walk" / "expert", [40, 60], physics_dim=18), tmp_path)
    dataset.physics = np.random.default_rng(0).normal(size=(100, 18)) * np.arange(1, 19) + 5
    given = {"method": method, "frame_encoder": "state", "corruption": "none", "batch_size": 32} | changes
    for share in (0.0, 0.25):
        config = PretrainConfig.of("smoke", hidden_share=share, **given)
        config.check()
        objective = make_objective(dataset, config)
        batches = make_batches(dataset, config, objective)
        window = batches.sample()
        states = dataset.states()
        scaled = (states - states.mean(0)) / states.std(0, correction=0)
        expected, seen = scaled[dataset.rows(window.key)], window.obs[..., 0, 0]
        shown = seen != 0
        torch.testing.assert_close(seen[shown], expected[shown], atol=1e-4, rtol=1e-4)
        assert 1 - shown.float().mean().item() == pytest.approx(share, abs=0.02)
        assert torch.equal(objective.encoder.frame(window.obs), seen)
        assert objective.encoder.dim == (32 if objective.encoder.remembers else 18)
        objective.loss(window, 0.0)


def test_older_future_frames_are_blanked_after_corruption(tmp_path):
    """Blanking also removes the fill (200) of patches."""
    dataset = open_dataset(write_fake_set(tmp_path / "set", [20, 25]), tmp_path / "cache")
    config = PretrainConfig.of("smoke", future_frames="newest", corruption="patch", patch_fill=200)
    objective = build_objective(config, 6, build_target(config, dataset.action.numpy()))
    trainer, read = Trainer(objective, make_batches(dataset, config, objective), config), []
    objective.encoder.frame.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0]))
    trainer.update()
    whole, *blanked = read
    assert (whole == 200).flatten(3).any(-1).all(), "a patch in every frame"
    for obs, older in zip(blanked, (6, 3), strict=True):
        assert obs.dtype == torch.uint8
        assert not obs[:, :, :older].any()
        assert torch.equal(obs[:, :, older:], whole[:, :, older:])
