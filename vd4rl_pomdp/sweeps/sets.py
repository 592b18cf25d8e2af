"""The data sets of a sweep: found below a folder, or to be collected there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import FRAME_SIZE
from vd4rl_pomdp.data.folder import PLAN, PROVENANCE, shard_files, shard_paths
from vd4rl_pomdp.data.format import read_frame_size
from vd4rl_pomdp.data.shards import differing
from vd4rl_pomdp.data.store import open_store
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.sweeps.grid import GridCell
from vd4rl_pomdp.sweeps.naming import extras
from vd4rl_pomdp.sweeps.stages import collection_of

_DOWNLOADED = "84px"
"""Folder in which a downloaded set has its shards."""


@dataclass(frozen=True)
class DataSet:
    """A set that cells of a grid need."""

    name: str
    folder: Path
    section: str
    """Which command collects it."""
    wanted: Mapping[str, Any]
    """How it is collected, by setting."""

    @property
    def collected(self) -> bool:
        """Whether it is there and whole, having been collected."""
        return (self.folder / PROVENANCE).is_file()

    @property
    def foreign(self) -> bool:
        """Whether shards are there that nothing here collected, such as a downloaded set."""
        return not (self.folder / PLAN).exists() and bool(shard_files(self.folder))

    @property
    def there(self) -> bool:
        """Whether nothing is left to collect."""
        return self.collected or self.foreign

    @cached_property
    def fingerprint(self) -> str:
        """As `content_of`, which is asked once."""
        return content_of(self.folder)

    def check(self) -> None:
        """Raise UserError if its folder holds a set that was collected otherwise, or not downloaded to its end."""
        if self.foreign:
            self._check_frames(shard_paths(self.folder))
        stored = read_json(self.folder / PLAN) if (self.folder / PLAN).exists() else self.wanted
        if others := differing(stored, self.wanted):
            has, asked = (_told(others[0], values.get(others[0])) for values in (stored, self.wanted))
            raise UserError(f"{self.folder}: holds a set of {has}, the grid says {asked}; choose another --data")

    def _check_frames(self, shards: list[Path]) -> None:
        """Raise UserError if a set that nothing here collected has frames of another size: its files tell no more."""
        asked = self.wanted.get("frame_size") or FRAME_SIZE
        if self.section == "collect" and (size := read_frame_size(shards)) != asked:
            raise UserError(
                f"{self.folder}: holds frames of {size}x{size} pixels, the grid says {asked}; choose another --data"
            )

    def made(self, record: Mapping[str, Any]) -> bool:
        """Whether a run, as its config.json tells it, was trained on this set."""
        if self.there:
            return record.get("inputs", {}).get("data") == self.fingerprint
        return self.alike(record)

    def alike(self, record: Mapping[str, Any]) -> bool:
        """Whether a run was trained on a set that was collected as this one is, whatever came of it."""
        collection = record.get("collection") or {}
        return bool(collection) and not differing(collection, self.wanted)


def content_of(folder: Path) -> str:
    """Name of the content of the set in a folder, empty if there is none; one never opened before is decoded first."""
    return open_store(folder).fingerprint if shard_files(folder) else ""


def set_of(cell: GridCell, root: Path) -> DataSet:
    """The set of a cell, below `root`; raises UserError if it trains on none."""
    section = cell.chain[0]
    if section not in ("collect", "navigation_collect"):
        raise UserError(f"a block trains on no set: add a section {'navigation_' * ('navigation' in section)}collect")
    wanted = collection_of(cell)
    place = "/".join(wanted[name] for name in (("task", "quality") if section == "collect" else ("maze",)))
    name = place + extras(cell, section)
    folder = root / name
    inner = folder / _DOWNLOADED
    return DataSet(name, inner if inner.is_dir() else folder, section, wanted)


def _told(name: str, value: Any) -> str:
    return f"the default {name}" if value is None else f"{name} {value}"
