"""Whether a setting can tell methods apart at all: what has to hold before its methods are ranked.

The data must suffice for the algorithm where the state is known (`state`) and where nothing is hidden (`acro` under
`none`), and under the corruption some method must be better than no training (`random`). Where one of these fails,
differences between returns say more of the data and the algorithm than of the representations. The three are these
methods as they are, none of their variants.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from vd4rl_pomdp.report.gaps import STATE
from vd4rl_pomdp.report.load import LoadedRun
from vd4rl_pomdp.report.tables import END_TO_END, REFERENCES, grouped
from vd4rl_pomdp.report.variants import is_plain
from vd4rl_pomdp.runs.files import Row

STATE_SHARE, ACRO_SHARE = 0.9, 0.7
"""Least shares of the data's mean return, of `state` and of `acro` under `none`."""
STANDARD_ERRORS = 2.0
"""Least difference between the best method and `random`, in its standard errors over seeds."""
PASSED, FAILED, UNKNOWN = "discriminates", "does not discriminate", "not known to discriminate"
SETTING = ("task", "quality", "corruption", "algorithm")


def gates(runs: list[LoadedRun]) -> list[Row]:
    """One row for every task, quality, corruption and algorithm with frozen encoders' finished runs, and its `verdict`.

    `data_return` is a mean over the sets behind its runs, `state_share` and `acro_share` are shares of the return of
    their own, `above_random` is the best method's mean return less that of `random`, `error` its standard error over
    seeds. What is not known is None.
    """
    finished = [run for run in runs if run.rows and run.finished and run.labels["method"] not in END_TO_END]
    return [_gate(key, finished) for key in sorted({_key(run) for run in finished})]


def unranked(table: list[Row], names: Sequence[str] = SETTING) -> set[tuple[str, ...]]:
    """The settings that do not discriminate: values of some columns, where all rows that have them miss a gate."""
    places = grouped(table, names)
    return {place for place, rows in places if all(row["verdict"].startswith(FAILED) for row in rows)}


def _key(run: LoadedRun) -> tuple[str, ...]:
    return tuple(str(run.labels[name]) for name in SETTING)


def _gate(key: tuple[str, ...], runs: list[LoadedRun]) -> Row:
    task, quality, corruption, algorithm = key
    alike = [run for run in runs if _key(run)[:2] == (task, quality) and _key(run)[3] == algorithm]
    here, clean = (seen_under(under, alike) for under in (corruption, "none"))
    state, acro = as_it_is("state", here), as_it_is("acro", clean)
    learned = best_of(run for run in here if run.labels["method"] not in REFERENCES)
    above, error = difference(learned, as_it_is("random", here))
    data = {value for run in here if (value := run.reference.data_return) is not None}
    row = dict(zip(SETTING, key, strict=True)) | {
        "data_return": float(np.mean(sorted(data))) if data else None,
        "state_share": _share(state),
        "acro_share": _share(acro),
        "above_random": above,
        "error": error,
    }
    return row | {"verdict": _verdict(row, state, acro)}


def seen_under(corruption: str, runs: Iterable[LoadedRun]) -> list[LoadedRun]:
    """Runs under a corruption, and seeds of `state` of others where it has none: nothing is hidden from it."""
    found: dict[tuple[str, ...], LoadedRun] = {}
    for run in sorted(runs, key=lambda run: run.labels["corruption"] != corruption):
        if run.labels["corruption"] == corruption or run.labels["method"] == STATE:
            found.setdefault((str(run.labels["method"]), run.variant, str(run.labels["seed"])), run)
    return list(found.values())


def as_it_is(method: str, runs: Iterable[LoadedRun], history: str = "method") -> list[LoadedRun]:
    """The seeds of a method as it is: `best_of` its variants that add nothing to it but a history."""
    return best_of(run for run in runs if run.labels["method"] == method and is_plain(run.settings, history))


def best_of(runs: Iterable[LoadedRun]) -> list[LoadedRun]:
    """The seeds of the method and variant whose mean return is highest, none if there is no run.

    One with a single seed is taken only where none has more.
    """
    groups: dict[tuple[str, str], list[LoadedRun]] = {}
    for run in runs:
        groups.setdefault((str(run.labels["method"]), run.variant), []).append(run)
    enough = [members for members in groups.values() if len(members) > 1]
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


def _share(runs: list[LoadedRun]) -> float | None:
    """Mean share of its own data's return that a run returns; None where there is no run, or none that is above 0."""
    data = [run.reference.data_return for run in runs]
    known = [value for value in data if value is not None and value > 0]
    return float((returns_of(runs) / known).mean()) if runs and len(known) == len(runs) else None


def _verdict(row: Row, state: list[LoadedRun], acro: list[LoadedRun]) -> str:
    """A word, and why."""
    missed, unknown = [], []
    for name, least, words, runs in (
        ("state_share", STATE_SHARE, "state", state),
        ("acro_share", ACRO_SHARE, "acro under none", acro),
    ):
        if row[name] is None:
            unknown.append(_no_share(words, runs))
        elif row[name] < least:
            missed.append(f"{words} returns {row[name]:.2f} of the data's return, less than {least}")
    if row["error"] is None:
        unknown.append("best and random need two seeds each")
    elif row["above_random"] <= STANDARD_ERRORS * row["error"]:
        missed.append(f"best minus random is {row['above_random']:.0f}, within {STANDARD_ERRORS:g} standard errors")
    if missed:
        return f"{FAILED}: {'; '.join(missed)}"
    return f"{UNKNOWN}: {'; '.join(dict.fromkeys(unknown))}" if unknown else PASSED


def _no_share(words: str, runs: list[LoadedRun]) -> str:
    """Why the share of a reference is not known."""
    if not runs:
        return f"{words} was not measured"
    told = all(run.reference.data_return is not None for run in runs)
    return f"the data's return is {'not above 0' if told else 'not known'}"
