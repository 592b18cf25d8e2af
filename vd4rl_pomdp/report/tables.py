"""From raw evaluation rows to tables: everything a figure shows is in one of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.load import IDENTITY, Run
from vd4rl_pomdp.tasks import SCORE_DIVISOR

Row = dict[str, Any]
SETTING = ("corruption", "algorithm")
GROUP = ("task", "quality", "corruption", "algorithm", "method")
REFERENCES = ("random", "bc", "drq_bc", "state")
"""Methods that are references: last in a table."""
END_TO_END = ("bc", "drq_bc")
"""References that bring their own algorithm."""


def label(row: Row) -> str:
    """A method's name in tables and figures, with the algorithm where it is not TD3+BC."""
    own = row["algorithm"] == "td3_bc" or row["method"] in END_TO_END
    return row["method"] if own else f"{row['method']}, {row['algorithm']}"


def representations(runs: list[Run]) -> list[Row]:
    """One row for every evaluated run: what its encoder knows, what its policy reached, what both cost."""
    table = []
    for run in runs:
        if run.rows:
            final = max(row["step"] for row in run.rows)
            score = float(np.mean([row["score"] for row in run.rows if row["step"] == final]))
            identity = dict(zip(IDENTITY, run.identity, strict=True))
            costs = {"finetune_seconds": run.seconds, "git_commit": run.record.get("git_commit", "")}
            table.append(identity | run.representation | {"score": score, "return": score * SCORE_DIVISOR} | costs)
    return sorted(table, key=_table_order)


def improvement(rows: list[Row]) -> list[Row]:
    """Probability that a run of one method beats one of another on the same task, averaged over common tasks."""
    table = []
    for setting, members in _grouped(rows, ("corruption",)):
        final: dict[str, dict[tuple, np.ndarray]] = {}
        for (task, quality, *_), group in _grouped(members, (*GROUP,)):
            final.setdefault(label(group[0]), {})[task, quality] = _final_scores(group)
        for name, scores in final.items():
            for other, others in final.items():
                common = [task for task in scores if task in others]
                if name != other and common:
                    chances = [stats.probability_of_improvement(scores[t], others[t]) for t in common]
                    place = {"corruption": setting[0], "method": name, "other": other}
                    table.append(place | {"probability": float(np.mean(chances)), "tasks": len(common)})
    return table


def profiles(rows: list[Row], thresholds: np.ndarray) -> list[Row]:
    """Share of runs (all tasks and seeds of a method) whose final score is above each threshold."""
    table = []
    for (corruption, *_), members in _grouped(rows, (*SETTING, "method")):
        strata = _strata(members)
        share = stats.performance_profile(np.concatenate(strata), thresholds)
        place = {"corruption": corruption, "method": label(members[0])}
        table += [place | {"threshold": float(t), "share": float(v)} for t, v in zip(thresholds, share, strict=True)]
    return table


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
        strata = _strata(members)
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
    place = tuple(row.get(name, "") for name in ("task", "quality", "corruption"))
    return *place, row["method"] in REFERENCES, -float(row["score"] if "score" in row else row["iqm"])


def _grouped(rows: list[Row], names: Iterable[str]) -> list[tuple[tuple, list[Row]]]:
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return list(groups.items())


def _by_step(rows: list[Row]) -> dict[int, list[Row]]:
    return {step[0]: members for step, members in _grouped(rows, ("step",))}


def _strata(rows: list[Row]) -> list[np.ndarray]:
    """Final score of every seed, one array a task and quality."""
    return [_final_scores(members) for _, members in _grouped(rows, ("task", "quality"))]


def _final_scores(rows: list[Row]) -> np.ndarray:
    curve = _by_step(rows)
    return _per_seed(curve[max(curve)])


def _per_seed(rows: list[Row]) -> np.ndarray:
    """Mean score of each seed's episodes."""
    return np.array([np.mean([row["score"] for row in members]) for _, members in _grouped(rows, ("seed",))])
