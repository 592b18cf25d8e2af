"""A table of all sets that `data collect` makes: what their episodes return, and what collecting them costs.

Returns are those of a full collection with the default seed: every episode is played by physics alone, from the same
seed and with the same actions, so its rewards are the same to the digit. Cost is measured on a short collection with
rendering.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from vd4rl_pomdp.core.errors import refuse_number, refuse_unknown
from vd4rl_pomdp.core.tasks import MOST_EPISODES, SET_QUALITIES, TASKS
from vd4rl_pomdp.data.collect import CollectConfig, actor_hashes, collect, replay_returns
from vd4rl_pomdp.data.folder import PROVENANCE
from vd4rl_pomdp.policies.actor import ships
from vd4rl_pomdp.runs.files import Row, read_csv, read_json, write_csv, write_json
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.provenance import git_commit, machine, versions

EPISODES = 200
CORES = 2

RETURNS = ("task", "quality", "episode", "return")
COSTS = ("task", "episodes", "rows", "cpu_seconds", "commit")
_WORDS = ("task", "quality", "commit")
SETS = ("task", "quality", "episodes", "mean", "min", "max", "seconds_100k")


def tabulate(out: Path, tasks: Sequence[str], qualities: Sequence[str], timed_episodes: int, workers: int) -> list[Row]:
    """Play and time the sets that the table lacks, or has of other actors than those that ship now; write it again.

    Args:
        out: folder of `returns.csv` (one row an episode), `actors.json` (hashes of the actors behind each set),
            `costs.csv` (one row a task) and `sets.csv`, the table.
        tasks: tasks to add.
        qualities: qualities to add; one whose actor does not ship yet is left out.
        timed_episodes: episodes of the short collection that is timed, on one core.
        workers: processes that play.

    Returns:
        Rows of the table, in the order of `tasks` and `SET_QUALITIES`.

    Raises:
        UserError: an unknown task or quality, no episode to time, or a folder with a damaged file or another owner.
    """
    _check(tasks, qualities, timed_episodes)
    refuse_number("workers", workers, 0)
    refuse_foreign(out, "table of sets", "returns.csv", "sets.csv")
    with owned(out):
        returns = read_csv(out / "returns.csv", RETURNS, _WORDS)
        costs = read_csv(out / "costs.csv", COSTS, _WORDS)
        actors = read_json(out / "actors.json") if (out / "actors.json").exists() else {}
        for task, quality in product(tasks, qualities):
            if not ships(task, quality):
                continue
            config = CollectConfig(task, quality, Path(), EPISODES, workers=workers)  # type: ignore[arg-type]
            name, hashes = f"{task} {quality}", actor_hashes(config)
            known = any((row["task"], row["quality"]) == (task, quality) for row in returns)
            if actors.get(name) != hashes or not known:
                played = enumerate(replay_returns(config))
                returns = [row for row in returns if (row["task"], row["quality"]) != (task, quality)]
                returns += [{"task": task, "quality": quality, "episode": i, "return": repr(v)} for i, v in played]
                actors[name] = hashes
                write_csv(out / "returns.csv", RETURNS, returns)
                write_csv(out / "sets.csv", SETS, summarise(returns, costs))
                write_json(out / "actors.json", actors)
        for task in tasks:
            if not any(row["task"] == task for row in costs):
                costs.append(_cost(task, timed_episodes))
                write_csv(out / "costs.csv", COSTS, costs)
        table = summarise(returns, costs)
        write_csv(out / "sets.csv", SETS, table)
        write_json(out / "provenance.json", {"git_commit": git_commit(), "versions": versions(), "machine": machine()})
    return table


def _check(tasks: Sequence[str], qualities: Sequence[str], timed_episodes: int) -> None:
    """Raise UserError for an unknown task or quality, or for no episode to time."""
    for quality in qualities:
        refuse_unknown("quality", quality, SET_QUALITIES)
    refuse_number("timed_episodes", timed_episodes, 1, MOST_EPISODES)
    for task in tasks:
        TASKS.named(task)


def summarise(returns: list[Row], costs: list[Row]) -> list[Row]:
    """The table from the raw rows; no seconds for a task that was not timed yet."""
    seconds = {r["task"]: float(r["cpu_seconds"]) / float(r["rows"]) * 1e5 / CORES for r in costs}
    table = []
    for task in dict.fromkeys(row["task"] for row in returns):
        for quality in SET_QUALITIES:
            mine = [float(r["return"]) for r in returns if (r["task"], r["quality"]) == (task, quality)]
            if mine:
                statistics = {"mean": np.mean(mine), "min": min(mine), "max": max(mine)}
                row = {"task": task, "quality": quality, "episodes": len(mine)}
                row |= {name: f"{value:.1f}" for name, value in statistics.items()}
                table.append(row | {"seconds_100k": round(seconds[task]) if task in seconds else ""})
    return table


def _cost(task: str, episodes: int) -> Row:
    """Processor time of a short collection of random episodes, rendering and writing included, in this process."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.process_time()
        collect(CollectConfig(task, "random", Path(folder) / task, episodes, workers=1))
        spent = time.process_time() - started
        rows = read_json(Path(folder) / task / PROVENANCE)["frames"]
    return {"task": task, "episodes": episodes, "rows": rows, "cpu_seconds": f"{spent:.1f}", "commit": git_commit()}
