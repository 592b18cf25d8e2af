"""Cached features keep their rows: every feature here tells the view and the row it is of."""

import numpy as np
import pytest
import torch

from finetune.features import ExactSampler, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories
from tests.helpers_data import fake_action, fake_reward, fake_rows, write_fake_set
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.nn import Encoder, EncoderConfig, load_encoder

LENGTHS, VIEWS, N, GAMMA = (6, 4), 3, 2, 0.5
ROWS = [(e, t) for e, length in enumerate(LENGTHS) for t in range(length)]


pytestmark = pytest.mark.usefixtures("own_cache")


def test_every_field_of_a_batch_is_of_one_transition_and_both_ends_of_one_view(tmp_path):
    dataset = open_dataset(write_fake_set(tmp_path / "set", LENGTHS))
    features = torch.stack(torch.meshgrid(torch.arange(VIEWS), torch.arange(len(ROWS)), indexing="ij"), -1)
    histories = Histories(dataset, NO_OPTIONS, N, 0)
    sampler = FeatureSampler(histories, features, 500, N, GAMMA, RandomStream(torch.Generator().manual_seed(0)))
    batch, drawn = sampler.sample(), set()
    ends = zip(batch.z.int().tolist(), batch.next_z.int().tolist(), strict=True)
    for i, ((view, row), (next_view, next_row)) in enumerate(ends):
        e, t = ROWS[row]
        taken = min(N, LENGTHS[e] - 1 - t)
        drawn.add((view, row))
        assert (next_view, ROWS[next_row]) == (view, (e, t + taken))
        np.testing.assert_array_equal(batch.action[i], fake_action(e, t))
        reward = sum(GAMMA**j * fake_reward(e, t + j) for j in range(taken))
        assert batch.reward[i].item() == pytest.approx(reward)
        assert batch.discount[i].item() == pytest.approx(GAMMA ** (taken - 1))
    starts = [row for row, (e, t) in enumerate(ROWS) if t + 1 < LENGTHS[e]]
    assert drawn == {(view, row) for view in range(VIEWS) for row in starts}


def noise_set(folder, first_action: float = 0.0) -> Dataset:
    """Episodes of random pixels; the first row of each stores an action that nobody took."""
    rows = fake_rows(LENGTHS)
    rows["observation"] = np.random.default_rng(0).integers(1, 256, rows["observation"].shape, dtype=np.uint8)
    rows["action"][rows["step_type"] == 0] = first_action
    folder.mkdir()
    write_shard(folder / "0_noise.hdf5", rows, {})
    return open_dataset(folder)


def frozen(dataset: Dataset, corruption: CorruptionConfig, shift: int) -> FrozenEncoder:
    torch.manual_seed(0)
    config = EncoderConfig(6, "nature", 16, "gru", use_actions=True, hidden_dim=8)
    encoder = Encoder(config).eval().requires_grad_(False)
    return FrozenEncoder(encoder, dataset, corruption, shift, "fp32", 0)


def views_of(tmp_path, corruption: str, mode: str, shift: int) -> torch.Tensor:
    made = frozen(noise_set(tmp_path / "set"), CorruptionConfig.of(corruption, mode), shift)
    return encode_views(made, Histories(made.dataset, NO_OPTIONS, N, 0), 2, tmp_path / "features.npy")


@pytest.mark.parametrize(
    ("corruption", "mode", "shift", "differ"),
    [
        ("none", "resample", 4, True),
        ("patch", "resample", 0, True),
        ("patch", "emission", 0, False),
        ("none", "resample", 0, False),
    ],
)
def test_views_are_draws_of_their_own_of_shift_and_of_resampled_corruption(tmp_path, corruption, mode, shift, differ):
    first, second = views_of(tmp_path, corruption, mode, shift)
    assert first.shape == (len(ROWS), 8)
    for start in (0, LENGTHS[0]):
        assert torch.equal(first[start:], second[start:]) != differ


def test_an_episodes_first_row_carries_no_action(tmp_path):
    plain, odd = (
        frozen(noise_set(tmp_path / name, action), CorruptionConfig(), 0)
        for name, action in (("plain", 0.0), ("odd", 0.9))
    )
    for number in range(len(LENGTHS)):
        one, other = (made.episode(number, made.view(0)) for made in (plain, odd))
        torch.testing.assert_close(one, other)


def test_exact_batches_agree_with_cached_features(encoder, data):
    """Without corruption and shift both modes must give the same representation for the same row."""
    dataset = open_dataset(data)
    network, _ = load_encoder(encoder)
    frozen = FrozenEncoder(network, dataset, CorruptionConfig(), 0, "fp32", 0)
    cached = torch.cat([frozen.episode(i, frozen.view(0)) for i in range(dataset.num_episodes)])
    sampler = ExactSampler(frozen, NO_OPTIONS, 16, 3, 0.99, RandomStream(torch.Generator().manual_seed(0)))
    index = torch.randint(dataset.num_transitions, (16,), generator=torch.Generator().manual_seed(0))
    batch = sampler.sample()
    rows = sampler._starts[index]
    torch.testing.assert_close(batch.z, cached[rows], atol=1e-5, rtol=1e-4)
    next_rows = torch.minimum(rows + 3, dataset.episode_end[dataset.episode[rows]] - 1)
    torch.testing.assert_close(batch.next_z, cached[next_rows], atol=1e-5, rtol=1e-4)
