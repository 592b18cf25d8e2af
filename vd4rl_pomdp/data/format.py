"""Read and write V-D4RL shards, gzip-compressed HDF5 files of single frames:

    observation (N, 3, S, S) uint8      action (N, A) float32    reward (N,) float64    discount (N,) float64
    step_type   (N,) 0 first, 1 mid, 2 last (int64 in some published files, float64 in others)
    physics     (N, P) float64, simulator state of every row: only in sets collected by this package

S is 84 in the benchmark and 100 in mazes, and the same in all shards of a data set. A data set is a folder of shards,
whose rows are concatenated in order; an episode may continue in the next shard.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vd4rl_pomdp.core.errors import UnavailableError, UserError, in_one_line, system_error
from vd4rl_pomdp.core.reading import parse_json, regular
from vd4rl_pomdp.core.tasks import FRAME_SIZES
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.runs.files import write_bytes

FRAMES_KEY = "observation"
_ROW_KEYS = {"action": 2, "reward": 1, "discount": 1, "step_type": 1, "physics": 2}
_OPTIONAL = "physics"
_WRITTEN = {FRAMES_KEY: "uint8", "action": "float32", "step_type": "int64"}
_ATTRIBUTE = "vd4rl_pomdp"
_BLOCK_ROWS = 1024
_LARGEST = np.finfo(np.float32).max
"""Larger values would become infinite in float32."""
_REPAIR = "download or collect it again"


def write_shard(path: Path, rows: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    """Write one shard atomically. Equal input gives equal bytes.

    Args:
        path: the shard's file; it is written to a hidden file next to it and renamed. One writer at a time.
        rows: arrays by key, of equal length, as in the module's table; converted to its dtypes.
        attributes: JSON values to store with the shard: `task`, `set` (the quality), seed, versions.

    Raises:
        UserError: frames are not uint8, the disk is full or the folder not writable; no partial file remains.
    """
    if (dtype := np.asarray(rows.get(FRAMES_KEY, np.uint8(0))).dtype) != np.uint8:
        raise UserError(f"{path}: {FRAMES_KEY} is {dtype}; frames must be uint8, from 0 to 255")
    buffer = io.BytesIO()  # in memory: HDF5 cannot close a file on a full disk
    with h5py.File(buffer, "w") as file:
        file.attrs[_ATTRIBUTE] = json.dumps(dict(attributes), sort_keys=True)
        for key, value in rows.items():
            data = np.asarray(value, _WRITTEN.get(key, "float64"))
            # 50 frames a chunk: decoding inflates few at once, and single rows are read without the whole shard
            chunks = (min(len(data), 50), *data.shape[1:]) if key == FRAMES_KEY else True
            file.create_dataset(key, data=data, chunks=chunks, compression="gzip", compression_opts=4)
    write_bytes(path, buffer.getvalue())


def read_attributes(path: Path) -> dict[str, Any]:
    """Attributes that `write_shard` stored with a shard; empty for V-D4RL's own."""
    with _open(path) as file:
        stored = file.attrs.get(_ATTRIBUTE, "{}")
        attributes = parse_json(stored) if isinstance(stored, str) else None
        if not isinstance(attributes, dict):
            raise UserError(f"{path}: its attribute {_ATTRIBUTE!r} is not a JSON object; {_REPAIR}")
        return attributes


def read_dtypes(path: Path) -> dict[str, str]:
    """Stored dtype of every key of a shard."""
    with _open(path) as file:
        return {key: str(file[key].dtype) for key in _keys(path, file)}


def read_frame_size(shards: Sequence[Path]) -> int:
    """Height and width S of a data set's frames; UserError for another shape or dtype, or for two sizes."""
    sizes = [_frame_size(path) for path in shards]
    for path, size in zip(shards, sizes, strict=True):
        if size != sizes[0]:
            raise UserError(
                f"{path}: has frames of {size}x{size} pixels, {shards[0].name} of {sizes[0]}x{sizes[0]}; keep one "
                "dataset per folder"
            )
    return sizes[0]


def _frame_size(path: Path) -> int:
    low, high = FRAME_SIZES
    with _open(path) as file:
        _keys(path, file)
        frames = file[FRAMES_KEY]
        shape = frames.shape
        square = shape == (*shape[:1], 3, *shape[-1:] * 2) and shape[0] and low <= shape[-1] <= high
        if frames.dtype != np.uint8 or not square:
            raise UserError(
                f"{path}: 'observation' is {frames.dtype} of shape {shape}, expected square uint8 frames (N, 3, S, S) "
                f"of {low} to {high} pixels; convert them, or choose another dataset"
            )
        return shape[-1]


def read_rows(path: Path) -> dict[str, np.ndarray]:
    """Read and validate everything in a shard except its frames.

    Args:
        path: the shard.

    Returns:
        action (N, A) float32, reward and discount (N,) float64, step_type (N,) uint8, and physics (N, P) float64 if
        the shard has it.

    Raises:
        UserError: the file is truncated, not HDF5, lacks a key, or has a wrong shape, dtype or value.
    """
    read_frame_size([path])
    with _open(path) as file:
        keys = _keys(path, file)
        rows = {key: file[key][()] for key in keys if key != FRAMES_KEY}
        count = len(file[FRAMES_KEY])
    check_rows(path, rows, count)
    dtypes = {"action": "float32", "step_type": "uint8"}
    return {key: value.astype(dtypes.get(key, "float64"), copy=False) for key, value in rows.items()}


def check_rows(place: Path | str, rows: Mapping[str, np.ndarray], count: int) -> None:
    """Raise UserError, naming `place`, unless `rows` hold `count` rows with valid shapes, dtypes and values."""
    for key, value in rows.items():
        _check_column(place, key, value, count)
    # first rows, which follow no step, may store any discount
    outside = ((rows["discount"] < 0) | (rows["discount"] > 1)) & (rows["step_type"] != StepType.FIRST)
    if outside.any():
        row = int(outside.argmax())
        told = rows["discount"][row]
        raise UserError(f"{place}: 'discount' is {told!s} in row {row}, not within 0 and 1; {_REPAIR}")


def read_frames(path: Path) -> Iterator[np.ndarray]:
    """Read the frames of a shard in order, in blocks of (M, 3, S, S) uint8 with M some thousand or fewer."""
    with _open(path) as file:
        frames = file[FRAMES_KEY]
        chunk = frames.chunks[0] if frames.chunks else 1
        rows = max(1, _BLOCK_ROWS // chunk) * chunk  # whole chunks, so that each is decompressed once
        for start in range(0, len(frames), rows):
            yield frames[start : start + rows]


def read_some_frames(path: Path, rows: np.ndarray) -> np.ndarray:
    """Read the frames (R, 3, S, S) uint8 of increasing row numbers (R,)."""
    with _open(path) as file:
        return file[FRAMES_KEY][rows]


@contextmanager
def _open(path: Path) -> Iterator[h5py.File]:
    """Open a shard; HDF5's errors become one-line UserErrors."""
    try:
        with h5py.File(regular(path), "r") as file:
            yield file
    except UserError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        damaged = UserError(f"{path}: is truncated, damaged or not an HDF5 file ({in_one_line(error)}); {_REPAIR}")
        raise _locked(path, error) or system_error(path, error) or damaged from error


def _locked(path: Path, error: Exception) -> UserError | None:
    """Error for a shard that is locked, or marked by HDF5 as open for writing; None for other errors."""
    if isinstance(error, OSError) and error.errno and "unable to lock file" in str(error):
        return UnavailableError(
            f"{path}: another program writes it, or its disk has no locks ({os.strerror(error.errno).lower()}); close "
            "that program and re-run the same command, or set HDF5_USE_FILE_LOCKING=FALSE to read without locks"
        )
    if "already open for write" in str(error):
        return UnavailableError(
            f"{path}: another program writes it, or was killed while it did; close that program and re-run the same "
            "command, or remove its mark with `h5clear -s`"
        )
    return None


def _keys(path: Path, file: h5py.File) -> list[str]:
    """Keys of the format that are in a file; UserError if one is missing, no array, or stored in another file."""
    wanted = [FRAMES_KEY, *_ROW_KEYS]
    keys = [key for key in wanted if key != _OPTIONAL or file.get(key, getlink=True) is not None]
    for key in keys:
        elsewhere = isinstance(file.get(key, getlink=True), h5py.ExternalLink)
        stored = file[key] if not elsewhere and key in file else None  # `file.get` hides a failing disk
        if isinstance(stored, h5py.Dataset):
            elsewhere = stored.external is not None or stored.is_virtual
        if elsewhere:
            raise UserError(f"{path}: {key!r} is stored in another file, which is not supported; {_REPAIR}")
        if not isinstance(stored, h5py.Dataset) or stored.shape is None:  # HDF5's null datasets have no shape
            raise UserError(f"{path}: has no {key!r}, so it is not a V-D4RL shard (keys: {', '.join(file)}); {_REPAIR}")
    return keys


def _check_column(path: Path | str, key: str, value: np.ndarray, count: int) -> None:
    """Raise UserError for a wrong shape, dtype or value of one key."""
    if value.ndim != _ROW_KEYS[key] or len(value) != count or not value.size:
        expected = f"({count},)" if _ROW_KEYS[key] == 1 else f"({count}, width)"
        raise UserError(f"{path}: {key!r} has shape {value.shape}, expected {expected}; {_REPAIR}")
    if key == "step_type":
        if value.dtype.kind not in "iuf" or not np.isin(value, [int(s) for s in StepType]).all():
            raise UserError(f"{path}: 'step_type' holds values other than 0, 1 and 2; {_REPAIR}")
        return
    if value.dtype.kind != "f":
        raise UserError(f"{path}: {key!r} is {value.dtype}, expected floating point; {_REPAIR}")
    # Not `> _LARGEST`, which is False for NaN.
    bad = np.flatnonzero(~(np.abs(value.reshape(count, -1)) <= _LARGEST).all(1))
    if len(bad):
        raise UserError(f"{path}: {key!r} is not finite as float32 in row {bad[0]} ({len(bad)} such rows); {_REPAIR}")
