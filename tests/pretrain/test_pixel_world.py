"""Baselines on pictures whose state is known, trained as they are trained on V-D4RL: random shifts are on."""

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
    """The same without the ball: all pictures are one."""
    return ball_world(tmp_path_factory.mktemp("nothing"), ball=False)


@pytest.mark.parametrize("method", STEPS)
def test_a_baseline_halves_the_untrained_encoders_error(ball: Dataset, method: str):
    """Where the ball is, within so many steps of 64 pictures: at most half of the error of the encoder as it began."""
    settings = {"acro": INVERSE, "one_step_inverse": {"action_target": "mse"}}.get(method, {})
    trainer = trainer_on(ball, method, **settings)
    untrained = position_error(trainer)
    assert 45 < untrained < 65, "random convolutions tell something of it"
    for _ in range(STEPS[method]):
        trainer.update()
    assert position_error(trainer) < 0.5 * untrained


def test_homer_leaves_chance_where_patches_hide_the_ball_now_and_then(ball: Dataset):
    """Patches of the benchmark's share of a picture, 6 of 32 pixels wide."""
    trainer = trainer_on(ball, "homer", corruption="patch", patch_size=6, batch_size=16)
    untrained = position_error(trainer)
    losses = [trainer.update()["loss"].item() for _ in range(160)]
    assert sum(losses[:20]) / 20 > 0.97 * math.log(2), "it begins there"
    assert sum(losses[-20:]) / 20 < 0.9 * math.log(2)
    assert position_error(trainer) < 0.5 * untrained


@pytest.mark.parametrize("method", ["curl", "driml", "homer"])
def test_where_all_pictures_are_one_nothing_tells_the_positive(nothing: Dataset, method: str):
    """Shifts that positives share and negatives do not would: the loss then falls without knowledge of the state."""
    trainer = trainer_on(nothing, method, batch_size=16)
    losses = [trainer.update()["loss"].item() for _ in range(100)]
    batch, rows = trainer.config.batch_size, trainer.config.window
    candidates = {"curl": (batch - 1) * rows + 1, "driml": batch * (rows - 2), "homer": 2}[method]  # DRIML's at least
    assert sum(losses[-20:]) / 20 > 0.98 * math.log(candidates)
