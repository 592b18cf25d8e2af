"""Tables about what is not a score: each run's encoder and provenance, what policies do, and what runs cost."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vd4rl_pomdp.data.reference import summarise
from vd4rl_pomdp.report.gaps import in_words
from vd4rl_pomdp.report.gates import returns_of
from vd4rl_pomdp.report.load import CONDITION, IDENTITY, PROBES, LoadedRun
from vd4rl_pomdp.report.tables import by_label, grouped, table_order
from vd4rl_pomdp.runs.files import Row

COSTS = ("pretrain_seconds", "finetune_seconds")
ACTION_ERRORS = ("path_error", "action_error")
"""Of a policy, on the data's rows and in closed loop."""
_RUN = (
    *("id", *IDENTITY, "action_loss", *PROBES, *ACTION_ERRORS, "score", "return", "best_score", "best_step"),
    *(*COSTS, "git_commit", "machine", "state"),
)
_EVALUATED = {"return": "return_mean", "share_above_80": "share_above_80", "action_error": "action_error"}
"""Columns of `control` that tell of an evaluation, and what `summarise` calls them."""
_CONTROL = ("data_return", *_EVALUATED, *(f"clean_{name}" for name in _EVALUATED), "path_error")
_MEANS = ("action_loss", *PROBES, "return", *COSTS)


def run_table(runs: list[LoadedRun], evaluated: list[Row], gaps: list[Row]) -> list[Row]:
    """One row for every finished and evaluated run: its encoder's measures, its scores, costs and provenance.

    Rows of missing, unfinished and diverged runs have a state but no numbers.

    Args:
        runs: all of the report.
        evaluated: their evaluations.
        gaps: of `find_gaps`.
    """
    curves = dict(grouped(evaluated, IDENTITY))
    table = []
    for run in runs:
        if run.evaluated:
            curve = curves[tuple(run.named[name] for name in IDENTITY)]
            table.append(_run(run, curve))
    return sorted([*table, *(dict.fromkeys(_RUN) | gap for gap in gaps)], key=table_order)


def _run(run: LoadedRun, curve: list[Row]) -> Row:
    """Values of _RUN of one run."""
    last, best = max(curve, key=lambda row: row["step"]), max(curve, key=lambda row: row["score"])
    found = run.named | run.representation | _control(run) | {"id": run.result.id, "state": run.progress}
    found |= {"score": last["score"], "return": float(returns_of([run])[0])}
    found |= {"best_score": best["score"], "best_step": best["step"], "finetune_seconds": run.seconds}
    found |= {"git_commit": run.result.commit, "machine": run.result.machine}
    return {name: found[name] for name in _RUN}


def representations(table: list[Row]) -> list[Row]:
    """Means over the finished seeds of every condition in a table of runs: encoder, return, costs; and the gaps.

    What a seed does not know is None.
    """
    found = []
    for group, members in grouped(table, CONDITION):
        finished = [row for row in members if row["score"] is not None]
        means = {name: mean_if_known(row[name] for row in finished) for name in _MEANS}
        states = in_words([row for row in members if row["score"] is None])
        found.append(dict(zip(CONDITION, group, strict=True)) | means | {"seeds": len(finished), "missing": states})
    return sorted(found, key=table_order)


def costs(table: list[Row]) -> list[Row]:
    """Mean, least and most seconds of both stages by method, over all finished runs of a table, and their machines."""
    found = []
    finished = [row for row in table if row["score"] is not None]
    for name, members in by_label(finished):
        row: Row = {"method": name, "runs": len(members)}
        for cost in COSTS:
            known = [member[cost] for member in members if member[cost] is not None]
            row |= {cost: mean_if_known(known), f"{cost}_min": min(known, default=None)}
            row[f"{cost}_max"] = max(known, default=None)
        found.append(row | {"machines": "; ".join(sorted({member["machine"] for member in members} - {""}))})
    return found


def control(runs: list[LoadedRun]) -> list[Row]:
    """What the policies of every condition do, beside the data they learned from: means over the finished seeds.

    Return, share of episodes above 80% of the data's return, and action error in closed loop are those of the last
    evaluation: as trained, and under no corruption (`clean_`). What a seed does not know is None.
    """
    finished = [run for run in runs if run.evaluated]
    measured = [run.named | _control(run) for run in finished]
    table = [
        dict(zip(CONDITION, group, strict=True))
        | {name: mean_if_known(row[name] for row in members) for name in _CONTROL}
        | {"seeds": len(members)}
        for group, members in grouped(measured, CONDITION)
    ]
    return sorted(table, key=table_order)


def _control(run: LoadedRun) -> Row:
    """Values of _CONTROL of one run."""
    found: Row = {"data_return": run.reference.data_return, "path_error": run.reference.path_error}
    for prefix, rows in (("", run.last), ("clean_", run.last_clean)):
        summed = summarise(rows, run.reference) if rows else {}
        found |= {prefix + name: summed.get(key) for name, key in _EVALUATED.items()}
    return found


def mean_if_known(values: Iterable[float | None]) -> float | None:
    """Mean of values, None if there is none or one is not known: it is told beside their number."""
    told = list(values)
    known = [value for value in told if value is not None]
    return float(np.mean(known)) if known and len(known) == len(told) else None
