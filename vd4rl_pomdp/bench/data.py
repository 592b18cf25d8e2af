"""Opening a set, and gathering, shifting and corrupting its rows."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vd4rl_pomdp.bench.memory import touch
from vd4rl_pomdp.bench.timing import alternating, seconds_of
from vd4rl_pomdp.core.tasks import EPISODE_TRANSITIONS, FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.data.format import write_shard

BATCH = 256
EPISODE_ROWS = EPISODE_TRANSITIONS + 1


def synthetic_set(folder: Path, episodes: int) -> tuple[Dataset, dict[str, Any]]:
    """Write, decode and open a set of `episodes` full episodes; random stripes compress fast and cost like pixels."""
    rng = np.random.default_rng(0)
    (folder / "set").mkdir()
    for shard in range(0, episodes, 20):
        count = min(20, episodes - shard)
        rows = count * EPISODE_ROWS
        step_type = np.full(rows, int(StepType.MID))
        step_type[::EPISODE_ROWS], step_type[EPISODE_ROWS - 1 :: EPISODE_ROWS] = StepType.FIRST, StepType.LAST
        stripes = rng.integers(0, 256, (rows, 3, FRAME_SIZE, 1), dtype=np.uint8)
        arrays: dict[str, np.ndarray] = {
            "observation": np.broadcast_to(stripes, (rows, 3, FRAME_SIZE, FRAME_SIZE)),
            "action": rng.uniform(-1, 1, (rows, 6)).astype(np.float32),
            "reward": rng.uniform(0, 2, rows),
            "discount": np.ones(rows),
            "step_type": step_type,
        }
        write_shard(folder / "set" / f"{shard // 20}_bench.hdf5", arrays, {})
    start = time.perf_counter()
    open_dataset(folder / "set", folder / "cache")
    decoding = time.perf_counter() - start
    opening = seconds_of(lambda: open_dataset(folder / "set", folder / "cache"), 3)
    dataset = open_dataset(folder / "set", folder / "cache")
    return dataset, {"rows": dataset.num_rows, "decode_seconds": decoding, "open_seconds": opening}


def sampling(dataset: Dataset, repeats: int) -> dict[str, float]:
    """Gathering against copying the same bytes, and what shift and corruption add to it; new rows every time."""
    some = min(dataset.num_transitions, 20_000)
    touch(dataset.frames[:some])
    generator = torch.Generator().manual_seed(0)

    def rows() -> torch.Tensor:
        return torch.randint(3, some - 1, (2 * BATCH,), generator=generator)

    def copy() -> None:
        start = int(rows()[0]) * (some - len(target)) // some
        target.copy_(dataset.frames[start : start + len(target)])

    def see(name: str) -> Callable[[], Any]:
        view = View(dataset, CorruptionConfig.of(name), shift=4)
        return lambda: view.observe(rows())

    plain = View(dataset)
    target = torch.empty(2 * BATCH * FRAME_STACK, *dataset.frames.shape[1:], dtype=torch.uint8)
    copying, gathering, patch, both = alternating(
        repeats, copy, lambda: plain.stacks(rows()), see("patch"), see("patch+zero_frames")
    )
    return {
        "copy_ms": copying * 1e3,
        "gather_ms": gathering * 1e3,
        "gather_speed_over_copy": copying / gathering,
        "corrupt_and_shift_over_gather": both / gathering - 1,
        "patch_and_shift_over_gather": patch / gathering - 1,
        "transitions_ms": seconds_of(lambda: plain.transitions(rows(), 3), repeats) * 1e3,
    }
