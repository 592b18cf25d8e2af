"""Gates that a setting must pass before its methods are ranked.

1. The data must suffice for the algorithm, both with the state known (`state`) and with nothing hidden (`acro` under
   `none`, relative to published results from pixels).
2. Under the corruption, some method must beat an untrained encoder (`random`).
3. The critics of all these runs must have converged.

If a gate fails, differences in return reflect the data, the algorithm and their budget more than the representations.
The three reference methods are used without variants, and only runs with equal settings are compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from vd4rl_pomdp.core.errors import told_apart
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.load import (
    DATA,
    ENCODER_SEED,
    PLAIN,
    PRESETS,
    REFERENCES,
    SETTING,
    STATE,
    Run,
    a_set_a_seed,
    of_corruption,
)
from vd4rl_pomdp.report.stats import interval
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.results import NOT_CERTIFIED, certificate_in_words

STATE_SHARE = 0.9
"""Minimum return of `state`, as a fraction of the data's mean return."""
PUBLISHED_SHARE, ACRO_SHARE = 0.8, 0.7
"""Minimum return of `acro` under `none`: PUBLISHED_SHARE of the highest published return of BASELINES or of the
data's mean return, whichever is smaller; ACRO_SHARE of the latter if no score is published for the quality."""
BASELINES = {"bc": "BC", "drq_bc": "DrQ+BC"}
"""V-D4RL's offline baselines from pixels, by column of `published_scores`."""
PASSED, FAILED, UNKNOWN = "discriminates", "undecided at this budget", "not known to discriminate"
NOT_RECORDED = "convergence is not recorded"
GATED = (*SETTING, "algorithm")


class Sides(NamedTuple):
    """A comparison of two methods' seeds, each of one variant; empty if one side has no run."""

    left: list[Run]
    right: list[Run]
    unlike: list[str]
    """Settings in which both sides differ; if not empty, the comparison is not one of methods alone."""


def gates(runs: list[Run]) -> list[Row]:
    """One row with a `verdict` per task, quality, corruption and algorithm with finished runs of frozen encoders.

    `data_return` is a mean over the datasets of its runs. `state_share`, `acro_share` and `best_share` (of the best
    method) are fractions of the data's return; `state_seeds` and `acro_seeds` count the runs behind them. `acro_bar` is
    the minimum for `acro_share`, and `bar_from` the published score behind it. `above_random` is the mean return of the
    best method minus that of `random`, chosen by `sides`; `low` and `high` bound its 95% interval. `converged` says
    whether the critics of all these runs did. Unknown values are None.
    """
    finished = comparable(runs)
    return [_gate(key, finished) for key in sorted({run.of(GATED) for run in finished})]


def verdicts(runs: Iterable[Run], certificates: Mapping[str, Row]) -> dict[tuple[str, ...], str]:
    """By setting with an evaluated run, what certificates say about the need for memory, for each of its datasets.

    Args:
        runs: runs of a report.
        certificates: by id.
    """
    found = {}
    for place, mine in groups((run for run in runs if run.rows), lambda run: run.of(SETTING)).items():
        names = dict.fromkeys(run.result.certificate for run in mine)
        told = (certificate_in_words(certificates[name]) if name in certificates else NOT_CERTIFIED for name in names)
        found[place] = "; ".join(dict.fromkeys(told))
    return found


def comparable(runs: Iterable[Run]) -> list[Run]:
    """Evaluated runs with frozen encoders. End-to-end training says nothing about a pretraining objective."""
    return [run for run in runs if run.evaluated and not run.end_to_end]


def on_set(place: tuple[str, ...], runs: Iterable[Run]) -> list[Run]:
    """Runs with a row's task, quality and algorithm, under any corruption."""
    task, quality, _, algorithm = place
    return [run for run in runs if run.of(("task", "quality", "algorithm")) == (task, quality, algorithm)]


def unranked(table: list[Row], names: Sequence[str] = GATED) -> set[tuple[str, ...]]:
    """Undecided settings: values of some columns for which all rows fail a gate."""
    places = groups(table, lambda row: tuple(row[name] for name in names))
    return {place for place, rows in places.items() if all(row["verdict"].startswith(FAILED) for row in rows)}


def _gate(key: tuple[str, ...], runs: list[Run]) -> Row:
    alike = on_set(key, runs)
    here, clean = (seen_under(under, alike) for under in (key[2], "none"))
    state, acro = best_of(as_it_is("state", here)), best_of(as_it_is("acro", clean))
    learned = [run for run in here if run.method not in REFERENCES]
    floor = as_it_is("random", here)
    compared = sides(learned, floor)
    above, (low, high) = difference(compared)
    data = {value for run in here if (value := run.reference.data_return) is not None}
    everyone = {"state": state, "acro under none": acro, "best": compared.left, "random": compared.right}
    bar, source = pixel_bar(key[0], key[1], [run.reference.data_return for run in acro or here])
    row: Row = dict(zip(GATED, key, strict=True)) | {
        "data_return": float(np.mean(sorted(data))) if data else None,
        "state_share": _share(state),
        "state_seeds": len(state),
        "acro_share": _share(acro),
        "acro_seeds": len(acro),
        "acro_bar": bar,
        "bar_from": source,
        "best_share": _share(compared.left),
        **{"above_random": above, "low": low, "high": high},
        "converged": converged(run for runs in everyone.values() for run in runs),
    }
    missed, unknown = [], []
    for name, least, words, reference in (
        ("state_share", STATE_SHARE, "state", state),
        ("acro_share", row["acro_bar"], "acro under none", acro),
    ):
        if not reference:
            unknown.append(f"{words} was not measured")
        elif row[name] is None:
            told = all(run.reference.data_return is not None for run in reference)
            unknown.append(f"the data's return is {'not above 0' if told else 'not known'}")
        elif row[name] < least:
            share, asked = told_apart(row[name], least, 2)
            missed.append(f"{words} returns {share} of the data's return, less than {asked}")
    if compared.unlike:
        unknown.append(f"best and random have other {', '.join(compared.unlike)}")
    elif not floor or not learned:
        unknown.append("no method but references was measured" if floor else "random was not measured")
    elif row["low"] is None:
        unknown.append("best and random need two seeds each that differ")
    elif row["low"] <= 0:
        missed.append(f"best minus random is {row['above_random']:.0f} {interval(row['low'], row['high'], 0)}")
    if row["converged"] is None:
        unknown.append(NOT_RECORDED)
    if still := [name for name, mine in everyone.items() if converged(mine) is False]:
        missed.append(f"critics had not converged ({', '.join(still)})")
    if missed:  # one failed gate suffices, whatever is unknown about the others
        return row | {"verdict": f"{FAILED}: {'; '.join(missed)}"}
    return row | {"verdict": f"{UNKNOWN}: {'; '.join(dict.fromkeys(unknown))}" if unknown else PASSED}


def pixel_bar(task: str, quality: str, data: Sequence[float | None]) -> tuple[float | None, str]:
    """Minimum return of `acro` under `none`, as a fraction of its data's return, and the published score behind it.

    Args:
        task: the dataset's task.
        quality: the dataset's quality.
        data: mean return of each judged run's data. Unless all are known and above 0, there is no minimum.
    """
    scores = [row for row in published_scores() if (row["env"], row["dataset"]) == (task, quality)]
    if not scores:
        return ACRO_SHARE, "none published"
    score, name = max((float(scores[0][column]), name) for column, name in BASELINES.items())
    returns = [value for value in data if value is not None and value > 0]
    # Published returns exceed ours on some datasets: there, matching our own data's return is enough.
    shares = [min(1.0, 10 * score / value) for value in returns]
    known = bool(returns) and len(returns) == len(data)
    return PUBLISHED_SHARE * float(np.mean(shares)) if known else None, f"{name} {score:g}"


def converged(runs: Iterable[Run]) -> bool | None:
    """Whether the critics of all runs converged: False if one did not, else None if one is not recorded."""
    told = {run.converged for run in runs}
    return False if False in told else None if None in told else True


def seen_under(corruption: str, runs: Iterable[Run]) -> list[Run]:
    """Runs under a corruption, with missing seeds of `state` from other corruptions: nothing is hidden from it."""
    # The setting's own runs first, so that a seed of `state` under two corruptions counts once.
    found: dict[tuple[str, ...], Run] = {}
    for run in sorted(runs, key=lambda run: run.labels["corruption"] != corruption):
        if run.labels["corruption"] == corruption or run.method == STATE:
            found.setdefault(run.of(("method", "variant", "seed")), run)
    return list(found.values())


def as_it_is(method: str, runs: Iterable[Run], history: str = "method") -> list[Run]:
    """Runs of a method without variants other than its history. Unrecorded settings count as plain."""
    plain = (PLAIN | {"history": history}).items()
    mine = [run for run in runs if run.method == method]
    return [run for run in mine if all(run.settings.get(name, PLAIN[name]) == value for name, value in plain)]


def best_of(runs: Iterable[Run]) -> list[Run]:
    """Seeds of the method and variant with the highest mean return; empty without runs.

    A variant with a single seed is chosen only if none has more.
    """
    return max(seeds_by_variant(runs), key=_preference, default=[])


def sides(left: Iterable[Run], right: Iterable[Run]) -> Sides:
    """The pair of variants to compare, one from each side.

    Prefers pairs with equal settings, then with more than one seed on both sides, then with the highest returns.
    """
    others = seeds_by_variant(right)
    pairs = [Sides(one, other, _unlike(one, other)) for one in seeds_by_variant(left) for other in others]
    alike = [pair for pair in pairs if not pair.unlike]
    return max(alike or pairs, key=lambda pair: _preference(pair.left, pair.right), default=Sides([], [], []))


def seeds_by_variant(runs: Iterable[Run]) -> list[list[Run]]:
    """Seeds by method and variant. Seeds that share an encoder are left out: their spread is not a method's."""
    own = (run for run in runs if ENCODER_SEED not in run.settings)
    return list(groups(own, lambda run: run.of(("method", "variant"))).values())


def _preference(*compared: list[Run]) -> tuple[int, float]:
    """Sort key: number of sides with more than one seed, then the sum of mean returns."""
    # Otherwise a lucky single seed could win, without an interval to show it.
    return sum(len(seeds) > 1 for seeds in compared), sum(float(returns_of(seeds).mean()) for seeds in compared)


def _unlike(left: list[Run], right: list[Run]) -> list[str]:
    """Settings that differ between both sides, ignoring those under comparison and the corruption's.

    For methods without pretraining, only fine-tuning settings count. If every training seed has its own dataset,
    datasets count as equal.
    """
    one, other = left[0], right[0]
    names = (one.settings.keys() & other.settings.keys()) - PLAIN.keys() - of_corruption(one.settings).keys()
    for run in (one, other):
        if run.method in ("random", STATE):
            names &= settings_of(run.record["config"]).keys() | {DATA[0]}
    found = [name for name in one.settings if name in names - {DATA[0]} and one.settings[name] != other.settings[name]]
    sets = {run.settings.get(DATA[0]) for run in (*left, *right)}
    if DATA[0] in names and len(sets) > 1 and not a_set_a_seed([*left, *right]):
        found.append(DATA[0])
    return [name for name in found if name in PRESETS] or found  # a preset stands for the settings that it determines


def returns_of(runs: list[Run]) -> np.ndarray:
    """Mean return of each run's last evaluation, (n,)."""
    return np.array([np.mean([row["return"] for row in run.last]) for run in runs])


def episodes_of(runs: list[Run], clean: bool = False) -> np.ndarray:
    """Episode returns of each run's last evaluation, or with `clean` of the uncorrupted one, (n, episodes)."""
    return stats.by_episode([[row["return"] for row in (run.last_clean if clean else run.last)] for run in runs])


def difference(compared: Sides, clean: bool = False) -> tuple[float | None, tuple[float | None, float | None]]:
    """Mean return of the left side minus that of the right, and its 95% interval over seeds and episodes.

    None if a side has no run, if settings differ or, with `clean`, if a policy was not evaluated without corruption.
    The interval is None if `stats.difference_interval` has none.
    """
    everyone = [*compared.left, *compared.right]
    if not compared.left or compared.unlike or (clean and not all(run.last_clean for run in everyone)):
        return None, (None, None)
    best, floor = (episodes_of(runs, clean) for runs in (compared.left, compared.right))
    return float(best.mean() - floor.mean()), stats.difference_interval(best, floor) or (None, None)


def _share(runs: list[Run]) -> float | None:
    """Mean return as a fraction of each run's own data return; None without runs or if a data return is not above 0."""
    data = [run.reference.data_return for run in runs]
    known = [value for value in data if value is not None and value > 0]
    return float((returns_of(runs) / known).mean()) if runs and len(known) == len(runs) else None
