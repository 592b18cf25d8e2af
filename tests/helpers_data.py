"""Small datasets in V-D4RL's format whose values encode their episode and step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.folder import shard_paths
from vd4rl_pomdp.data.format import FRAMES_KEY, read_frames, read_rows, write_shard


def fake_frame(episode: int, t: int) -> np.ndarray:
    """(3, 84, 84) uint8: one plane holds the episode, one t // 256, one t % 256."""
    planes = np.array([episode, t // 256, t % 256], np.uint8)
    return np.broadcast_to(planes[:, None, None], (3, 84, 84))


def frame_identity(frames: Any) -> np.ndarray:
    """(..., S, 2) pairs (episode, t) of the frames in (..., 3 * S, 84, 84) stacks; fails on mixed frames."""
    frames = np.asarray(frames).reshape(*frames.shape[:-3], -1, 3, 84, 84)
    assert (frames == frames[..., :1, :1]).all(), "a frame mixes pixels of several frames"
    planes = frames[..., 0, 0].astype(int)
    return np.stack([planes[..., 0], planes[..., 1] * 256 + planes[..., 2]], -1)


def fake_action(episode: int, t: int, action_dim: int = 6) -> np.ndarray:
    """a_t of an episode: distinct for every (episode, t, dimension), in (-1, 1)."""
    return ((episode * 1000 + t) / 1e4 + np.arange(action_dim) / 1e5).astype(np.float32)


def fake_reward(episode: int, t: int) -> float:
    """r_t of an episode."""
    return episode + t / 1000


def fake_episode(episode: int, length: int, action_dim: int = 6, complete: bool = True) -> dict[str, np.ndarray]:
    """`length` rows of an episode; without its LAST row if not `complete`."""
    step_type = np.full(length, StepType.MID, np.int64)
    step_type[-1] = StepType.LAST if complete else StepType.MID
    step_type[0] = StepType.FIRST
    earlier = range(length - 1)
    return {
        "observation": np.stack([fake_frame(episode, t) for t in range(length)]),
        "action": np.stack([np.zeros(action_dim, np.float32), *(fake_action(episode, t, action_dim) for t in earlier)]),
        "reward": np.array([0.0, *(fake_reward(episode, t) for t in earlier)]),
        "discount": np.ones(length),
        "step_type": step_type,
    }


def fake_rows(
    lengths: Sequence[int], action_dim: int = 6, complete_last: bool = True, physics_dim: int = 0, noise: int = 0
) -> dict[str, np.ndarray]:
    """Rows of a dataset; `physics`, if requested, holds (episode, t, 0, ...).

    With `noise`, frames have this size and random pixels, none of them 0.
    """
    last = len(lengths) - 1
    episodes = [fake_episode(i, n, action_dim, complete_last or i < last) for i, n in enumerate(lengths)]
    rows = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    if physics_dim:
        rows["physics"] = np.zeros((len(rows["reward"]), physics_dim))
        rows["physics"][:, :2] = [(i, t) for i, n in enumerate(lengths) for t in range(n)]
    if noise:
        shape = (len(rows["reward"]), 3, noise, noise)
        rows["observation"] = np.random.default_rng(0).integers(1, 256, shape, np.uint8)
    return rows


def write_fake_set(
    folder: Path,
    lengths: Sequence[int] = (8, 8),
    action_dim: int = 6,
    complete_last: bool = True,
    physics_dim: int = 0,
    noise: int = 0,
    cuts: Sequence[int] = (),
    names: Sequence[str] | None = None,
    attributes: dict[str, Any] | None = None,
) -> Path:
    """Write a set of episodes with `lengths` rows, in shards from `cuts` on, and return its folder.

    Args:
        folder: made if missing; name it `.../walker_walk/expert` to give the set a task and quality.
        noise: size of frames of random pixels; 0: frames as by `fake_frame`.
        cuts: rows at which a new shard begins, anywhere in an episode.
        names: shard names in order; default `0_fake.hdf5`, `1_fake.hdf5`, ...
    """
    rows = fake_rows(lengths, action_dim, complete_last, physics_dim, noise)
    edges = [0, *cuts, len(rows["reward"])]
    names = names or [f"{i}_fake.hdf5" for i in range(len(edges) - 1)]
    for name, start, end in zip(names, edges[:-1], edges[1:], strict=True):
        write_rows(folder, {k: v[start:end] for k, v in rows.items()}, attributes, name)
    return folder


def write_rows(
    folder: Path, rows: dict[str, np.ndarray], attributes: dict[str, Any] | None = None, name: str = "0_fake.hdf5"
) -> Path:
    """Write a set of one shard, or a further shard, and return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_shard(folder / name, rows, attributes or {})
    return folder


def read_shard(path: Path) -> dict[str, np.ndarray]:
    """Read and validate one shard: `read_rows` and, as `observation`, its (N, 3, S, S) uint8 frames."""
    rows = read_rows(path)
    return {FRAMES_KEY: np.concatenate(list(read_frames(path))), **rows}


def file_bytes(folder: Path, pattern: str = "*") -> dict[str, bytes]:
    """Contents of the files below a folder whose names match `pattern`."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob(pattern) if p.is_file()}


def rows_of_set(folder: Path) -> dict[str, np.ndarray]:
    """All rows of a set, as `read_shard`."""
    shards = [read_shard(shard) for shard in shard_paths(folder)]
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


def assert_equal_rows(left: dict[str, np.ndarray], right: dict[str, np.ndarray], but: Sequence[str] = ()) -> None:
    """Assert equal arrays for all keys except `but`."""
    assert left.keys() - set(but) == right.keys() - set(but)
    for key in left.keys() - set(but):
        np.testing.assert_array_equal(left[key], right[key], err_msg=key)
