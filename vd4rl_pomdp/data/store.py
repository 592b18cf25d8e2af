"""The store: a set decoded once into flat memory-mapped arrays that every process of the machine shares.

    <cache>/<fingerprint>/  frames.u8  (N, 3, 84, 84) uint8, each frame once      action.npy ... physics.npy
                            meta.json  shapes, checksums, attributes (written last)
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.data.format import FRAME_SHAPE, disk_error, read_attributes, read_shard, shard_paths
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.types import StepType

_VERSION = 1
_FRAMES = "frames.u8"


@dataclass(frozen=True)
class Store:
    """A decoded set on disk."""

    folder: Path
    meta: dict[str, Any]
    """rows, checksums by file name, attributes of the first shard, shards."""

    def frames(self) -> np.ndarray:
        """(N, 3, 84, 84) uint8, mapped from the file."""
        path = self.folder / _FRAMES
        shape = (self.meta["rows"], *FRAME_SHAPE)
        if path.stat().st_size != np.prod(shape):
            raise UserError(f"{path}: has the wrong size; remove {self.folder} and the set is decoded again")
        return np.memmap(path, np.uint8, "r", shape=shape)

    def array(self, key: str) -> np.ndarray | None:
        """A small array by key, None if the set does not have it."""
        path = self.folder / f"{key}.npy"
        return np.load(path, mmap_mode="r" if key == "physics" else None) if path.exists() else None

    def verify(self) -> bool:
        """Whether every file still has the checksum it was written with."""
        return all(_checksum(self.folder / name) == value for name, value in self.meta["checksums"].items())


def default_cache() -> Path:
    """Where decoded sets are kept: $VD4RL_POMDP_CACHE, else the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("VD4RL_POMDP_CACHE") or Path(base) / "vd4rl-pomdp")


def fingerprint(shards: list[Path]) -> str:
    """Name of a set's decoded form; it changes with the names, sizes and times of its shards."""
    stats = [(path.resolve().as_posix(), path.stat().st_size, path.stat().st_mtime_ns) for path in shards]
    return hashlib.blake2b(json.dumps([_VERSION, stats]).encode(), digest_size=12).hexdigest()


def open_store(path: Path, cache: Path | None = None) -> Store:
    """Open the decoded form of the set at `path`, decoding it first if that was never done."""
    shards = shard_paths(path)
    root = cache or default_cache()
    folder = root / fingerprint(shards)
    if not (folder / "meta.json").exists():
        _decode(shards, folder)
    return Store(folder, json.loads((folder / "meta.json").read_text()))


def _decode(shards: list[Path], folder: Path) -> None:
    """Decode into a folder of its own and rename it; whoever of several processes comes second keeps the first's."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:
        raise disk_error(folder.parent, error) from error
    try:
        meta = _write_arrays(shards, scratch)
        meta["checksums"] = {p.name: _checksum(p) for p in sorted(scratch.iterdir())}
        (scratch / "meta.json").write_text(json.dumps(meta, indent=1))
        if not folder.exists():
            scratch.rename(folder)
    except OSError as error:
        if not (folder / "meta.json").exists():
            raise disk_error(folder, error) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write_arrays(shards: list[Path], scratch: Path) -> dict[str, Any]:
    parts: dict[str, list[np.ndarray]] = {}
    with (scratch / _FRAMES).open("wb") as frames, ProgressLine("decode", len(shards), "shards") as progress:
        for shard in shards:
            rows = read_shard(shard)
            rows.pop("observation").tofile(frames)
            for key, value in rows.items():
                parts.setdefault(key, []).append(value)
            progress.advance()
    _check_agreement(shards, parts)
    rows = {key: np.concatenate(value) for key, value in parts.items()}
    _check_episodes(shards, [len(part) for part in parts["reward"]], rows["step_type"])
    for key, value in rows.items():
        np.save(scratch / f"{key}.npy", value)
    return {
        "rows": len(rows["reward"]),
        "shards": [s.name for s in shards],
        "attributes": [read_attributes(s) for s in shards],
    }


def _check_agreement(shards: list[Path], parts: dict[str, list[np.ndarray]]) -> None:
    widths = [part.shape[1] for part in parts["action"]]
    other = next((i for i, width in enumerate(widths) if width != widths[0]), None)
    if other is not None:
        raise UserError(
            f"{shards[other]}: has {widths[other]} action dimensions, {shards[0].name} has {widths[0]}; "
            "a folder must hold one set"
        )
    if "physics" in parts and len(parts["physics"]) != len(shards):
        raise UserError(f"{shards[0].parent}: some shards have 'physics' and some have not; a folder must hold one set")


def _check_episodes(shards: list[Path], lengths: list[int], step_type: np.ndarray) -> None:
    """The first row must be FIRST, and FIRST must follow every LAST."""
    wrong = np.flatnonzero((step_type[:-1] == StepType.LAST) & (step_type[1:] != StepType.FIRST)) + 1
    if step_type[0] != StepType.FIRST:
        wrong = np.array([0])
    if len(wrong):
        shard = int(np.searchsorted(np.cumsum(lengths), wrong[0], side="right"))
        row = int(wrong[0] - sum(lengths[:shard]))
        raise UserError(
            f"{shards[shard]}: row {row} continues an episode whose beginning is missing; "
            "a shard before it is missing or was renamed"
        )


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
