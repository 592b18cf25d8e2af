"""The training loop hands an objective what it needs: observations as the agent sees them, and its own step."""

from pathlib import Path

import pytest
import torch

from baselines import CURL
from pretrain.build import build_objective, build_on_states, build_target
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS, Method
from pretrain.objectives.masked_inverse import MaskedInverse, MaskedOptions
from pretrain.train import PretrainTrainer, pretrain, view_of
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import View, open_dataset
from vd4rl_pomdp.nn import Encoder, EncoderConfig
from vd4rl_pomdp.nn.objective import Objective


@pytest.fixture
def trainer(tmp_path) -> PretrainTrainer:
    dataset = open_dataset(write_fake_set(tmp_path / "set", [20, 25]), tmp_path / "cache")
    torch.manual_seed(0)
    encoder = Encoder(EncoderConfig(6, "nature", 8))
    config = PretrainConfig.of("smoke", method="curl", data=Path(), out=Path(), corruption="patch", learning_rate=1e-2)
    return PretrainTrainer(CURL(encoder, None, config.options, 0), dataset, config)


def test_curls_momentum_encoder_follows_the_encoder_at_every_step_of_a_training(trainer: PretrainTrainer):
    objective = trainer.objective
    for _ in range(2):
        old = [p.clone() for p in objective.momentum_encoder.parameters()]
        trainer.update()
        for was, slow, fast in zip(
            old, objective.momentum_encoder.parameters(), objective.encoder.parameters(), strict=True
        ):
            torch.testing.assert_close(slow, was.lerp(fast, 0.05))
            assert not torch.equal(slow, was)


def test_an_objective_is_told_how_much_of_the_training_is_done(trainer: PretrainTrainer):
    told, loss = [], trainer.objective.loss
    trainer.objective.loss = lambda window, progress: (told.append(progress), loss(window, progress))[1]
    for _ in range(3):
        trainer.update()
    assert told == [0.0, 1 / 20, 2 / 20]


def test_an_objective_sees_patches_and_rows_of_one_episode(trainer: PretrainTrainer):
    window = trainer.batch()
    hidden = (window.obs.view(2, 8, 3, 3, 84, 84) == 0).all(3)
    assert (hidden.flatten(3).sum(3) >= 16 * 16).all()
    assert (window.key.diff(dim=1) == 1).all()


SHARED = {"acro": "observation", "driml": "observation", "homer": "observation", "curl": None}


@pytest.mark.parametrize(("method", "asked"), [*((name, {}) for name in METHODS), ("acro", {"shift_shared": True})])
def test_observations_share_the_shifts_that_their_method_declares(tmp_path, method: str, asked: dict):
    """A picture with one bright pixel tells its shift; what a method shifts by itself is not shifted before."""
    dataset = open_dataset(write_fake_set(tmp_path / "set", [20, 25]), tmp_path / "cache")
    dataset.frames = torch.zeros_like(dataset.frames)
    dataset.frames[..., 40, 40] = 255
    obs = view_of(dataset, PretrainConfig.of("smoke", method=method, **asked)).observe(torch.arange(24).view(4, 6))
    places = obs[:, :, 0].flatten(2).int().argmax(2)
    assert (obs.view(4, 6, 9, -1).int().argmax(3) == places[..., None]).all(), "frames of one observation share it"
    shared = "window" if asked else SHARED.get(method, "window")
    assert (places == 40 * 84 + 40).all() == (shared is None)
    assert ((places == places[:, :1]).all()).item() == (shared != "observation")
    assert len(places[:, 0].unique()) > 1 or shared is None


@pytest.mark.parametrize("method", ["mik+a", "acro", "state"])
def test_any_objective_can_be_built_on_states(method):
    config = PretrainConfig.of("smoke", method=method)
    target = build_target(config, torch.rand(50, 6).numpy())
    encoder = build_on_states(config, 6, target, 18).encoder
    assert encoder.reads_state
    assert encoder.dim == (32 if method == "mik+a" else 18)
    states = torch.rand(2, 8, 18, 1, 1)
    assert torch.equal(encoder.frame(states), states[..., 0, 0])


def test_frames_before_the_future_are_blanked_in_what_was_shifted_and_corrupted(tmp_path):
    """Behind patches of 200: what a patch or a shift put into a blanked frame is gone, too."""
    dataset = open_dataset(write_fake_set(tmp_path / "set", [20, 25]), tmp_path / "cache")
    config = PretrainConfig.of("smoke", future_frames="newest", corruption="patch", patch_fill=200)
    objective = build_objective(config, 6, build_target(config, dataset.action.numpy()))
    trainer, read = PretrainTrainer(objective, dataset, config), []
    objective.encoder.frame.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0]))
    trainer.update()
    whole, *blanked = read
    assert (whole == 200).flatten(3).any(-1).all(), "a patch in every frame"
    for obs, older in zip(blanked, (6, 3), strict=True):
        assert obs.dtype == torch.uint8
        assert not obs[:, :, :older].any()
        assert torch.equal(obs[:, :, older:], whole[:, :, older:])


class Short(MaskedInverse):
    def representations(self, window):
        past, future = super().representations(window)
        return past[:, 1:], future[:, 1:]


class Single(MaskedInverse):
    def representations(self, window):
        return super().representations(window)[0]


@pytest.mark.parametrize("kind", [Short, Single])
def test_representations_that_are_no_two_of_every_row_are_refused(tmp_path, monkeypatch, kind):
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path / "cache"))
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])
    with METHODS.isolated():
        METHODS.register("mine", Method(kind, options=MaskedOptions))
        config = PretrainConfig.of("smoke", method="mine", data=data, out=tmp_path / "out")
        with pytest.raises(UserError, match=rf"{kind.__name__}\.representations must give two tensors \(B, T, D\)"):
            pretrain(config)


class Blind(Objective):
    def __init__(self, encoder, target, options, seed):
        super().__init__()

    def loss(self, window, progress):
        raise NotImplementedError


def test_an_objective_without_its_encoder_is_refused():
    with METHODS.isolated():
        METHODS.register("mine", Method(Blind))
        with pytest.raises(UserError, match="objective of the method mine has no `encoder`: keep the one that it is"):
            build_objective(PretrainConfig.of("smoke", method="mine"), 6, None)


def test_a_trainer_takes_another_view_of_the_set(trainer: PretrainTrainer):
    view = View(trainer.dataset, None, 0, 7, "own")
    window = PretrainTrainer(trainer.objective, trainer.dataset, trainer.config, view).batch()
    assert trainer.config.shift > 0
    rows = trainer.dataset.episode_start[window.key >> 20] + (window.key & 0xFFFFF)
    assert torch.equal(window.obs, View(trainer.dataset).stacks(rows)), "neither shifted nor corrupted"
