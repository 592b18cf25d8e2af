"""Baselines on images of known state, with random shifts as on V-D4RL."""

import math

import pytest

from tests.helpers_pixels import ball_world, position_error, trainer_on
from vd4rl_pomdp.data import Dataset

STEPS = {"acro": 100, "one_step_inverse": 100, "curl": 80, "driml": 60}
INVERSE = {"action_target": "mse", "max_k": 3}


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Dataset:
    return ball_world(tmp_path_factory.mktemp("ball"))


@pytest.fixture(scope="module")
def nothing(tmp_path_factory) -> Dataset:
    """The dataset without the ball: all images are equal."""
    return ball_world(tmp_path_factory.mktemp("nothing"), ball=False)


@pytest.mark.parametrize("method", STEPS)
def test_baselines_halve_the_error_of_an_untrained_encoder(ball: Dataset, method: str):
    """Probe error of the ball's position after `STEPS` updates on 64 images each."""
    settings = {"acro": INVERSE, "one_step_inverse": {"action_target": "mse"}}.get(method, {})
    trainer = trainer_on(ball, method, **settings)
    untrained = position_error(trainer)
    assert 45 < untrained < 65, "random convolutions are partly informative"
    for _ in range(STEPS[method]):
        trainer.update()
    assert position_error(trainer) < 0.5 * untrained


def test_homer_learns_under_patches(ball: Dataset):
    """Patches of 6 of 32 pixels cover the same share of the image as in the benchmark."""
    trainer = trainer_on(ball, "homer", corruption="patch", patch_size=6, batch_size=16)
    untrained = position_error(trainer)
    losses = [trainer.update()["loss"].item() for _ in range(160)]
    assert sum(losses[:20]) / 20 > 0.97 * math.log(2), "training starts at chance"
    assert sum(losses[-20:]) / 20 < 0.9 * math.log(2)
    assert position_error(trainer) < 0.5 * untrained


@pytest.mark.parametrize("method", ["curl", "driml", "homer"])
def test_contrastive_losses_stay_at_chance_for_identical_images(nothing: Dataset, method: str):
    """If positives shared a shift that negatives do not, the loss would fall without knowledge of the state."""
    trainer = trainer_on(nothing, method, batch_size=16)
    losses = [trainer.update()["loss"].item() for _ in range(100)]
    batch, rows = trainer.config.batch_size, trainer.config.window
    candidates = {"curl": (batch - 1) * rows + 1, "driml": batch * (rows - 2), "homer": 2}[method]  # DRIML's at least
    assert sum(losses[-20:]) / 20 > 0.98 * math.log(candidates)
