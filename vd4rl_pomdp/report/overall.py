"""Tables over all tasks of a corruption: aggregates, performance profiles, and which method beats which."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.figures import span
from vd4rl_pomdp.report.load import CONDITION
from vd4rl_pomdp.report.tables import final_scores, grouped, label, table_order
from vd4rl_pomdp.runs.files import Row

SERIES = CONDITION[2:]
THRESHOLDS = 101
"""Number of scores at which a performance profile is computed."""
MANY = 2_000
"""Bootstrap samples of each of the many intervals of a profile or a matrix."""
AGGREGATES = ("iqm", "median", "mean", "optimality_gap")
_NUMBERS = tuple(f"{name}{end}" for name in AGGREGATES for end in ("", "_low", "_high"))


def aggregate(rows: list[Row], gaps: list[Row]) -> list[Row]:
    """AGGREGATES over the tasks and qualities of every method and corruption, with stratified 95% intervals.

    `of_tasks` is the number of tasks and qualities under the corruption: a row with fewer `tasks` cannot be compared
    with the others, and stands below them. `seeds` is the least number that a task has. A method that has not been run
    has no numbers.

    Args:
        rows: evaluations of finished runs.
        gaps: of `find_gaps`.
    """
    everything = grouped([*rows, *gaps], ("corruption",))
    of_tasks = {key[0]: len(grouped(members, ("task", "quality"))) for key, members in everything}
    table, absent = [], dict.fromkeys(tuple(gap[name] for name in SERIES) for gap in gaps)
    for group, members in grouped(rows, SERIES):
        absent.pop(group, None)
        strata = _strata(members)
        counts = {"tasks": len(strata), "of_tasks": of_tasks[group[0]], "seeds": min(map(len, strata))}
        table.append(dict(zip(SERIES, group, strict=True)) | _aggregates(strata) | counts)
    nothing = dict.fromkeys(_NUMBERS)
    table += [
        dict(zip(SERIES, group, strict=True)) | nothing | {"tasks": 0, "of_tasks": of_tasks[group[0]], "seeds": 0}
        for group in absent
    ]
    return sorted(table, key=_whole_first)


def _whole_first(row: Row) -> tuple:
    """`table_order`, but what lacks tasks below what has them all."""
    *place, score = table_order(row)
    return *place, row["tasks"] < row["of_tasks"], score


def _aggregates(strata: stats.Strata) -> Row:
    """Values of _NUMBERS."""
    scores, chosen = np.concatenate(strata), stats.aggregates(strata)
    intervals = stats.bootstrap_intervals(strata, chosen, np.random.default_rng(0))
    found: Row = {}
    for name, statistic in chosen.items():
        low, high = intervals[name] or (None, None)
        found |= {name: float(statistic(scores)), f"{name}_low": low, f"{name}_high": high}
    return found


def improvement(rows: list[Row]) -> list[Row]:
    """Probability that a run of one method beats one of another on the same task, averaged over common tasks.

    A probability has a stratified 95% interval; where a method has a single seed on some task it is None, as one pair
    of runs tells no probability. `wins` of `pairs` of runs are known in any case; ties count half.
    """
    table = []
    for (corruption, *_), members in grouped(rows, ("corruption",)):
        final: dict[str, dict[tuple, np.ndarray]] = {}
        for (task, quality, *_), group in grouped(members, CONDITION):
            final.setdefault(label(group[0]), {})[task, quality] = final_scores(group)
        for name, other in combinations(final, 2):
            common = [task for task in final[name] if task in final[other]]
            if common:
                row = _improvement([final[name][t] for t in common], [final[other][t] for t in common])
                table.append({"corruption": corruption, "method": name, "other": other} | row)
                table.append({"corruption": corruption, "method": other, "other": name} | _turned(row))
    return table


def _improvement(strata: stats.Strata, others: stats.Strata) -> Row:
    interval = stats.improvement_interval(strata, others, np.random.default_rng(0), MANY)
    pairs = [len(one) * len(other) for one, other in zip(strata, others, strict=True)]
    chances = [stats.probability_of_improvement([a], [b]) for a, b in zip(strata, others, strict=True)]
    low, high = interval or (None, None)
    return {
        **{"probability": float(np.mean(chances)) if interval else None, "low": low, "high": high},
        **{"wins": float(np.dot(chances, pairs)), "pairs": sum(pairs), "tasks": len(pairs)},
        "seeds": min(map(len, (*strata, *others))),
    }


def _turned(row: Row) -> Row:
    """The same from the other method's side."""
    chance, low, high = (None if row[name] is None else 1 - row[name] for name in ("probability", "high", "low"))
    return row | {"probability": chance, "low": low, "high": high, "wins": row["pairs"] - row["wins"]}


def profiles(rows: list[Row]) -> list[Row]:
    """Share of runs (all tasks and seeds of a method) whose final score is above each threshold, with 95% bands."""
    table = []
    thresholds = _thresholds([score for _, members in grouped(rows, CONDITION) for score in final_scores(members)])
    for (corruption, *_), members in grouped(rows, SERIES):
        strata = _strata(members)
        share = stats.performance_profile(np.concatenate(strata), thresholds)
        band = stats.profile_band(strata, thresholds, np.random.default_rng(0), MANY)
        names = {"corruption": corruption, "method": label(members[0]), "runs": sum(map(len, strata))}
        low, high = (part.tolist() for part in band) if band else ([None] * len(share),) * 2
        table += [
            names | {"threshold": float(t), "share": float(v), "low": a, "high": b}
            for t, v, a, b in zip(thresholds, share, low, high, strict=True)
        ]
    return table


def _thresholds(scores: list[float]) -> np.ndarray:
    """From 0, or the lowest score below it, to 100, or to 0 where no score is above it."""
    low, high = span(scores)
    return np.linspace(low, 100 if high > 0 else 0, THRESHOLDS)


def _strata(rows: list[Row]) -> stats.Strata:
    """Final score of every seed, one array a task and quality."""
    return [final_scores(members) for _, members in grouped(rows, ("task", "quality"))]
