"""The tables of results/control/README.md, made from its rows."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from vd4rl_pomdp.report.gaps import condition_of
from vd4rl_pomdp.report.gates import episodes_of
from vd4rl_pomdp.report.layout import number, with_interval
from vd4rl_pomdp.report.load import PROBES, LoadedRun, load_runs
from vd4rl_pomdp.report.measures import control, representations, run_table
from vd4rl_pomdp.report.stats import mean_interval
from vd4rl_pomdp.report.tables import TOLD_STATES, evaluations, label

RESULTS = Path(__file__).parents[1] / "results" / "control"
HEAD = (
    "| set | hidden | method | seeds | return (seeds) | played with nothing hidden |"
    " action error: data, loop | probe: pose, velocity |",
    "|---|---|---|---:|---|---:|---:|---:|",
)


def table_lines(folder: Path) -> Iterator[str]:
    """Lines of the table, a row for every method of a set and a corruption, in the order of the report."""
    runs = load_runs([folder])
    of_runs = run_table(runs, evaluations(runs), [])
    encoders = {condition_of(row): row for row in representations(of_runs)}
    seeds = defaultdict(list)
    for run in sorted((run for run in runs if run.evaluated), key=lambda run: run.labels["seed"]):
        seeds[condition_of(run.named)].append(run)
    yield from HEAD
    for policy in control(runs):
        key = condition_of(policy)
        mine = seeds[key]
        clean = told(episodes_of(mine, clean=True)) if all(run.last_clean for run in mine) else number(None)
        errors = f"{number(policy['path_error'], 3)}, {number(policy['action_error'], 3)}"
        probes = probes_of(policy["method"], [encoders[key][name] for name in PROBES])
        place = f"{policy['task']} {policy['quality']} | {policy['corruption']} | {label(policy)}"
        yield f"| {place} | {len(mine)} | {with_seeds(mine)} | {clean} | {errors} | {probes} |"


def cost_lines(file: Path) -> Iterator[str]:
    """What `cell_cost` measured, a row for every change."""
    yield "| fine-tuning | processor, seconds | wall clock, seconds | return |"
    yield "|---|---:|---:|---:|"
    with file.open(newline="", encoding="utf-8") as rows:
        for row in csv.DictReader(rows):
            seconds = f"{float(row['processor_seconds']):.0f} | {float(row['seconds']):.0f}"
            name = "as it is" if row["change"] == "none" else row["change"]
            yield f"| {name} | {seconds} | {float(row['return']):.2f} |"


def probes_of(method: str, errors: Sequence[float | None]) -> str:
    """Errors of the probes, marked where the encoder was trained on the states of held-out episodes, too."""
    return ", ".join(number(error, 1) for error in errors) + ("†" if method in TOLD_STATES else "")


def spread_of(runs: Iterable[LoadedRun]) -> str:
    """Lowest and highest return of single evaluation episodes."""
    episodes = [row["return"] for run in runs for row in run.last]
    return f"{min(episodes):.0f} to {max(episodes):.0f}"


def told(returns: np.ndarray) -> str:
    """Mean of (seeds, episodes) returns and its 95% interval."""
    return with_interval(returns.mean(), *(mean_interval(returns) or (None, None)), 0)


def with_seeds(runs: Sequence[LoadedRun]) -> str:
    """Mean and interval of runs' returns, and each seed's where there are several."""
    returns = episodes_of(list(runs))
    each = f" ({', '.join(f'{value:.0f}' for value in returns.mean(1))})" if len(returns) > 1 else ""
    return told(returns) + each
