"""The store: a cache of data sets decoded into flat memory-mapped arrays, shared by all processes of the machine.

    <cache>/<key>/  frames.u8  (N, 3, S, S) uint8, each frame once      action.npy ... physics.npy
                    meta.json  rows, shards, attributes, size and checksum of every file

The key hashes the shards' paths, sizes and modification times, so a changed data set is decoded again. Decoding writes
to a hidden folder and renames it at the end, under a file lock. The cache may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from vd4rl_pomdp.core.errors import DiskFullError, UserError, disk_errors, system_error
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.folder import check_count, read_set, shard_paths
from vd4rl_pomdp.data.format import read_frames
from vd4rl_pomdp.runs.files import content_hash
from vd4rl_pomdp.runs.progress import ProgressLine

_VERSION = 2
_FRAMES = "frames.u8"
_META = "meta.json"


@dataclass(frozen=True)
class Store:
    """A decoded data set on disk."""

    folder: Path
    meta: dict[str, Any]
    """rows: N; shards: file names; attributes: of every shard; files: bytes and blake2b by file name."""

    @property
    def fingerprint(self) -> str:
        """Hash of the content as training reads it; equal rows have equal fingerprints on every machine.

        Rewards are hashed as float32, which `Dataset` trains on. Their last float64 bits depend on the processor:
        dm_control's rewards call numpy's exp, which has a separate implementation for AVX-512.
        """
        checksums = {name: file["blake2b"] for name, file in self.meta["files"].items()}
        reward, file = self.array("reward"), io.BytesIO()
        np.save(file, reward.astype(np.float32).astype(reward.dtype))
        checksums["reward.npy"] = hashlib.blake2b(file.getbuffer(), digest_size=16).hexdigest()
        return content_hash(checksums)

    @property
    def frame_size(self) -> int:
        return math.isqrt(self.meta["files"][_FRAMES]["bytes"] // (3 * self.meta["rows"]))

    def frames(self) -> np.ndarray:
        """Frames (N, 3, S, S) uint8, memory-mapped read-only."""
        shape = (self.meta["rows"], 3, self.frame_size, self.frame_size)
        return self._load(_FRAMES, lambda path: np.memmap(path, np.uint8, "r", shape=shape))

    def array(self, key: str) -> np.ndarray:
        """Rows of `action` (N, A) float32, `reward` or `discount` (N,) float64, or `step_type` (N,) uint8."""
        return self._load(f"{key}.npy", np.load)

    def physics(self) -> np.ndarray | None:
        """Simulator states (N, P) float64, memory-mapped read-only; None if the data set has none."""
        if "physics.npy" not in self.meta["files"]:
            return None
        return self._load("physics.npy", partial(np.load, mmap_mode="r"))

    def _load(self, name: str, read: Callable[[Path], np.ndarray]) -> np.ndarray:
        try:
            return read(self.folder / name)
        except (OSError, ValueError, EOFError) as error:
            raise system_error(self.folder / name, error) or self.damaged(name) from error

    def damaged(self, name: str) -> UserError:
        """Error for a cached file that is damaged or was changed."""
        return UserError(f"{self.folder / name}: is damaged; delete {self.folder} to decode the dataset again")


def default_cache() -> Path:
    """Folder of decoded data sets: $VD4RL_POMDP_CACHE, else the user's cache folder."""
    if chosen := os.environ.get("VD4RL_POMDP_CACHE"):
        return Path(chosen)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vd4rl-pomdp"
    except RuntimeError as error:
        raise UserError("this user has no home folder: set VD4RL_POMDP_CACHE to a folder for decoded sets") from error


def open_store(path: Path, cache: Path | None = None) -> Store:
    """Open the decoded form of the data set at `path`, decoding it first if needed; errors as `open_dataset`."""
    with disk_errors(path):
        shards = shard_paths(path)
        stats = [(path.resolve().as_posix(), path.stat().st_size, path.stat().st_mtime_ns) for path in shards]
    key = hashlib.blake2b(json.dumps([_VERSION, stats]).encode(), digest_size=12).hexdigest()
    folder = (cache or default_cache()) / key
    meta = _read_meta(folder)
    if meta is None:
        with disk_errors(folder.parent):
            folder.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(folder.with_suffix(".lock")):  # one process decodes, the others wait for it
                meta = _read_meta(folder) or _decode(path, folder)
    store = Store(folder, meta)
    check_count(path, int((store.array("step_type") == StepType.FIRST).sum()))  # collection.json is not in the key
    return store


def verify_store(store: Store) -> None:
    """Recompute every checksum; UserError naming the first file that differs."""
    for name, file in store.meta["files"].items():
        with disk_errors(store.folder / name):
            checksum = _checksum(store.folder / name)
        if checksum != file["blake2b"]:
            raise store.damaged(name)


def _read_meta(folder: Path) -> dict[str, Any] | None:
    """A folder's meta.json; None unless it is valid and every file exists with its full size."""
    try:
        meta = parse_json(read_bytes(folder / _META))
        files = [(folder / name, file["bytes"]) for name, file in meta["files"].items()]
    except UserError:
        raise
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return meta if all(path.is_file() and path.stat().st_size == size for path, size in files) else None


def _decode(path: Path, folder: Path) -> dict[str, Any]:
    """Decode into a hidden folder, then rename it; leftovers of a killed process are removed first."""
    stored = read_set(path)
    scratch = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        scratch.mkdir()
        count = len(stored.rows["reward"])
        size, free = count * 3 * stored.frame_size**2, shutil.disk_usage(scratch).free
        if size > free:
            raise DiskFullError(
                f"{folder.parent}: decoding needs {size:,} bytes, the disk has {free:,}; free some space or set "
                "VD4RL_POMDP_CACHE to a folder on another disk"
            )
        _write_frames(stored.shards, scratch / _FRAMES, count)
        for key, value in stored.rows.items():
            np.save(whole := io.BytesIO(), value)  # on a full disk numpy's own file raises without an error number
            (scratch / f"{key}.npy").write_bytes(whole.getvalue())
        files = {p.name: {"bytes": p.stat().st_size, "blake2b": _checksum(p)} for p in sorted(scratch.iterdir())}
        names = [shard.name for shard in stored.shards]
        meta = {"rows": count, "shards": names, "attributes": stored.attributes, "files": files}
        (scratch / _META).write_text(json.dumps(meta, indent=1), encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)  # a damaged one
        # The last step, so that a killed process leaves no incomplete folder.
        scratch.rename(folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return meta


def _write_frames(shards: Sequence[Path], path: Path, rows: int) -> None:
    # written, not memory-mapped: a full disk then raises an error instead of SIGBUS
    progress = ProgressLine("decode", rows, "frames") if sys.stderr.isatty() else None
    with path.open("wb") as file, progress or nullcontext():
        for shard in shards:
            for block in read_frames(shard):
                file.write(block.data)
                if progress:
                    progress.advance(len(block))


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
