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
import math
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
_WRITTEN = {FRAMES_KEY: "uint8", "action": "float32", "step_type": "int64"}
_ATTRIBUTE = "vd4rl_pomdp"
_BLOCK_ROWS = 1024
_LARGEST = np.finfo(np.float32).max
"""Larger values would become infinite in float32."""
_INFLATED = 1032
"""Bytes that gzip can make of one."""
_REPAIR = "download or collect it again"


def write_shard(path: Path, rows: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    """Write one shard atomically (one writer at a time). Equal input gives equal bytes.

    `rows` are arrays by key, of equal length, as in the module's table; they are converted to its dtypes, but UserError
    for frames that are not uint8. `attributes` are JSON values: `task`, `set` (the quality), seed, versions.
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


def read_frame_size(shards: Sequence[Path]) -> int:
    """Height and width S of a data set's frames; UserError for another shape or dtype, or for two sizes."""
    low, high = FRAME_SIZES
    first = 0
    for path in shards:
        with _open(path) as file:
            _keys(path, file)
            frames = file[FRAMES_KEY]
            shape, dtype = frames.shape, frames.dtype
        square = shape == (*shape[:1], 3, *shape[-1:] * 2) and shape[0] and low <= shape[-1] <= high
        if dtype != np.uint8 or not square:
            raise UserError(
                f"{path}: 'observation' is {dtype} of shape {shape}, expected square uint8 frames (N, 3, S, S) "
                f"of {low} to {high} pixels; convert them, or choose another dataset"
            )
        size = shape[-1]
        first = first or size
        if size != first:
            raise UserError(
                f"{path}: has frames of {size}x{size} pixels, {shards[0].name} of {first}x{first}; keep one dataset "
                "per folder"
            )
    return first


def read_rows(path: Path) -> dict[str, np.ndarray]:
    """Read and validate everything in a shard except its frames.

    Returns:
        action (N, A) float32, reward and discount (N,) float64, step_type (N,) uint8, and physics (N, P) float64 if
        the shard has it.
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
        if value.ndim != _ROW_KEYS[key] or len(value) != count or not value.size:
            expected = f"({count},)" if _ROW_KEYS[key] == 1 else f"({count}, width)"
            raise UserError(f"{place}: {key!r} has shape {value.shape}, expected {expected}; {_REPAIR}")
        if key == "step_type":
            if value.dtype.kind not in "iuf" or not np.isin(value, [int(s) for s in StepType]).all():
                raise UserError(f"{place}: 'step_type' holds values other than 0, 1 and 2; {_REPAIR}")
            continue
        if value.dtype.kind != "f":
            raise UserError(f"{place}: {key!r} is {value.dtype}, expected floating point; {_REPAIR}")
        # Not `> _LARGEST`, which is False for NaN.
        bad = np.flatnonzero(~(np.abs(value.reshape(count, -1)) <= _LARGEST).all(1))
        if len(bad):
            rows_text = f"row {bad[0]} ({len(bad)} such rows)"
            raise UserError(f"{place}: {key!r} is not finite as float32 in {rows_text}; {_REPAIR}")
    # first rows, which follow no step, may store any discount
    outside = ((rows["discount"] < 0) | (rows["discount"] > 1)) & (rows["step_type"] != StepType.FIRST)
    if outside.any():
        row = int(outside.argmax())
        raise UserError(f"{place}: 'discount' is {rows['discount'][row]!s} in row {row}, not within 0 and 1; {_REPAIR}")


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
        if "unable to lock file" in str(error) or "already open for write" in str(error):
            raise UnavailableError(
                f"{path}: another program is writing it or was killed while writing, or its disk does not support "
                "locks; close that program and re-run the same command, clear the file's flag with `h5clear -s` "
                "(Debian: hdf5-tools), or set HDF5_USE_FILE_LOCKING=FALSE to read without locks"
            ) from error
        damaged = UserError(f"{path}: is truncated, damaged or not an HDF5 file ({in_one_line(error)}); {_REPAIR}")
        raise system_error(path, error) or damaged from error


def _keys(path: Path, file: h5py.File) -> list[str]:
    """Keys of the format that are in a file; UserError if one is missing, no array, not stored, or in another file."""
    refuse_elsewhere(path, file)
    keys = [key for key in (FRAMES_KEY, *_ROW_KEYS) if key != "physics" or key in file]
    for key in keys:
        # not `file.get`, which hides a failing disk; HDF5's null datasets have no shape
        if key not in file or not isinstance(stored := file[key], h5py.Dataset) or stored.shape is None:
            raise UserError(f"{path}: has no {key!r}, so it is not a V-D4RL shard (keys: {', '.join(file)}); {_REPAIR}")
        size, held = math.prod(stored.shape) * stored.dtype.itemsize, stored.id.get_storage_size()
        if size > held * _INFLATED + 2**20:  # such as rows that were never written
            raise UserError(f"{path}: {key!r} has {size:,} bytes, of which {held:,} are stored; {_REPAIR}")
    return keys


def refuse_elsewhere(path: Path, file: h5py.File) -> None:
    """Raise UserError if anything in an HDF5 file is in another one, which is then never opened.

    A data set from elsewhere must not make its reader read other files here.
    """
    names: list[bytes] = []
    file.id.links.visit(names.append)  # h5py's own functions open what a link names; no callback may raise
    for name in names:
        kind = file.id.links.get_info(name).type
        stored = file[name] if kind == h5py.h5l.TYPE_HARD else None
        kept = isinstance(stored, h5py.Dataset) and (stored.external or stored.is_virtual)
        if kept or kind == h5py.h5l.TYPE_EXTERNAL:
            found = name.decode(errors="replace")
            raise UserError(f"{path}: {found!r} is stored in another file, which is not supported; {_REPAIR}")
