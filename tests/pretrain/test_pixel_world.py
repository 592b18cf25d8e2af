"""Contrastive baselines where all pictures are one, trained as on V-D4RL: random shifts are on."""

import math

import numpy as np
import pytest

from pretrain.build import build_objective
from pretrain.config import PretrainConfig
from pretrain.train import Trainer, make_batches
from tests.helpers_data import fake_rows
from vd4rl_pomdp.core.seeding import seed_networks
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.data.format import write_shard

SIZE = 32


@pytest.fixture(scope="module")
def nothing(tmp_path_factory) -> Dataset:
    """Random actions and one picture, with lines that tell how it was shifted."""
    folder, rows = tmp_path_factory.mktemp("nothing"), fake_rows([40] * 24, action_dim=2)
    rows["action"] = np.random.default_rng(0).uniform(-1, 1, (24 * 40, 2)).astype(np.float32)
    picture = np.full((3, SIZE, SIZE), 60, np.uint8)
    picture[0, 6:8], picture[1, :, 6:8], picture[2, 24:26], picture[0, :, 24:26] = 160, 160, 200, 120
    rows["observation"] = np.broadcast_to(picture, (24 * 40, 3, SIZE, SIZE))
    (folder / "set").mkdir()
    write_shard(folder / "set" / "0_nothing.hdf5", rows, {})
    return open_dataset(folder / "set", folder / "cache")


@pytest.mark.parametrize("method", ["curl", "driml", "homer"])
def test_where_all_pictures_are_one_nothing_tells_the_positive(nothing: Dataset, method: str):
    """Shifts that positives share and negatives do not would: the loss then falls without knowledge of the state."""
    batch, rows = 16, 8
    small = {"frame_encoder": "small", "feature_dim": 32, "learning_rate": 1e-3}
    config = PretrainConfig.of("paper", method=method, batch_size=batch, window=rows, **small)
    seed_networks(0, "nothing")
    objective = build_objective(config, 2, None, observation=(9, SIZE))
    trainer = Trainer(objective, make_batches(nothing, config, objective), config)
    losses = [trainer.update()["loss"].item() for _ in range(100)]
    candidates = {"curl": (batch - 1) * rows + 1, "driml": batch * (rows - 2), "homer": 2}[method]  # DRIML's at least
    assert sum(losses[-20:]) / 20 > 0.98 * math.log(candidates)
