"""A run is a folder: config.json first, then metrics.jsonl, checkpoint/ and results; the same command continues it.

Everything but `timing.json` and `machine.json` is the same whether a run was interrupted or not.
"""

from __future__ import annotations

import csv
import json
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs.provenance import command, git_commit, machine, versions
from vd4rl_pomdp.runs.reading import parse_json, regular

_RUNTIME_FIELDS = {"out", "device", "workers", "wandb", "resume_every"}
"""Config fields that do not change a result, so that a run may go on with other ones."""


class RunFolder:
    """Owns a run's files."""

    def __init__(self, path: Path, stage: str, config: Any) -> None:
        self.path = path
        self._claim(stage, jsonable(asdict(config)))
        self._started = time.monotonic()

    def _claim(self, stage: str, config: dict[str, Any]) -> None:
        file = self.path / "config.json"
        if file.exists():
            stored = read_json(file)
            old = stored["config"] if isinstance(stored.get("config"), dict) else {}
            keys = (set(old) | set(config)) - _RUNTIME_FIELDS
            differing = sorted(k for k in keys if old.get(k) != config.get(k))
            if stored.get("stage") != stage or differing:
                what = ", ".join(differing) or f"stage {stored.get('stage')}"
                raise UserError(
                    f"{self.path}: holds a run with another config ({what}); choose another --out or remove it"
                )
            return
        if self.path.exists() and any(self.path.iterdir()):
            raise UserError(f"{self.path}: is not empty and holds no run; choose another --out")
        self.path.mkdir(parents=True, exist_ok=True)
        record = {"stage": stage, "config": config, "versions": versions(), "git_commit": git_commit()}
        write_json(self.path / "machine.json", machine())
        write_json(file, record | {"command": command()})

    @property
    def checkpoint(self) -> Path:
        """Folder of the newest checkpoint."""
        return self.path / "checkpoint"

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end."""
        return (self.path / "timing.json").exists()

    def finish(self, seconds: float, **more: Any) -> None:
        """Mark the run as done and keep its wall-clock seconds, those before an interruption included."""
        write_json(self.path / "timing.json", {"seconds": round(seconds, 2)} | more)

    def seconds(self, before: float) -> float:
        """Wall-clock seconds of the run so far, given those spent before an interruption."""
        return before + time.monotonic() - self._started


def jsonable(value: Any) -> Any:
    """Config values as JSON: paths become strings, tuples become lists."""
    if isinstance(value, dict):
        return {k: jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; raises UserError if it is missing or damaged."""
    try:
        value = parse_json(regular(path).read_text())
    except UserError:
        raise
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as JSON ({error})") from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: holds no JSON object")
    return value


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file so that a reader sees it whole or not at all."""
    with replacing_file(path) as fresh:
        fresh.write_text(json.dumps(value, indent=2) + "\n")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> None:
    """Write a CSV file, its header first, so that a reader sees it whole or not at all."""
    with replacing_file(path) as fresh, fresh.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@contextmanager
def replacing_file(path: Path) -> Iterator[Path]:
    """A hidden name beside `path` to write, which takes `path`'s place when the block ends, or goes if it fails."""
    fresh = path.with_name(f".{path.name}.tmp")
    try:
        yield fresh
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """An empty folder to fill that then takes `folder`'s place; cut at any moment, the old or the new one is whole.

    Between the two renames only `newest` finds the old one.
    """
    fresh, old = folder.with_name(folder.name + ".new"), _old(folder)
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    yield fresh
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        folder.rename(old)
    fresh.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def newest(folder: Path) -> Path | None:
    """Where the newest whole content of a folder lies that `replacing` fills; None if it never did."""
    return next((path for path in (folder, _old(folder)) if path.exists()), None)


def _old(folder: Path) -> Path:
    return folder.with_name(folder.name + ".old")


def flatten(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dicts as one, keys joined by dots."""
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}{key}.") if isinstance(item, dict) else {f"{prefix}{key}": item}
    return flat
