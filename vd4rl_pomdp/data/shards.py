"""Write a set's shards, whatever they hold: each one whole, what is there already left alone, the record last."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import code_of, of_other_code
from vd4rl_pomdp.data.format import PLAN, PROVENANCE, write_shard
from vd4rl_pomdp.runs.files import holds_anything, read_json, write_json
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.provenance import command, git_commit, versions
from vd4rl_pomdp.runs.workers import count_workers, run_jobs

_RENDER = ".render.json"
Columns = dict[str, np.ndarray]
"""An episode's rows, by key."""


@dataclass(frozen=True)
class Shard:
    """One shard to write."""

    path: Path
    jobs: list[Any]
    """Its episodes."""
    attributes: dict[str, Any]


def collect_shards(
    out: Path, shards: list[Shard], roll_out: Callable[[Any], Columns], workers: int, title: tuple[str, str], task: str
) -> None:
    """Write the shards that are missing, then the set's record.

    Args:
        out: folder of the set, which this process owns.
        shards: all shards of the set.
        roll_out: plays a job; its rows by key.
        workers: processes, 0 for every core.
        title: what is going on, and the unit of a job.
        task: name of the task or maze, for what rendered it.
    """
    record = _Record(out, task)
    record.begin([shard.path.exists() for shard in shards])
    with ProgressLine(title[0], sum(len(shard.jobs) for shard in shards), title[1]) as progress:
        for shard in shards:
            if shard.path.exists():
                progress.advance(len(shard.jobs))
                continue
            started, frames, rollouts = time.monotonic(), 0, []
            for rollout in run_jobs(roll_out, shard.jobs, workers):
                rollouts.append(rollout)
                frames += len(rollout["reward"])
                speed = frames / (time.monotonic() - started)
                progress.advance(1, ret=float(rollout["reward"].sum()), frames_per_s=speed)
            record.note(shard.path, time.monotonic() - started, frames)
            write_shard(shard.path, join_rollouts(rollouts), shard.attributes)
    record.write(workers)


def claim_set(out: Path, settings: dict[str, Any], made: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Write collection.json, or check that the folder holds the same collection, begun with the same code of its task.

    A set that is whole stays one, whatever its task's code has become.

    Args:
        out: folder of the set.
        settings: what tells it from others.
        made: how this version makes it; a set that another began, and that is not whole, is refused.
    """
    path = out / PLAN
    if path.exists():
        stored = read_json(path)
        if others := differing(stored, settings):
            raise UserError(f"{out}: holds a set collected with another {', '.join(others)}; choose another --out")
        if not (out / PROVENANCE).exists() and (others := differing(stored, made)):
            raise UserError(
                f"{out}: was begun by an earlier version with another {others[0]}, and is not whole; choose another "
                "--out"
            )
        if not (out / PROVENANCE).exists() and (parts := of_other_code(stored, settings)):
            raise UserError(
                f"{out}: was begun before the code of {parts[0]} changed, and is not whole; put that back, or choose "
                "another --out"
            )
        return
    if holds_anything(out):
        raise UserError(f"{out}: is not empty and holds no collected set; choose another --out")
    write_json(path, settings | dict(made) | {name: told for name, told in code_of(settings).items() if told})


def differing(stored: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Names of the settings that a collection.json has otherwise."""
    return sorted(name for name, value in settings.items() if stored.get(name) != value)


def join_rollouts(rollouts: list[Columns]) -> Columns:
    """Rows of several episodes, in order."""
    return {key: np.concatenate([rollout[key] for rollout in rollouts]) for key in rollouts[0]}


class _Record:
    """What a repeated collection would not reproduce: seconds and frames, over all its parts, and where it ran."""

    def __init__(self, out: Path, task: str) -> None:
        self._path, self._parts_path, self._render_path = (out / name for name in (PROVENANCE, ".parts.json", _RENDER))
        self._task = task
        self._told = read_json(self._path).get("parts", {}) if self._path.exists() else {}
        added = read_json(self._parts_path) if self._parts_path.exists() else {}
        self._parts: dict[str, list[float]] = self._told | added

    def begin(self, there: list[bool]) -> None:
        """Keep who draws the shards that are not there; raises UserError where those that are show other pixels."""
        if all(there) and self._path.exists():
            return
        from vd4rl_pomdp.data.parity import render_info

        now = render_info(self._task)
        if any(there) and (drawn := self._drawn()) and drawn.get("canary") != now.get("canary"):
            before, here = (told.get("gl_renderer") or "another renderer" for told in (drawn, now))
            raise UserError(
                f"{self._path.parent}: its shards so far were drawn by {before}, and {here} draws other pixels: go on "
                "on a machine like the first, or choose another --out"
            )
        write_json(self._render_path, now)

    def _drawn(self) -> dict[str, Any]:
        """Who drew the shards that are there; empty if nobody is known to have."""
        if self._render_path.exists():
            return read_json(self._render_path)
        return read_json(self._path).get("render", {}) if self._path.exists() else {}

    def note(self, shard: Path, seconds: float, frames: int) -> None:
        """Remember a shard's part, just before it is written, until the set is whole."""
        self._parts[shard.name] = [round(seconds, 1), frames]
        write_json(self._parts_path, self._parts)

    def write(self, workers: int) -> None:
        """Write the set's record, unless it has one and nothing was added."""
        if self._path.exists() and self._parts == self._told:
            return
        seconds, frames = (sum(part[i] for part in self._parts.values()) for i in (0, 1))
        facts: dict[str, Any] = {"seconds": round(seconds, 1), "frames": int(frames)}
        facts |= {"workers": count_workers(workers), "parts": self._parts}
        origin = {"command": command(), "git_commit": git_commit(), "versions": versions()}
        write_json(self._path, facts | origin | {"render": read_json(self._render_path)})
        for path in (self._parts_path, self._render_path):
            path.unlink(missing_ok=True)
