"""Tabulate the datasets of `data collect`: their episodes' returns, and the cost of collecting them.

    python tools/dataset_table.py --qualities random medium_replay medium medium_expert expert expert_noisy

Returns are those of a full collection with the default seed. Episodes are played without rendering, with the same seeds
and actions, so rewards are identical. Cost is measured on one core, on a short collection with rendering. Datasets that
the table has with the same actors are not played again.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import pandas as pd
from script import run_script

from vd4rl_pomdp.core.errors import refuse_outside, refuse_unknown
from vd4rl_pomdp.core.tasks import MOST_EPISODES, SET_QUALITIES, TASKS
from vd4rl_pomdp.data.collect import CollectConfig, actor_hashes, collect, play
from vd4rl_pomdp.data.folder import PROVENANCE
from vd4rl_pomdp.policies.actor import ships
from vd4rl_pomdp.runs.files import Row, read_json, write_csv, write_json
from vd4rl_pomdp.runs.provenance import git_commit, machine, versions

CORES = 2
RETURNS = ("task", "quality", "episode", "return")
COSTS = ("task", "episodes", "rows", "cpu_seconds", "commit")


@dataclass(frozen=True)
class Config:
    """Settings of the table."""

    out: Path = Path("results/datasets")
    """Folder of returns.csv (one row per episode), costs.csv (one per task), actors.json and the table, sets.csv."""
    tasks: tuple[str, ...] = tuple(TASKS)
    qualities: tuple[str, ...] = tuple(SET_QUALITIES)
    """Qualities; one whose actor is not shipped is left out."""
    episodes: int = 200
    """Episodes per dataset."""
    timed_episodes: int = 4
    """Episodes of the timed collection per task."""
    workers: int = 0
    """Worker processes; 0 uses every core."""


def main(config: Config) -> None:
    """Measure what is missing, and write the table."""
    refuse_outside(config, episodes=(1, MOST_EPISODES), timed_episodes=(1, MOST_EPISODES), workers=0)
    for task, quality in product(config.tasks, config.qualities):
        TASKS.named(task)
        refuse_unknown("quality", quality, SET_QUALITIES)
    out = config.out
    returns, costs = rows_of(out / "returns.csv"), rows_of(out / "costs.csv")
    actors = read_json(out / "actors.json") if (out / "actors.json").exists() else {}
    for task, quality in product(config.tasks, config.qualities):
        if not ships(task, quality):
            continue
        full = CollectConfig(task, quality, Path(), config.episodes, workers=config.workers)  # type: ignore[arg-type]
        name, hashes = f"{task} {quality}", actor_hashes(full)
        others = [row for row in returns if (row["task"], row["quality"]) != (task, quality)]
        if actors.get(name) != hashes or len(returns) - len(others) != config.episodes:
            played = [float(rollout["reward"].sum()) for rollout in play(full)]
            mine = [{"task": task, "quality": quality, "episode": i, "return": repr(v)} for i, v in enumerate(played)]
            returns, actors[name] = others + mine, hashes
            write_csv(out / "returns.csv", RETURNS, returns)
            write_json(out / "actors.json", actors)
    for task in config.tasks:
        if not any(row["task"] == task for row in costs):
            costs.append(cost(task, config.timed_episodes))
            write_csv(out / "costs.csv", COSTS, costs)
    summarise(returns, costs).to_csv(out / "sets.csv", index=False, float_format="%.1f", lineterminator="\n")
    write_json(out / "provenance.json", {"git_commit": git_commit(), "versions": versions(), "machine": machine()})


def rows_of(path: Path) -> list[Row]:
    """Rows of an existing table, as text; empty if there is none."""
    return pd.read_csv(path, dtype=str).to_dict("records") if path.exists() else []


def summarise(returns: list[Row], costs: list[Row]) -> pd.DataFrame:
    """The table, from raw rows: tasks in the order of the rows, qualities in that of SET_QUALITIES."""
    frame = pd.DataFrame(returns).astype({"return": float})
    for column, order in (("task", frame["task"].unique()), ("quality", list(SET_QUALITIES))):
        frame[column] = pd.Categorical(frame[column], order)
    by_set = frame.groupby(["task", "quality"], observed=True)["return"]
    table = by_set.agg(episodes="count", mean="mean", min="min", max="max").reset_index()
    per_row = {row["task"]: float(row["cpu_seconds"]) / float(row["rows"]) for row in costs}
    return table.assign(seconds_100k=[round(per_row[task] * 1e5 / CORES) for task in table["task"]])


def cost(task: str, episodes: int) -> Row:
    """CPU time of a short collection of random episodes in this process, including rendering and writing."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.process_time()
        collect(CollectConfig(task, "random", Path(folder) / task, episodes, workers=1))
        spent = time.process_time() - started
        rows = read_json(Path(folder) / task / PROVENANCE)["frames"]
    return {"task": task, "episodes": episodes, "rows": rows, "cpu_seconds": f"{spent:.1f}", "commit": git_commit()}


if __name__ == "__main__":
    run_script(main, Config)
