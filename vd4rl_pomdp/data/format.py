"""V-D4RL shards: gzip HDF5 files of single frames, read as they are published and written so that others can read them.

    observation (N, 3, 84, 84) uint8    action (N, A) float32    reward (N,) float64    discount (N,) float64
    step_type   (N,) 0 first, 1 mid, 2 last (int64 in some published files, float64 in others)
    physics     (N, P) float64, simulator state of every row: only in sets collected by this package

A set is a folder of shards. Its rows are those of all shards in order; an episode may continue in the next shard.
"""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.tasks import FRAME_SIZE
from vd4rl_pomdp.types import StepType

FRAME_SHAPE = (3, FRAME_SIZE, FRAME_SIZE)
SUFFIXES = (".hdf5", ".h5")
_KEYS = {"observation": 4, "action": 2, "reward": 1, "discount": 1, "step_type": 1}
_ATTRIBUTE = "vd4rl_pomdp"


def shard_paths(folder: Path) -> list[Path]:
    """Shards of a set in the order of their rows.

    Sorted by name without its leading number, then by that number, digits compared as numbers: `10_mixed` follows
    `9_mixed`, and the two halves of a medium_expert folder are not interleaved.
    """
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; collect a set there or download one with `vd4rl-pomdp data`")
    shards = [p for p in folder.iterdir() if p.suffix in SUFFIXES and not p.name.startswith(".")]
    if not shards:
        raise UserError(f"{folder}: holds no .hdf5 shards; name the folder that contains them")
    return sorted(shards, key=lambda path: _shard_order(path.stem))


def _shard_order(stem: str) -> tuple[Any, ...]:
    number, rest = re.fullmatch(r"(\d*)(.*)", stem, re.DOTALL).groups()  # type: ignore[union-attr]
    words = [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", rest)]
    return words, int(number or -1)


def write_shard(path: Path, rows: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    """Write one shard; a reader sees it whole or not at all.

    Args:
        path: the shard's final name.
        rows: the arrays of the module's table, by key, of equal length.
        attributes: JSON values to keep with the shard (task, quality, seed, versions).

    Raises:
        UserError: the disk is full or the folder cannot be written; nothing is left behind.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with h5py.File(temporary, "w", track_order=False) as file:
            file.attrs[_ATTRIBUTE] = json.dumps(dict(attributes), sort_keys=True)
            for key, value in rows.items():
                chunks = (min(len(value), 50), *value.shape[1:]) if key == "observation" else True
                file.create_dataset(key, data=value, chunks=chunks, compression="gzip", compression_opts=4)
        temporary.replace(path)
    except OSError as error:
        raise disk_error(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def disk_error(path: Path, error: OSError) -> UserError:
    """A sentence for a failed write."""
    full = error.errno == errno.ENOSPC or "No space left" in str(error)
    what = "the disk is full: free some space and start the same command again" if full else f"cannot write ({error})"
    return UserError(f"{path}: {what}")


def read_attributes(path: Path) -> dict[str, Any]:
    """What `write_shard` kept with a shard; empty for a published one."""
    with _open(path) as file:
        return json.loads(file.attrs.get(_ATTRIBUTE, "{}"))


def read_shard(path: Path) -> dict[str, np.ndarray]:
    """Read and validate one shard.

    Returns:
        observation uint8, action float32, reward float64, discount float64, step_type uint8, and physics float64
        where the shard has it.

    Raises:
        UserError: the file is truncated or no HDF5, lacks a key, or holds a wrong shape, dtype or value.
    """
    with _open(path) as file:
        missing = [key for key in _KEYS if key not in file]
        if missing:
            raise UserError(f"{path}: has no {missing[0]!r}; it is not a V-D4RL shard (keys: {', '.join(file)})")
        try:
            rows = {key: file[key][()] for key in [*_KEYS, *(["physics"] if "physics" in file else [])]}
        except OSError as error:
            raise UserError(f"{path}: is damaged ({error}); download or collect it again") from error
    _validate(path, rows)
    dtypes = {"observation": "uint8", "action": "float32", "step_type": "uint8"}
    return {key: value.astype(dtypes.get(key, "float64"), copy=False) for key, value in rows.items()}


def _open(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise UserError(f"{path}: is truncated or no HDF5 file ({error}); download or collect it again") from error


def _validate(path: Path, rows: dict[str, np.ndarray]) -> None:
    count = len(rows["observation"])
    for key, value in rows.items():
        dimensions = _KEYS.get(key, 2)
        if value.ndim != dimensions or len(value) != count:
            raise UserError(f"{path}: {key!r} has shape {value.shape}, expected {dimensions} dimensions, {count} rows")
    frames = rows["observation"]
    if frames.dtype != np.uint8 or frames.shape[1:] != FRAME_SHAPE:
        raise UserError(
            f"{path}: 'observation' is {frames.dtype} of shape {frames.shape}, expected uint8 (N, 3, 84, 84); "
            "64-pixel sets are not supported"
        )
    for key in ("action", "reward", "discount", *(["physics"] if "physics" in rows else [])):
        if not np.issubdtype(rows[key].dtype, np.floating):
            raise UserError(f"{path}: {key!r} is {rows[key].dtype}, expected floating point")
        bad = np.flatnonzero(~np.isfinite(rows[key].reshape(count, -1)).all(1))
        if len(bad):
            raise UserError(f"{path}: {key!r} is not finite in row {bad[0]} ({len(bad)} such rows); repair the shard")
    if not np.isin(rows["step_type"], [int(s) for s in StepType]).all():
        raise UserError(f"{path}: 'step_type' holds values other than 0, 1 and 2; repair the shard")
