"""Cached features stay aligned with their rows and views."""

import numpy as np
import pytest
import torch

from finetune.features import ExactSampler, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories, HistoryOptions
from tests.helpers_data import fake_action, fake_reward, fake_rows, write_fake_set, write_rows
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.nn import Encoder, EncoderConfig, load_encoder

LENGTHS, VIEWS, N, GAMMA = (6, 4), 3, 2, 0.5
ROWS = [(e, t) for e, length in enumerate(LENGTHS) for t in range(length)]


def test_feature_batches_are_aligned(tmp_path):
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


def noise_set(folder, first_action: float = 0.0, lengths: tuple[int, ...] = LENGTHS) -> Dataset:
    """Episodes of random pixels; their first rows store `first_action`, which was never taken."""
    rows = fake_rows(lengths, noise=84)
    rows["action"][rows["step_type"] == 0] = first_action
    return open_dataset(write_rows(folder, rows))


def frozen(
    dataset: Dataset, corruption: CorruptionConfig, shift: int, seed: int = 0, **settings: object
) -> FrozenEncoder:
    torch.manual_seed(0)
    settings = {"history": "gru", "use_actions": True, "hidden_dim": 8} | settings
    encoder = Encoder(EncoderConfig(6, "nature", 16, **settings)).eval().requires_grad_(False)
    return FrozenEncoder(encoder.to(dataset.t.device), dataset, corruption, shift, "fp32", seed)


def views_of(tmp_path, corruption: str, mode: str, shift: int) -> torch.Tensor:
    made = frozen(noise_set(tmp_path / "set"), CorruptionConfig.of(corruption, mode), shift)
    return encode_views(made, Histories(made.dataset, NO_OPTIONS, N, 0), 2, tmp_path / "features.npy", "name")


@pytest.mark.parametrize(
    ("corruption", "mode", "shift", "differ"),
    [
        ("none", "resample", 4, True),
        ("patch", "resample", 0, True),
        ("patch", "emission", 0, False),
        ("none", "resample", 0, False),
    ],
)
def test_views_differ_by_shift_and_resampled_corruption(tmp_path, corruption, mode, shift, differ):
    first, second = views_of(tmp_path, corruption, mode, shift)
    assert first.shape == (len(ROWS), 8)
    for start in (0, LENGTHS[0]):
        assert torch.equal(first[start:], second[start:]) != differ


def test_shifts_are_those_of_a_view_and_episode_or_of_a_transition(tmp_path):
    """A memory would mistake other shifts for motion."""
    still = noise_set(tmp_path / "set")
    still.frames = still.frames[:1].repeat(len(ROWS), 1, 1, 1)
    made = frozen(still, CorruptionConfig(), 4)
    read: list[torch.Tensor] = []
    made.encoder.frame.register_forward_pre_hook(lambda _, given: read.append(given[0]))
    encode_views(made, Histories(still, NO_OPTIONS, N, 0), 2, tmp_path / "features.npy", "name")
    assert [len(obs) for obs in read] == 2 * [*LENGTHS]
    assert all((obs == obs[:1]).all() for obs in read), "one shift"
    assert not torch.equal(read[0][0], read[2][0])
    read.clear()
    ExactSampler(made, NO_OPTIONS, 1, N, GAMMA, RandomStream(torch.Generator().manual_seed(3))).sample()
    assert len(obs := torch.cat(read)) > 2
    assert (obs == obs[:1]).all(), "one shift"


def test_first_row_has_no_previous_action(tmp_path):
    plain, odd = (
        frozen(noise_set(tmp_path / name, action), CorruptionConfig(), 0)
        for name, action in (("plain", 0.0), ("odd", 0.9))
    )
    for number in range(len(LENGTHS)):
        one, other = (made.episode(number, made.view(0)) for made in (plain, odd))
        torch.testing.assert_close(one, other)


def test_exact_batches_equal_cached_features(encoder, data):
    """Without corruption and shift both modes give the same representation of a row."""
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
    stored = FeatureSampler(Histories(dataset, NO_OPTIONS, 3, 0), cached[None], 16, 3, 0.99, sampler.draws).data[index]
    expected = torch.cat([batch.action, batch.next_action, batch.reward[:, None], batch.discount[:, None]], 1)
    assert torch.equal(stored, expected)


MEMORIES = {"none": {"history": "none"}, "whole": {}, "window": {"history_window": 3}}
OPTIONS = HistoryOptions(random_histories=0.5, shortest_history=1, longest_history=3)


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize(("chunk", "group"), [(3, 10), (100, 100)])
def test_grouped_encoding_equals_single_episodes(tmp_path, memory, chunk, group):
    """A GPU encodes rows of several episodes in one batch, with memories over episodes of unequal length."""
    dataset, found = noise_set(tmp_path / "set", 0.9, (6, 4, 1, 5, 9)), []
    for together in (False, True):
        made = frozen(dataset, CorruptionConfig.of("patch+zero_frames"), 4, **MEMORIES[memory])
        if together:
            made.chunk, made.group = chunk, group
        assert max(map(len, made.groups())) == (1 if not together else 2 if group == 10 else 5)
        histories = Histories(dataset, NO_OPTIONS if memory == "none" else OPTIONS, N, 0)
        found.append(encode_views(made, histories, 2, tmp_path / str(together), "name"))
    torch.testing.assert_close(found[1], found[0], atol=2e-3, rtol=0)
    assert found[0].float().std(1).mean() > 2e-2, "rows differ"


def test_features_are_shared_within_a_process(tmp_path):
    dataset, patch = noise_set(tmp_path / "set"), CorruptionConfig.of("patch")
    whole, random = (Histories(dataset, options, N, 0) for options in (NO_OPTIONS, OPTIONS))
    kept = iter(tmp_path / f"{number}.npy" for number in range(99))
    first = encode_views(frozen(dataset, patch, 4), whole, 2, next(kept), "name")
    assert encode_views(frozen(dataset, patch, 4), whole, 2, tmp_path / "other.npy", "name") is first
    assert (tmp_path / "other.npy").samefile(tmp_path / "0.npy"), "features are stored once"
    unread = Histories(dataset, NO_OPTIONS, 3, 1)
    assert encode_views(frozen(dataset, patch, 4), unread, 2, tmp_path / "third.npy", "name") is first
    others = [
        (frozen(dataset, patch, 4, seed=1), whole, 2),
        (frozen(dataset, patch, 3), whole, 2),
        (frozen(dataset, CorruptionConfig.of("patch", patch_size=8), 4), whole, 2),
        (frozen(dataset, patch, 4, use_actions=False), whole, 2),
        (frozen(noise_set(tmp_path / "other", 0.9), patch, 4), whole, 2),
        (frozen(dataset, patch, 4), whole, 3),
        (frozen(dataset, patch, 4), random, 2),
        (frozen(dataset, patch, 4), Histories(dataset, OPTIONS, N, 1), 2),
        (frozen(dataset, patch, 4), Histories(dataset, OPTIONS, 1, 0), 2),
    ]
    own = [encode_views(*other, next(kept), "name") for other in others]
    assert len({id(features) for features in [first, *own]}) == len(others) + 1
    moved = frozen(dataset, patch, 4)
    moved.encoder.gru.weight_ih_l0.data += 1
    assert not torch.equal(encode_views(moved, whole, 2, next(kept), "moved"), first)


@pytest.mark.gpu
@pytest.mark.parametrize("memory", MEMORIES)
def test_gpu_features_match_cpu_features(tmp_path, memory):
    options = NO_OPTIONS if memory == "none" else OPTIONS
    noise_set(tmp_path / "set", 0.9, (60, 40, 1, 50, 90) * 20)
    found = {}
    for device in ("cpu", "cuda"):
        dataset = open_dataset(tmp_path / "set").to(device)
        made = frozen(dataset, CorruptionConfig.of("patch+zero_frames"), 4, **MEMORIES[memory])
        found[device] = encode_views(made, Histories(dataset, options, N, 0), 2, tmp_path / f"{device}.npy", "name")
        assert found[device].device.type == device
        assert np.array_equal(np.load(tmp_path / f"{device}.npy"), found[device].cpu().numpy())
    torch.testing.assert_close(found["cuda"].cpu(), found["cpu"], atol=1e-2, rtol=0)  # TF32
