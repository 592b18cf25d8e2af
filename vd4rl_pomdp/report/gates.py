"""Whether a setting can tell methods apart at all: what has to hold before its methods are ranked.

The data must suffice for the algorithm where the state is known (`state`) and where nothing is hidden (`acro` under
`none`), and under the corruption some method must be better than no training (`random`). Where one of these fails,
differences between returns say more of the data and the algorithm than of the representations.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from vd4rl_pomdp.report.load import LoadedRun
from vd4rl_pomdp.report.tables import END_TO_END, REFERENCES
from vd4rl_pomdp.runs.files import Row

STATE_SHARE, ACRO_SHARE = 0.9, 0.7
"""Least shares of the data's mean return, of `state` and of `acro` under `none`."""
STANDARD_ERRORS = 2.0
"""Least difference between the best method and `random`, in its standard errors over seeds."""
PASSED, FAILED, UNKNOWN = "discriminates", "does not discriminate", "not known to discriminate"
SETTING = ("task", "quality", "corruption", "algorithm")


def gates(runs: list[LoadedRun]) -> list[Row]:
    """One row for every task, quality, corruption and algorithm with frozen encoders' finished runs, and its `verdict`.

    `state_share` and `acro_share` are shares of the data's mean return, `above_random` is the best method's mean return
    less that of `random`, `error` its standard error over seeds. What was not measured is None.
    """
    finished = [run for run in runs if run.rows and run.finished and run.labels["method"] not in END_TO_END]
    return [_gate(key, finished) for key in sorted({_key(run) for run in finished})]


def unranked(table: list[Row]) -> set[tuple[str, ...]]:
    """Task, quality and corruption of the settings that do not discriminate."""
    return {tuple(row[name] for name in SETTING[:3]) for row in table if row["verdict"].startswith(FAILED)}


def _key(run: LoadedRun) -> tuple[str, ...]:
    return tuple(str(run.labels[name]) for name in SETTING)


def _gate(key: tuple[str, ...], runs: list[LoadedRun]) -> Row:
    task, quality, corruption, algorithm = key
    alike = [run for run in runs if _key(run)[:2] == (task, quality) and _key(run)[3] == algorithm]
    here = [run for run in alike if run.labels["corruption"] == corruption]
    clean = [run for run in alike if run.labels["corruption"] == "none"]
    data = next((value for run in here if (value := run.reference.data_return)), None)
    state, acro = (best_of(_named(runs, name)) for runs, name in ((alike, "state"), (clean, "acro")))
    learned = best_of((run for run in here if run.labels["method"] not in REFERENCES), seeds=2)
    above, error = difference(learned, best_of(_named(here, "random")))
    row = dict(zip(SETTING, key, strict=True)) | {
        "data_return": data,
        "state_share": _share(state, data),
        "acro_share": _share(acro, data),
        "above_random": above,
        "error": error,
    }
    return row | {"verdict": _verdict(row)}


def _named(runs: Iterable[LoadedRun], method: str) -> Iterable[LoadedRun]:
    return (run for run in runs if run.labels["method"] == method)


def best_of(runs: Iterable[LoadedRun], seeds: int = 1) -> list[LoadedRun]:
    """The seeds of the method and variant whose mean return is highest, none if there is no run.

    One with fewer seeds than asked for is taken only where none has as many.
    """
    groups: dict[tuple[str, str], list[LoadedRun]] = {}
    for run in runs:
        groups.setdefault((str(run.labels["method"]), run.variant), []).append(run)
    enough = [members for members in groups.values() if len(members) >= seeds]
    return max(enough or groups.values(), key=lambda members: returns_of(members).mean(), default=[])


def returns_of(runs: list[LoadedRun]) -> np.ndarray:
    """Mean return of each run's last evaluation, (n,)."""
    finals = [(run.rows, max(row["step"] for row in run.rows)) for run in runs]
    return np.array([np.mean([row["return"] for row in rows if row["step"] == final]) for rows, final in finals])


def difference(runs: list[LoadedRun], others: list[LoadedRun]) -> tuple[float | None, float | None]:
    """Mean return of some seeds less that of others, and its standard error over seeds.

    None where a side has no run; no error where one has a single seed.
    """
    best, floor = returns_of(runs), returns_of(others)
    above = float(best.mean() - floor.mean()) if len(best) and len(floor) else None
    if min(len(best), len(floor)) < 2:
        return above, None
    return above, math.sqrt(best.var(ddof=1) / len(best) + floor.var(ddof=1) / len(floor))


def _share(runs: list[LoadedRun], data: float | None) -> float | None:
    return float(returns_of(runs).mean() / data) if runs and data else None


def _verdict(row: Row) -> str:
    """A word, and why."""
    missed, unknown = [], []
    for name, least, words in (("state_share", STATE_SHARE, "state"), ("acro_share", ACRO_SHARE, "acro under none")):
        if row[name] is None:
            unknown.append(f"{words} was not measured")
        elif row[name] < least:
            missed.append(f"{words} returns {row[name]:.2f} of the data's return, less than {least}")
    if row["error"] is None:
        unknown.append("best and random need two seeds each")
    elif row["above_random"] <= STANDARD_ERRORS * row["error"]:
        missed.append(f"best minus random is {row['above_random']:.0f}, within {STANDARD_ERRORS:g} standard errors")
    if missed:
        return f"{FAILED}: {'; '.join(missed)}"
    return f"{UNKNOWN}: {'; '.join(unknown)}" if unknown else PASSED
