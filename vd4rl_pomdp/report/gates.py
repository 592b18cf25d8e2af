"""Whether a setting can tell methods apart at all: what has to hold before its methods are ranked.

The data must suffice for the algorithm where the state is known (`state`) and where nothing is hidden (`acro` under
`none`, as far as published methods get on pixels), under the corruption some method must be better than no training
(`random`), and the critics of all these runs must have converged. Where one of these fails, differences between returns
say more of the data, the algorithm and their budget than of the representations. The three are these methods as they
are, without what variants add to them, and returns are compared between runs of like settings alone.
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
"""Least share of the data's mean return, of `state`."""
PUBLISHED_SHARE, ACRO_SHARE = 0.8, 0.7
"""Least share, of `acro` under `none`: of what the better of BASELINES returns as published, but no more than of the
data's mean return; and of the data's mean return on sets of whose quality no score is published."""
BASELINES = {"bc": "BC", "drq_bc": "DrQ+BC"}
"""V-D4RL's baselines of offline control from pixels, by their columns in `published_scores`."""
PASSED, FAILED, UNKNOWN = "discriminates", "undecided at this budget", "not known to discriminate"
NOT_RECORDED = "convergence is not recorded"
GATED = (*SETTING, "algorithm")


class Sides(NamedTuple):
    """What is compared: seeds of two methods, each of one variant, or nothing where one has no run."""

    left: list[Run]
    right: list[Run]
    unlike: list[str]
    """Settings in which they differ; empty where the comparison is one of methods."""


def gates(runs: list[Run]) -> list[Row]:
    """One row for every task, quality, corruption and algorithm with frozen encoders' finished runs, and its `verdict`.

    `data_return` is a mean over the sets behind its runs; `state_share`, `acro_share` and `best_share`, the best
    method's, are shares of the return of their own, `state_seeds` and `acro_seeds` how many runs these rest on.
    `acro_bar` is the least `acro_share`, `bar_from` the published score that it is made of. `above_random` is the best
    method's mean return less that of `random`, as `sides` finds them, `low` and `high` its 95% interval. `converged`
    tells whether the critics of all these runs did. What is not known is None.
    """
    finished = comparable(runs)
    return [_gate(key, finished) for key in sorted({run.of(GATED) for run in finished})]


def verdicts(runs: Iterable[Run], certificates: Mapping[str, Row]) -> dict[tuple[str, ...], str]:
    """What certificates say of memory in every setting with an evaluated run; where its runs are of several sets, of
    each.

    Args:
        runs: those of a report.
        certificates: by id.
    """
    found = {}
    for place, mine in groups((run for run in runs if run.rows), lambda run: run.of(SETTING)).items():
        names = dict.fromkeys(run.result.certificate for run in mine)
        told = (certificate_in_words(certificates[name]) if name in certificates else NOT_CERTIFIED for name in names)
        found[place] = "; ".join(dict.fromkeys(told))
    return found


def comparable(runs: Iterable[Run]) -> list[Run]:
    """Finished runs whose encoders were frozen: one that the policy trains says nothing of an objective."""
    return [run for run in runs if run.evaluated and not run.end_to_end]


def on_set(place: tuple[str, ...], runs: Iterable[Run]) -> list[Run]:
    """Runs of a row's task, quality and algorithm, whatever was hidden from them."""
    task, quality, _, algorithm = place
    return [run for run in runs if run.of(("task", "quality", "algorithm")) == (task, quality, algorithm)]


def unranked(table: list[Row], names: Sequence[str] = GATED) -> set[tuple[str, ...]]:
    """The settings that are undecided: values of some columns, where all rows that have them miss a gate."""
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
    if missed:  # one is enough, whatever is not known of the others
        return row | {"verdict": f"{FAILED}: {'; '.join(missed)}"}
    return row | {"verdict": f"{UNKNOWN}: {'; '.join(dict.fromkeys(unknown))}" if unknown else PASSED}


def pixel_bar(task: str, quality: str, data: Sequence[float | None]) -> tuple[float | None, str]:
    """Least share of its data's return that `acro` under `none` must return, and where that is from.

    Args:
        task: of a set.
        quality: of a set.
        data: mean return of the data of each run that is judged; without any, or one above 0, there is no bar.
    """
    scores = [row for row in published_scores() if (row["env"], row["dataset"]) == (task, quality)]
    if not scores:
        return ACRO_SHARE, "none published"
    score, name = max((float(scores[0][column]), name) for column, name in BASELINES.items())
    returns = [value for value in data if value is not None and value > 0]
    # Published behaviour returned less than ours on some sets: what counts on them is to keep up with our own data.
    shares = [min(1.0, 10 * score / value) for value in returns]
    known = bool(returns) and len(returns) == len(data)
    return PUBLISHED_SHARE * float(np.mean(shares)) if known else None, f"{name} {score:g}"


def converged(runs: Iterable[Run]) -> bool | None:
    """Whether the critics of all runs did: False if one did not, else None if it is not recorded of one."""
    told = {run.converged for run in runs}
    return False if False in told else None if None in told else True


def seen_under(corruption: str, runs: Iterable[Run]) -> list[Run]:
    """Runs under a corruption, and seeds of `state` of others where it has none: nothing is hidden from it."""
    # The setting's own first: a seed of `state` that ran under two corruptions is one seed, not two.
    found: dict[tuple[str, ...], Run] = {}
    for run in sorted(runs, key=lambda run: run.labels["corruption"] != corruption):
        if run.labels["corruption"] == corruption or run.method == STATE:
            found.setdefault(run.of(("method", "variant", "seed")), run)
    return list(found.values())


def as_it_is(method: str, runs: Iterable[Run], history: str = "method") -> list[Run]:
    """The runs of a method as it is: those that add nothing to it but a history. What is not recorded adds nothing."""
    plain = (PLAIN | {"history": history}).items()
    mine = [run for run in runs if run.method == method]
    return [run for run in mine if all(run.settings.get(name, PLAIN[name]) == value for name, value in plain)]


def best_of(runs: Iterable[Run]) -> list[Run]:
    """The seeds of the method and variant whose mean return is highest, none if there is no run.

    One with a single seed is taken only where none has more.
    """
    return max(seeds_by_variant(runs), key=_preference, default=[])


def sides(left: Iterable[Run], right: Iterable[Run]) -> Sides:
    """Of the pairs of a method and variant of each side the one to be compared.

    First come pairs of like settings, then those with more than one seed on both sides, then those that return most.
    """
    others = seeds_by_variant(right)
    pairs = [Sides(one, other, _unlike(one, other)) for one in seeds_by_variant(left) for other in others]
    alike = [pair for pair in pairs if not pair.unlike]
    return max(alike or pairs, key=lambda pair: _preference(pair.left, pair.right), default=Sides([], [], []))


def seeds_by_variant(runs: Iterable[Run]) -> list[list[Run]]:
    """Seeds by method and variant; where they share an encoder, their spread is not that of a method."""
    own = (run for run in runs if ENCODER_SEED not in run.settings)
    return list(groups(own, lambda run: run.of(("method", "variant"))).values())


def _preference(*compared: list[Run]) -> tuple[int, float]:
    """How many have more than one seed, and the sum of their mean returns."""
    # Otherwise a single lucky seed would be the best method, and no interval could say how lucky.
    return sum(len(seeds) > 1 for seeds in compared), sum(float(returns_of(seeds).mean()) for seeds in compared)


def _unlike(left: list[Run], right: list[Run]) -> list[str]:
    """Settings that seeds of both sides have, but not alike, other than what a claim is about and what hides pixels.

    Of a method that is not pretrained, only settings of fine-tuning count. Where every training seed has a set of its
    own, that of both sides is the same.
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
    return [name for name in found if name in PRESETS] or found  # a preset stands for what it decides


def returns_of(runs: list[Run]) -> np.ndarray:
    """Mean return of each run's last evaluation, (n,)."""
    return np.array([np.mean([row["return"] for row in run.last]) for run in runs])


def episodes_of(runs: list[Run], clean: bool = False) -> np.ndarray:
    """Returns of the episodes of each run's last evaluation, or of that with nothing hidden, (n, episodes)."""
    return stats.by_episode([[row["return"] for row in (run.last_clean if clean else run.last)] for run in runs])


def difference(compared: Sides, clean: bool = False) -> tuple[float | None, tuple[float | None, float | None]]:
    """Mean return of the left side less that of the right one, and its 95% interval over seeds and episodes.

    None where a side has no run, or settings differ, or, with `clean`, where a policy was not played with nothing
    hidden; no interval where `stats.difference_interval` has none.
    """
    everyone = [*compared.left, *compared.right]
    if not compared.left or compared.unlike or (clean and not all(run.last_clean for run in everyone)):
        return None, (None, None)
    best, floor = (episodes_of(runs, clean) for runs in (compared.left, compared.right))
    return float(best.mean() - floor.mean()), stats.difference_interval(best, floor) or (None, None)


def _share(runs: list[Run]) -> float | None:
    """Mean share of its own data's return that a run returns; None if there is no run, or a data return not above 0."""
    data = [run.reference.data_return for run in runs]
    known = [value for value in data if value is not None and value > 0]
    return float((returns_of(runs) / known).mean()) if runs and len(known) == len(runs) else None
