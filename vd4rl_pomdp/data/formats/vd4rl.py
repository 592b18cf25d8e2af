"""V-D4RL's two formats: HDF5 shards, which this package also uses, and the `.npz` episodes of its 64-pixel data sets.

An episode's file holds `image` (T + 1, S, S, 3) uint8, `action`, `reward`, `discount`, `is_first`, `is_last` and
`is_terminal`, as DreamerV2 reads them; rows are numbered as in the shards. Its name ends in the number of rows.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from vd4rl_pomdp.core.errors import UserError, in_one_line
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.folder import read_set, task_and_quality
from vd4rl_pomdp.data.format import FRAMES_KEY, read_frames
from vd4rl_pomdp.data.formats.base import DataFormat, SourceSet, as_frames, chosen
from vd4rl_pomdp.data.shards import EpisodeArrays


def read_shards(path: str, picture: str | None = None) -> SourceSet:
    """Open a data set in this package's format; reading holds at most one episode and one block in memory."""
    folder = Path(path)
    stored = read_set(folder)
    size, ends = stored.frame_size, stored.ends
    chosen({FRAMES_KEY: (3, size, size)}, picture)

    def read(first: int) -> Iterator[EpisodeArrays]:
        episode, begin, held = 0, 0, np.zeros((0, 3, size, size), np.uint8)
        for block in (block for shard in stored.shards for block in read_frames(shard)):
            held = np.concatenate([held, block]) if len(held) else block
            while episode < len(ends) and ends[episode] <= begin + len(held):
                end = ends[episode]
                if episode >= first:
                    rows = {key: value[begin:end] for key, value in stored.rows.items()}
                    yield {FRAMES_KEY: held[: end - begin]} | rows
                held, begin, episode = held[end - begin :], end, episode + 1

    task, quality = task_and_quality(folder, stored.attributes)
    record = {"set": folder.resolve().name, "bytes": sum(shard.stat().st_size for shard in stored.shards)}
    return SourceSet((ends - stored.starts).tolist(), (size, size), read, record, task=task, quality=quality)


def read_npz(path: str, picture: str | None = None) -> SourceSet:
    """Open a folder of episodes, one file each, ordered by name."""
    folder = Path(path)
    files = sorted(folder.glob("[!.]*.npz"))  # macOS writes ._x.npz beside x.npz
    if not files:
        raise UserError(f"{folder}: holds no .npz episodes; name the folder that holds them, such as TASK/QUALITY/64px")
    with _opened(files[0]) as first:
        _, frame_shape = chosen({"image": first["image"].shape[1:]}, picture)
    lengths = [_length(file) for file in files]
    (task, quality), notes = task_and_quality(folder, []), []
    if "64px" in folder.resolve().parts and len(files) <= 100 and task and quality:  # V-D4RL's paper states more
        expert = " of the expert only" if quality == "medium_expert" else ""
        notes = [
            f"the published 64-pixel datasets are incomplete: {folder} has {len(files)} episodes{expert}, the 84-pixel "
            f"one all: `vd4rl-pomdp data download --task {task} --quality {quality}`, then `data import vd4rl SET OUT "
            "--size 64`"
        ]
    record = {"folder": folder.resolve().name, "bytes": sum(file.stat().st_size for file in files)}
    read = lambda first: map(_episode, files[first:])  # noqa: E731
    return SourceSet(lengths, frame_shape, read, record, task=task, quality=quality, notes=notes)


@contextmanager
def _opened(path: Path) -> Iterator[Mapping[str, np.ndarray]]:
    """An episode's arrays, each read when accessed."""
    try:
        with np.load(path) as file:
            if missing := [key for key in ("image", "action", "reward") if key not in file]:
                keys = ", ".join(file)
                raise UserError(f"{path}: has no {missing[0]!r}, so it is not an episode of V-D4RL (keys: {keys})")
            yield file
    except UserError:
        raise
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, KeyError) as error:
        raise UserError(f"{path}: is damaged or not an .npz file ({in_one_line(error)}); download it again") from error


def _length(path: Path) -> int:
    with _opened(path) as file:
        return len(file["reward"])


def _episode(path: Path) -> EpisodeArrays:
    with _opened(path) as file:
        stored = dict(file)
    rows = len(stored["reward"])
    for key in ("image", "action", "discount", "is_first", "is_last", "is_terminal"):
        if (count := len(stored.get(key, stored["reward"]))) != rows:
            raise UserError(f"{path}: {key!r} has {count} rows, 'reward' {rows}; download it again")
    for key, inner in (("is_first", slice(1, None)), ("is_last", slice(0, -1))):
        if stored.get(key, np.zeros(1))[inner].any():
            raise UserError(f"{path}: {key!r} is true in the middle: split it into one file per episode")
    step_type = np.full(rows, StepType.MID, np.int64)
    step_type[-1:] = StepType.LAST if stored.get("is_last", np.ones(1))[-1:].any() else StepType.MID
    step_type[:1] = StepType.FIRST
    action, ended = stored["action"], stored.get("is_terminal", np.zeros(rows))
    return {
        FRAMES_KEY: as_frames(stored["image"]),
        "action": action[:, None] if action.ndim == 1 else action,
        "reward": stored["reward"].astype(float),
        "discount": stored["discount"].astype(float) if "discount" in stored else 1.0 - ended,
        "step_type": step_type,
    }


def write_npz(folder: Path, out: Path, source: SourceSet) -> list[str]:
    """Write one file per episode, with names that sort in order."""
    folder.mkdir()
    states = False
    for number, rows in enumerate(source.read(0)):
        step_type = rows["step_type"]
        states |= "physics" in rows
        np.savez_compressed(
            folder / f"{number:06d}-{len(step_type)}.npz",
            image=rows[FRAMES_KEY].transpose(0, 2, 3, 1),
            action=rows["action"],
            reward=rows["reward"],
            discount=rows["discount"],
            is_first=step_type == StepType.FIRST,
            is_last=step_type == StepType.LAST,
            is_terminal=rows["discount"] == 0,
        )
    lost = ["simulator states are not kept"] if states else []
    names = {"task": source.task, "quality": source.quality}
    if any(name and name != found for name, found in zip(names.values(), task_and_quality(out, []), strict=True)):
        flags = " and ".join(f"--{key} {name}" for key, name in names.items() if name)
        lost.append(f"task and quality are not stored: import with {flags}, or name the folder TASK/QUALITY/64px")
    return lost


VD4RL = DataFormat(
    "V-D4RL's HDF5 shards, this package's own format: to change the frame size or drop short episodes", read_shards
)
VD4RL_NPZ = DataFormat("V-D4RL's 64-pixel .npz episodes, in DreamerV2's layout", read_npz, write_npz)
