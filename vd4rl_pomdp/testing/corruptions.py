"""Conformance checks of corruptions: pure functions of a stack and its key."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from pretrain.config import PretrainConfig
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.corruptions import (
    BatchCorruption,
    Corruption,
    CorruptionConfig,
    FrameDrop,
    make_corruption,
)
from vd4rl_pomdp.corruptions.augmentation import random_shift
from vd4rl_pomdp.corruptions.corruption import Mode
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.testing.contract import Check, claim, run_checks

STACKS = 8


def check_corruption(name: str, **options: Any) -> None:
    """Run all checks on a corruption: a stage of `vd4rl_pomdp.corruptions.STAGES`, or several joined by `+`."""
    CorruptionConfig.of(name, **options)
    PretrainConfig.of("smoke", corruption=name, **options)
    run_checks("corruption", CHECKS, name, **options)


def stacks(count: int = STACKS) -> Tensor:
    """Random stacks (count, C, S, S) uint8 without zeros, each darker than the one before; identical at every call."""
    shape = (count, 3 * FRAME_STACK, FRAME_SIZE, FRAME_SIZE)
    bright = torch.randint(0, 255, shape, generator=torch.Generator().manual_seed(0))
    darker = torch.linspace(1, 0.2, count)[:, None, None, None]  # so that statistics of a batch are not a stack's own
    return (1 + darker * bright).to(torch.uint8)


def _make(name: str, options: dict[str, Any]) -> Corruption:
    return make_corruption(CorruptionConfig.of(name, **options))


def pixels_stay_pixels(name: str, **options: Any) -> None:
    """A corruption returns a new uint8 tensor of the same shape and leaves its input unchanged."""
    obs = stacks()
    out = _make(name, options)(obs, torch.arange(STACKS))
    claim(out.dtype == torch.uint8, f"it is {out.dtype}")
    claim(out.shape == obs.shape, f"its shape is {tuple(out.shape)}, not {tuple(obs.shape)}")
    claim(torch.equal(obs, stacks()), "the input was changed")


def something_changes(name: str, **options: Any) -> None:
    """A corruption changes pixels; `none` changes nothing."""
    changed = not torch.equal(_make(name, options)(stacks(), torch.arange(STACKS)), stacks())
    found = "some differ" if changed else "none differs: change `frames` in place, what a stage returns is not used"
    claim(changed == (name != "none"), f"of {STACKS} random stacks {found}")


def equal_keys_give_equal_masks(name: str, **options: Any) -> None:
    """The output for a stack depends on the stack and its key only, not on the rest of the batch or its shape."""
    obs, key, corruption = stacks(), torch.arange(100, 100 + STACKS), _make(name, options)
    whole = corruption(obs, key)
    alone = torch.cat([corruption(obs[i : i + 1], key[i : i + 1]) for i in range(STACKS)])
    claim(torch.equal(whole, alone), "a stack looks different in a batch than by itself")
    windows = corruption(obs.view(2, STACKS // 2, *obs.shape[1:]), key.view(2, -1))
    claim(torch.equal(windows.view_as(whole), whole), "a stack looks different in windows than in a batch")


def draws_depend_only_on_keys(name: str, **options: Any) -> None:
    """Randomness comes from the keys only: repeated calls and other torch or numpy seeds give the same pixels."""
    seen = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002 (a stage must not use it)
        corruption = _make(name, options)
        seen += [corruption(stacks(), torch.arange(STACKS)) for _ in range(2)]
    claim(all(torch.equal(seen[0], other) for other in seen), "equal keys gave different pixels")


def dropped_frames_stay_dropped(name: str, **options: Any) -> None:
    """Dropped frames stay black, and their content does not leak into other frames."""
    if name == "none":
        return
    drops = isinstance(CorruptionConfig.of(name, **options).stages[-1], FrameDrop)
    corruption = _make(name if drops else f"{name}+zero_frames", options)
    obs, key = stacks(), torch.arange(STACKS)
    dropped = torch.ones(STACKS, FRAME_STACK, dtype=torch.bool).scatter_(1, corruption.kept(key, FRAME_STACK), False)
    out = corruption(obs, key)
    claim(not _frames(out)[dropped].any(), "a dropped frame is not black")
    other = obs.clone()
    _frames(other)[dropped] = 7
    claim(torch.equal(corruption(other, key), out), "the kept frames depend on a dropped one")


def _frames(obs: Tensor) -> Tensor:
    """View stacks (N, 3 * K, S, S) as frames (N, K, 3, S, S)."""
    return obs.view(len(obs), FRAME_STACK, 3, *obs.shape[-2:])


def emission_never_changes_a_row(name: str, **options: Any) -> None:
    """Runs with equal seeds see equal masks; under `emission` a row always has the same mask."""
    row = torch.arange(STACKS)
    always = BatchCorruption(CorruptionConfig.of(name, "emission", **options), 0)
    claim(torch.equal(always(stacks(), row), always(stacks(), row)), "a row looked different the second time")
    one, other = (BatchCorruption(CorruptionConfig.of(name, "resample", **options), 3) for _ in range(2))
    for _ in range(2):
        claim(torch.equal(one(stacks(), row), other(stacks(), row)), "two runs with one seed saw different masks")


def a_view_shows_shifted_then_corrupted_stacks(name: str, **options: Any) -> None:
    """The fast data path equals shifting the stacks and then corrupting them."""
    with TemporaryDirectory() as folder:
        dataset = _random_set(Path(folder))
        for mode in get_args(Mode):
            for shift in (0, 4):
                _claim_view(dataset, CorruptionConfig.of(name, mode, **options), shift)


def _claim_view(dataset: Dataset, config: CorruptionConfig, shift: int) -> None:
    rows, key = torch.arange(dataset.num_rows).view(2, -1), torch.tensor([5, 6])
    apart, together = BatchCorruption(config, 1, "a"), View(dataset, config, shift, 1, "a")
    for _ in range(2):
        expected = apart(random_shift(View(dataset).stacks(rows), key, shift).clone(), dataset.keys(rows))
        seen = together.observe(rows, key)
        claim(torch.equal(seen, expected), f"they differ under {config.corruption_mode} with a shift of {shift}")
    again = BatchCorruption(config, 1, "a")
    for _ in range(2):
        keys = again.keys(dataset.keys(rows)).flatten()
    index = dataset.stack_rows(rows, FRAME_STACK).view(-1, FRAME_STACK)
    painted = again.corruption.paint(dataset.frames, index, keys, key, shift)
    if painted is not None:
        same = torch.equal(painted.view_as(expected), expected)
        claim(same, "a GPU would hide other pixels: `hides` does not match what the stage does to frames")


def _random_set(folder: Path) -> Dataset:
    """Two short episodes of random pixels."""
    steps = [StepType.FIRST, *[StepType.MID] * 4, StepType.LAST] * 2
    shape = (len(steps), 3, FRAME_SIZE, FRAME_SIZE)
    rows: dict[str, np.ndarray] = {
        "observation": np.random.default_rng(0).integers(1, 256, shape, dtype=np.uint8),
        "action": np.zeros((len(steps), 1), np.float32),
        "reward": np.zeros(len(steps)),
        "discount": np.ones(len(steps)),
        "step_type": np.array(steps, np.int64),
    }
    write_shard(folder / "0_random.hdf5", rows, {})
    return open_dataset(folder, folder / "cache")


CHECKS: tuple[Check, ...] = (
    pixels_stay_pixels,
    something_changes,
    equal_keys_give_equal_masks,
    draws_depend_only_on_keys,
    dropped_frames_stay_dropped,
    emission_never_changes_a_row,
    a_view_shows_shifted_then_corrupted_stacks,
)
