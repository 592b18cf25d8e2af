"""From raw evaluation rows to tables: everything a figure shows is in one of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from vd4rl_pomdp.report import stats

Row = dict[str, Any]
SETTING = ("corruption", "algorithm")
GROUP = ("task", "quality", "corruption", "algorithm", "method")
REFERENCES = ("random", "bc", "drq_bc", "state")
"""Methods that are references: last in a table."""


def summary(rows: list[Row]) -> list[Row]:
    """Final score of every group: mean over seeds, 95% interval, n seeds, n episodes, best evaluation's mean."""
    table = []
    for group, members in _grouped(rows, GROUP):
        curve = _by_step(members)
        final = max(curve)
        scores = _per_seed(curve[final])
        interval = stats.bootstrap_interval([scores], stats.mean, np.random.default_rng(0))
        best = max(curve, key=lambda step: _per_seed(curve[step]).mean())
        table.append(
            dict(zip(GROUP, group, strict=True))
            | {"step": final, "score": float(scores.mean())}
            | {"low": interval[0] if interval else None, "high": interval[1] if interval else None}
            | {"seeds": len(scores), "episodes": len(curve[final]), "few_seeds": len(scores) < stats.FEW_SEEDS}
            | {"best_score": float(_per_seed(curve[best]).mean()), "best_step": best}
        )
    return sorted(table, key=_table_order)


def curves(rows: list[Row]) -> list[Row]:
    """Mean over seeds, and their range, at every evaluation."""
    table = []
    for group, members in _grouped(rows, GROUP):
        for step, at_step in sorted(_by_step(members).items()):
            scores = _per_seed(at_step)
            table.append(
                dict(zip(GROUP, group, strict=True))
                | {"step": step, "score": float(scores.mean())}
                | {"low": float(scores.min()), "high": float(scores.max()), "seeds": len(scores)}
            )
    return table


def aggregate(rows: list[Row]) -> list[Row]:
    """IQM and optimality gap over tasks and qualities for every method and setting, with stratified intervals."""
    table = []
    for group, members in _grouped(rows, (*SETTING, "method")):
        strata = []
        for _, task_rows in _grouped(members, ("task", "quality")):
            curve = _by_step(task_rows)
            strata.append(_per_seed(curve[max(curve)]))
        scores = np.concatenate(strata)
        interval = stats.bootstrap_interval(strata, stats.iqm, np.random.default_rng(0))
        table.append(
            dict(zip((*SETTING, "method"), group, strict=True))
            | {"iqm": float(stats.iqm(scores)), "optimality_gap": float(stats.optimality_gap(scores))}
            | {"low": interval[0] if interval else None, "high": interval[1] if interval else None}
            | {"tasks": len(strata), "seeds": min(map(len, strata))}
        )
    return sorted(table, key=_table_order)


def _table_order(row: Row) -> tuple:
    place = tuple(row.get(name, "") for name in ("task", "quality", *SETTING))
    return *place, row["method"] in REFERENCES, -float(row["score"] if "score" in row else row["iqm"])


def _grouped(rows: list[Row], names: Iterable[str]) -> list[tuple[tuple, list[Row]]]:
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return list(groups.items())


def _by_step(rows: list[Row]) -> dict[int, list[Row]]:
    return {step[0]: members for step, members in _grouped(rows, ("step",))}


def _per_seed(rows: list[Row]) -> np.ndarray:
    """Mean score of each seed's episodes."""
    return np.array([np.mean([row["score"] for row in members]) for _, members in _grouped(rows, ("seed",))])
