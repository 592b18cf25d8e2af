"""What a GPU does in one pass over the pixels, against what a CPU does line by line."""

import pytest
import torch

from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core import buffers
from vd4rl_pomdp.corruptions import CORRUPTIONS, CorruptionConfig, corruption, fused
from vd4rl_pomdp.data import Dataset, View, open_dataset

OPTIONS = [
    {"zeroed_frames": 1, "patch_size": 5, "patch_fill": 7},
    {"zeroed_frames": 2, "patch_size": 5, "patch_fill": 255, "patch_count": 3},
    {"zeroed_frames": 3, "patch_size": 1, "patch_count": 2, "patch_shared": True},
    {"zeroed_frames": 2, "patch_size": 17, "patch_fill": 9},
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    """Episodes of random pixels, higher than wide, no power of two."""
    folder = tmp_path_factory.mktemp("fused")
    dataset = open_dataset(write_fake_set(folder / "set", [9, 5, 12]), folder / "cache")
    g = torch.Generator().manual_seed(0)
    dataset.frames = torch.randint(1, 256, (dataset.num_rows, 3, 23, 17), dtype=torch.uint8, generator=g)
    return dataset


def seen(dataset: Dataset, config: CorruptionConfig, **settings) -> list[torch.Tensor]:
    """Two batches of windows, one of rows."""
    view, device = View(dataset, config, seed=3, **settings), dataset.t.device
    rows = torch.arange(24, device=device).view(4, 6)
    return [view.observe(part).cpu().clone() for part in (rows, rows.flip(0), rows[1])]


def expected_and_painted(dataset: Dataset, monkeypatch, config: CorruptionConfig, **settings) -> None:
    """The same pixels, whichever way they are made."""
    expected = seen(dataset, config, **settings)
    with monkeypatch.context() as m:
        m.setattr(buffers, "in_host_memory", lambda x: False)
        found = seen(dataset, config, **settings)
    for one, other in zip(expected, found, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", CORRUPTIONS)
@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("mode", ["resample", "emission"])
def test_one_pass_makes_the_same_observations(dataset, monkeypatch, name, options, mode):
    config = CorruptionConfig.fill({"corruption": name, "corruption_mode": mode} | options)
    for pad in (0, 4, 16):
        for shared in ("window", "observation"):
            expected_and_painted(dataset, monkeypatch, config, shift=pad, shared=shared)


def test_stacks_of_any_number_of_frames_are_made_in_one_pass(dataset, monkeypatch):
    config = CorruptionConfig.of("patch+zero_frames", zeroed_frames=1, patch_size=4)
    for stack in (1, 2, 5):
        expected_and_painted(dataset, monkeypatch, config, shift=3, frame_stack=stack)


def test_equal_draws_zero_the_same_frames_by_ranks_as_by_sorting(monkeypatch):
    """They hardly ever are equal: of 31 bits each."""
    draws = torch.cartesian_prod(*[torch.arange(3)] * 3)
    for module in (fused, corruption):
        monkeypatch.setattr(module, "zero_draws", lambda key, stages, stack: draws)
    key = torch.arange(len(draws))
    for zeroed in (1, 2, 3):
        kept = corruption.Corruption([], zeroed).kept(key, 3)
        by_rank = fused.drawn((), zeroed, 0, key, key, 3, (1, 1)).kept
        assert torch.equal(torch.zeros_like(by_rank).scatter_(1, kept, True), by_rank)
