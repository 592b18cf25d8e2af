"""The paper's claims about offline control, judged on returns in each setting.

The text and two figures of Wu et al. (arXiv 2404.14552, Section 4.2) claim that baselines fail considerably under
partial observability, that a history and then past actions improve on them, and that MIK+A leads in almost all tasks.
Two distances are reported besides: to a memory supervised with states, and to the states themselves. Only runs with
equal settings are compared.

Claims of a family (results/protocol.md names two) are tested together: Holm's method adjusts their p values over the
family's claims measured in a setting. All others are exploratory and judged individually.

`leads` measures MIK+A's lead over the pretraining budget: does it persist with a larger one?
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.gates import (
    FAILED,
    GATED,
    NOT_RECORDED,
    Sides,
    as_it_is,
    comparable,
    converged,
    difference,
    episodes_of,
    on_set,
    returns_of,
    seeds_by_variant,
    seen_under,
    sides,
)
from vd4rl_pomdp.report.load import REFERENCES, Run, label
from vd4rl_pomdp.runs.files import Row, groups

HOLDS, FAILS, OPEN, FEW = "holds", "does not hold", "undecided", "too few seeds"
PRIMARY, SECOND, EXPLORATORY = "primary", "second family", "exploratory"
NOT_REFUTED = "not refuted"
"""Verdict of an undecided "not below" claim."""
DISTANCE = "distance"
"""Kind of a row that is a measurement, not a claim."""


class Contender(NamedTuple):
    """The runs on one side of a claim."""

    method: str = ""
    """A method; empty: every method except the other side's."""
    history: str = "method"
    """Its `--history`."""
    clean: bool = False
    """Whether to take runs without corruption, whatever the setting hides."""


class ReturnClaim(NamedTuple):
    """A claim that the left side returns more than the right."""

    text: str
    left: Contender
    right: Contender
    hidden: bool = True
    """True: for settings with a corruption; False: for settings without."""
    kind: str = "above"
    """above; not below (refuted if the left side is below); or distance, which is no claim."""
    family: str = EXPLORATORY
    """Claims that it is tested together with; exploratory: none."""


CLAIMS = (
    ReturnClaim("acro returns less where pixels are hidden", Contender("acro", clean=True), Contender("acro")),
    ReturnClaim("a memory pays: mik above acro", Contender("mik"), Contender("acro"), family=PRIMARY),
    ReturnClaim(
        "a memory pays: acro with a GRU above acro",
        Contender("acro", history="gru"),
        Contender("acro"),
        family=PRIMARY,
    ),
    ReturnClaim("past actions pay: mik+a above mik", Contender("mik+a"), Contender("mik"), family=PRIMARY),
    ReturnClaim("both pay: mik+a above acro", Contender("mik+a"), Contender("acro"), family=PRIMARY),
    ReturnClaim("mik+a above ah+a", Contender("mik+a"), Contender("ah+a"), family=SECOND),
    ReturnClaim("mik+a above fj+a", Contender("mik+a"), Contender("fj+a"), family=SECOND),
    ReturnClaim("mik+a is above every other method", Contender("mik+a"), Contender()),
    ReturnClaim(
        "with nothing hidden, mik+a is not below acro",
        Contender("mik+a"),
        Contender("acro"),
        hidden=False,
        kind="not below",
    ),
    ReturnClaim(
        "what is left to a memory that was told the states",
        Contender("supervised+a"),
        Contender("mik+a"),
        kind=DISTANCE,
    ),
    ReturnClaim(
        "what is left to the states themselves", Contender("state", clean=True), Contender("mik+a"), kind=DISTANCE
    ),
)


def judge_claims(runs: list[Run], unranked: Collection[tuple[str, ...]] = ()) -> list[Row]:
    """One row with a `verdict` per claim and setting in which both sides have finished runs.

    `difference` is the left side's mean return minus the right's, `low` and `high` its 95% interval, `p` its two-sided
    p value; columns with `clean_` are the same without corruption. A claim of a family is judged by `adjusted_p`, an
    exploratory one by `p`. `smallest` is the difference that a 5% test with this standard error detects with 80% power;
    `smallest_share` is the same as a fraction of the data's return. If the sides have no runs with equal settings,
    these are None and the verdict names the differences. Nothing is judged unless the critics of both sides are known
    to have converged.

    Args:
        runs: of a report.
        unranked: undecided settings, in which nothing is judged.
    """
    finished = comparable(runs)
    settings = sorted({run.of(GATED) for run in finished})
    found = [one for claim in CLAIMS for place in settings if (one := _row(claim, place, finished)) is not None]
    for (family, *_), mine in groups((row for row, _ in found), lambda row: (row["family"], *_place(row))).items():
        tested = [row for row in mine if family in (PRIMARY, SECOND) and row["p"] is not None]
        for row, adjusted in zip(tested, stats.holm([row["p"] for row in tested]), strict=True):
            row["adjusted_p"] = adjusted
    return [row | {"verdict": _verdict(row, compared, _place(row) in unranked)} for row, compared in found]


def tally(rows: list[Row]) -> str:
    """Summary of a claim over its settings: "holds in 1 of 2 settings; too few seeds in 1"."""
    if rows[0]["kind"] == DISTANCE:
        return ""
    counts = {verdict: len(members) for verdict, members in groups(rows, lambda row: str(row["verdict"])).items()}
    held = f"{HOLDS} in {counts.pop(HOLDS, 0)} of {len(rows)} setting{'s' * (len(rows) != 1)}"
    return "; ".join([held, *(f"{verdict} in {count}" for verdict, count in counts.items())])


def _place(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in GATED)


def _row(claim: ReturnClaim, place: tuple[str, ...], runs: list[Run]) -> tuple[Row, Sides] | None:
    """A claim in a setting, not judged yet, and its comparison; None if a side has no run."""
    corruption, alike = place[2], on_set(place, runs)
    if claim.hidden == (corruption == "none"):
        return None
    left = _runs_of(claim.left, claim.right, corruption, alike)
    right = _runs_of(claim.right, claim.left, corruption, alike)
    compared = sides(left, right) if claim.right.method else _decisive(left, right)
    if not compared.left:
        return None
    row: Row = {"claim": claim.text, "kind": claim.kind, "family": "" if claim.kind == DISTANCE else claim.family}
    row |= dict(zip(GATED, place, strict=True))
    row |= _side("left", compared.left) | _side("right", compared.right)
    for prefix in ("", "clean_"):
        above, (low, high) = difference(compared, clean=bool(prefix))
        row |= {f"{prefix}difference": above, f"{prefix}low": low, f"{prefix}high": high}
    found = None if compared.unlike else stats.difference(episodes_of(compared.left), episodes_of(compared.right))
    data = [run.reference.data_return for run in (*compared.left, *compared.right)]
    mean = None if None in data else float(np.mean(data))  # type: ignore[arg-type]
    smallest = found and found.smallest
    row |= {"p": found and found.p, "adjusted_p": None, "smallest": smallest, "data_return": mean}
    row["smallest_share"] = smallest / mean if smallest and mean and mean > 0 else None
    return row, compared


def _decisive(left: list[Run], others: list[Run]) -> Sides:
    """The comparison that decides a claim about every other method, since it must hold against each of them.

    Among other methods and variants: the one with the highest return of those that refute the claim, else of those that
    leave it open, however few seeds they have.
    """
    pairs = [pair for seeds in seeds_by_variant(others) if (pair := sides(left, seeds)).left]
    alike = [pair for pair in pairs if not pair.unlike]
    refuted = [pair for pair in alike if _beyond(*difference(pair)[1]) == FAILS]
    doubted = [pair for pair in alike if _beyond(*difference(pair)[1]) != HOLDS or not converged(pair.right)]
    # The best other method alone is not enough: a weaker one with a single seed may leave the claim open.
    decisive = refuted or doubted or alike or pairs
    return max(decisive, key=lambda pair: returns_of(pair.right).mean(), default=Sides([], [], []))


def _beyond(low: float | None, high: float | None) -> str:
    """Whether a difference's interval shows its left side above."""
    if low is None or high is None:
        return FEW
    return HOLDS if low > 0 else FAILS if high < 0 else OPEN


def _runs_of(side: Contender, other: Contender, corruption: str, runs: Iterable[Run]) -> list[Run]:
    """Runs of one side: of a method without variants, or of all other methods."""
    seen = seen_under("none" if side.clean else corruption, runs)
    if side.method:
        return as_it_is(side.method, seen, side.history)
    return [run for run in seen if run.method not in (other.method, *REFERENCES)]


def _side(name: str, runs: list[Run]) -> Row:
    shown = label(runs[0].named)
    return {name: shown, f"{name}_return": float(returns_of(runs).mean()), f"{name}_seeds": len(runs)}


def _verdict(row: Row, compared: Sides, unranked: bool) -> str:
    if compared.unlike:
        return f"not judged: other {', '.join(compared.unlike)}"
    if row["kind"] == DISTANCE:
        return ""
    settled = converged([*compared.left, *compared.right])
    if unranked or settled is False:
        return f"not judged: {FAILED}"
    if settled is None:
        return f"not judged: {NOT_RECORDED}"
    p = row["p"] if row["adjusted_p"] is None else row["adjusted_p"]
    sign = HOLDS if row["difference"] > 0 else FAILS
    found = FEW if p is None else sign if p < stats.LEVEL else OPEN
    return NOT_REFUTED if found == OPEN and row["kind"] == "not below" else found


LEADER, OTHER = "mik+a", "acro"
OTHERS = {"mik+a less acro": "method", "mik+a less acro with a GRU": "gru"}
"""What the leader is compared with, by the difference's name: the other method's `--history`."""


def leads(runs: list[Run]) -> list[Row]:
    """One row per setting, policy budget, difference and pretraining budget.

    Only where both methods have at least two pretraining budgets, with a run each. `difference` is the leader's mean
    return minus the other method's, each run's in % of its own data's mean return; `low` and `high` bound its 95%
    interval over seeds and episodes. Only runs with equal settings are compared; without any it is None. `left_seeds`
    and `right_seeds` count both sides' seeds, comparable or not.

    A policy's budget is its `updates` and hidden `units`; a pretraining's is its `steps` and frame `stacks` per batch.
    """
    finished = [run for run in comparable(runs) if (run.reference.data_return or 0) > 0]
    sides_of = [as_it_is(LEADER, finished), *(as_it_is(OTHER, finished, history) for history in OTHERS.values())]
    known = []
    for run in (run for side in sides_of for run in side):
        own, card = run.record["config"], run.result.card
        before = card.get("settings") or {}
        if {"updates", "hidden_dim"} <= own.keys() and "steps" in card and {"batch_size", "window"} <= before.keys():
            pretraining = card["steps"], before["batch_size"] * before["window"]
            known.append((run, (own["updates"], own["hidden_dim"]), pretraining))
    rows: list[Row] = []
    for (place, (updates, units)), here in sorted(groups(known, lambda one: (one[0].of(GATED), one[1])).items()):
        by_budget, everyone = groups(here, lambda one: one[2]), [run for run, *_ in here]
        for name, history in OTHERS.items():
            if len(by_budget) < 2 or not (as_it_is(LEADER, everyone) and as_it_is(OTHER, everyone, history)):
                continue
            for steps, stacks in sorted(by_budget, key=math.prod):
                row = dict(zip(GATED, place, strict=True)) | {"method": name, "variant": "", "updates": updates}
                row |= {"units": units, "steps": steps, "stacks": stacks}
                rows.append(row | _lead([run for run, *_ in by_budget[steps, stacks]], history))
    if len({(row["updates"], row["units"]) for row in rows}) > 1:
        for row in rows:
            row["variant"] = f"{row['updates']:,} updates of {row['units']:,} units"
    return rows


def _lead(runs: list[Run], history: str) -> Row:
    """The difference among runs of one budget."""
    both = as_it_is(LEADER, runs), as_it_is(OTHER, runs, history)
    compared = sides(*both)
    difference, ends = None, None
    if compared.left and not compared.unlike:
        both = compared.left, compared.right
        data = (np.array([[run.reference.data_return] for run in side], dtype=float) for side in both)
        left, right = (100 * episodes_of(side) / known for side, known in zip(both, data, strict=True))
        difference, ends = float(left.mean() - right.mean()), stats.difference_interval(left, right)
    low, high = ends or (None, None)
    seeds = [len({run.labels["seed"] for run in side}) for side in both]
    row: Row = {"difference": difference, "low": low, "high": high}
    return row | {"seeds": 0 if difference is None else min(seeds), "left_seeds": seeds[0], "right_seeds": seeds[1]}
