"""A view of the data: observations batch by batch, random streams and row keys."""

import pytest
import torch
from torch.utils.data import DataLoader

from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core.streams import RandomStream, stream_seed
from vd4rl_pomdp.core.types import row_key, unpack_row_key
from vd4rl_pomdp.corruptions import CorruptionConfig, KeyStream, augmentation
from vd4rl_pomdp.data import Dataset, TransitionSampler, View, WindowSampler, open_dataset

LENGTHS = (9, 5)


@pytest.fixture
def dataset(tmp_path) -> Dataset:
    """Two episodes of random pixels."""
    dataset = open_dataset(write_fake_set(tmp_path / "set", LENGTHS), tmp_path / "cache")
    g = torch.Generator().manual_seed(0)
    dataset.frames = torch.randint(0, 256, dataset.frames.shape, dtype=torch.uint8, generator=g)
    return dataset


MAKE = {
    "windows": lambda view, draws: WindowSampler(view, 4, 3, draws),
    "transitions": lambda view, draws: TransitionSampler(view, 4, draws, n_step=2),
}


@pytest.mark.parametrize("kind", MAKE)
def test_sampler_state_determines_next_batches(dataset, kind):
    def sampler():
        view = View(dataset, CorruptionConfig.of("patch+zero_frames"), 4, 3, "test")
        return MAKE[kind](view, RandomStream(torch.Generator().manual_seed(0)))

    first, second = sampler(), sampler()
    for _ in range(3):
        first.sample()
    second.load_state_dict(first.state_dict())
    for _ in range(2):
        one, other = first.sample(), second.sample()
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(sampler().sample().obs, one.obs)


def test_view_name_determines_random_stream(dataset):
    rows = torch.arange(8)
    config = CorruptionConfig.of("patch+zero_frames")
    seen = [View(dataset, config, 4, 0, *name).observe(rows) for name in (["a"], ["a"], ["b"], ["a", 1])]
    assert torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[0], seen[2])
    assert not torch.equal(seen[0], seen[3])


def test_window_shares_one_random_shift(dataset):
    view = View(dataset, None, 4)
    rows = torch.tensor([[2, 2, 2], [2, 2, 2], [3, 3, 3]])
    seen = view.observe(rows)
    assert torch.equal(seen[0, 0], seen[0, 2])
    assert not torch.equal(seen[0, 0], seen[1, 0])
    assert not torch.equal(view.observe(rows), seen)


def test_ends_of_a_transition_are_shifted_independently(dataset):
    dataset.frames[:] = dataset.frames[:1].clone()
    batch = View(dataset, None, 4).transitions(range(12))
    assert (batch.obs != batch.next_obs).flatten(1).any(1).sum() > 8


@pytest.mark.parametrize("corruption", ["none", "zero_frames"])
@pytest.mark.parametrize("by_lines", [True, False])
def test_observations_can_be_shifted_independently(dataset, monkeypatch, corruption, by_lines):
    """The frames of one observation still share a shift, and both implementations agree."""
    if not by_lines:
        monkeypatch.setattr(augmentation, "by_lines", lambda images, pad: False)
    view = View(dataset, CorruptionConfig.of(corruption), 4, shared="observation")
    rows = torch.tensor([[2, 2, 2], [2, 3, 2]])
    seen = view.observe(rows).clone()
    keys = KeyStream(stream_seed(0, "shift")).take((6,))
    flat = View(dataset, CorruptionConfig.of(corruption), 4).observe(rows.flatten(), keys)
    assert torch.equal(seen.flatten(0, 1), flat)
    if corruption == "none":
        same = [torch.equal(seen[0, 0], other) for other in (seen[0, 1], seen[0, 2], seen[1, 0], seen[1, 2])]
        assert same.count(True) <= 1
    assert not torch.equal(view.observe(rows), seen), "the next shifts differ"


def test_row_keys_unpack_and_padding_is_masked(dataset):
    episode, t = torch.tensor([0, 3, 70_000]), torch.tensor([0, 500, 1_000_000])
    assert [x.tolist() for x in unpack_row_key(row_key(episode, t))] == [episode.tolist(), t.tolist()]
    window = View(dataset).windows([0, 1], 4).replace(length=torch.tensor([4, 2]))
    assert window.real.tolist() == [[True] * 4, [True, True, False, False]]


@pytest.mark.parametrize("shift", [0, 4])
def test_empty_batches_have_shapes(dataset, shift):
    view = View(dataset, CorruptionConfig.of("patch+zero_frames"), shift)
    assert view.transitions([]).obs.shape == (0, 9, 84, 84)
    assert view.windows([], 3).obs.shape == (0, 3, 9, 84, 84)


@pytest.mark.parametrize("shift", [0, 4])
def test_rows_need_not_be_contiguous(dataset, shift):
    rows = torch.arange(6).view(2, 3).T
    for corruption in ("none", "patch+zero_frames"):
        seen = [View(dataset, corruption, shift).observe(given).clone() for given in (rows, rows.contiguous())]
        assert torch.equal(*seen)


class Items(torch.utils.data.Dataset):
    """The same observation, four times."""

    def __init__(self, view: View) -> None:
        self.view = view

    def __len__(self) -> int:
        return 4

    def __getitem__(self, number: int) -> torch.Tensor:
        return self.view.observe(torch.tensor([2]))


@pytest.mark.parametrize(("mode", "shift", "different"), [("resample", 0, 8), ("resample", 4, 8), ("emission", 0, 1)])
def test_workers_and_epochs_draw_different_keys_except_for_emissions(dataset, mode, shift, different):
    view = View(dataset, CorruptionConfig.of("patch", corruption_mode=mode), shift)
    loader = DataLoader(Items(view), num_workers=2, generator=torch.Generator().manual_seed(0))
    seen = [item.numpy().tobytes() for _ in range(2) for item in loader]
    assert (len(seen), len(set(seen))) == (8, different)


def test_spawned_workers_do_not_advance_the_view(dataset):
    view = View(dataset, "patch")
    loader = DataLoader(Items(view), num_workers=1, multiprocessing_context="spawn")
    assert len({item.numpy().tobytes() for item in loader}) == 4
    assert view.state_dict() == {"corruption": 0, "shift": 0}
