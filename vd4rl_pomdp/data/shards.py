"""Write the shards of any collected data set: atomically, keeping existing shards, with the provenance file last."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import code_of, of_other_code
from vd4rl_pomdp.data.folder import PLAN, PROVENANCE, read_plan
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.runs.files import holds_anything, write_json
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.provenance import command, git_commit, versions
from vd4rl_pomdp.runs.workers import count_workers, run_jobs

EpisodeArrays = dict[str, np.ndarray]
"""An episode's rows, by key."""


@dataclass(frozen=True)
class Shard:
    """One shard to write."""

    path: Path
    jobs: list[Any]
    """One job per episode."""
    attributes: dict[str, Any]


def collect_set(
    out: Path,
    settings: dict[str, Any],
    shards: list[Shard],
    roll_out: Callable[[Any], EpisodeArrays],
    workers: int,
    title: tuple[str, str],
    task: str | None,
) -> None:
    """Write a data set's missing files: collection.json with its settings first, then shards, then provenance.json.

    Args:
        roll_out: plays a job and returns its rows by key.
        workers: number of processes; 0: one per core.
        title: title of the progress bar, and its unit, such as ("collect", "episodes").
        task: name of the task or maze, to record what rendered it; None: nothing is rendered.

    Raises:
        UserError: the folder holds something else, or its shards were rendered differently or made by other code.
    """
    with owned(out):
        missing = [shard for shard in shards if not shard.path.exists()]
        stored, whole = read_plan(out), (out / PROVENANCE).exists()
        if not stored and holds_anything(out):
            raise UserError(f"{out}: is not empty and holds no collected dataset; choose another --out")
        if stored and (others := differing(stored, settings)):
            raise UserError(f"{out}: holds a dataset that differs in {', '.join(others)}; choose another --out")
        if stored and not whole and (parts := of_other_code(stored, settings)):
            raise UserError(
                f"{out}: is unfinished, and the code of {parts[0]} has changed since; restore it, or choose another "
                "--out"
            )
        if whole and not missing:
            return
        rendered = _rendered_by(out, task, stored if len(missing) < len(shards) else {}) if task else {}
        code = {name: parts for name, parts in code_of(settings).items() if parts}
        write_json(out / PLAN, settings | code | {"rendered_by": rendered})
        started, frames = time.monotonic(), 0
        try:
            with ProgressLine(title[0], sum(len(shard.jobs) for shard in missing), title[1]) as progress:
                for shard in missing:
                    rollouts = []
                    for rollout in run_jobs(roll_out, shard.jobs, workers):
                        rollouts.append(rollout)
                        frames += len(rollout["reward"])
                        speed = frames / (time.monotonic() - started)
                        progress.advance(1, ret=float(rollout["reward"].sum()), frames_per_s=speed)
                    rows = {key: np.concatenate([rollout[key] for rollout in rollouts]) for key in rollouts[0]}
                    del rollouts, rollout  # else they stay in memory beside `rows`, and `rows` beside the next shard's
                    write_shard(shard.path, rows, shard.attributes)
                    del rows
        except UserError:
            if not whole and not any(shard.path.exists() for shard in shards):
                (out / PLAN).unlink(missing_ok=True)  # nothing was collected: any other command may start here
            raise
        spent = {"seconds": round(time.monotonic() - started, 1), "frames": frames} if missing else {}  # of this call
        origin = {"command": command(), "git_commit": git_commit(), "versions": versions(), "render": rendered}
        write_json(out / PROVENANCE, spent | {"workers": count_workers(workers)} | origin)


def _rendered_by(out: Path, task: str, stored: dict[str, Any]) -> dict[str, Any]:
    """This machine's renderer; UserError if existing shards were rendered with other pixels."""
    from vd4rl_pomdp.data.parity import render_info

    now, before = render_info(task), stored.get("rendered_by", {})
    if stored and before.get("canary") != now.get("canary"):
        first, here = (info.get("gl_renderer") or "another renderer" for info in (before, now))
        raise UserError(
            f"{out}: its shards were rendered by {first}, and {here} renders different pixels: resume on a machine "
            "like the first, or choose another --out"
        )
    return now


def differing(stored: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Names of the settings that differ from a collection.json's."""
    return sorted(name for name, value in settings.items() if stored.get(name) != value)
