"""What the paper states of offline control, judged on returns, a setting at a time.

Its text and its two figures (Wu et al., arXiv 2404.14552, Section 4.2) say that baselines fail considerably under
partial observability, that a history and then past actions improve on them, and that MIK+A is ahead in almost all
tasks. Two distances stand beside that: to a memory that was told the states, and to the states themselves. Only runs of
like settings are compared.

Claims of a family (results/protocol.md names two) are tested together: Holm's method adjusts their p values over the
family's claims that are measured in a setting. All others are exploratory and judged by themselves.
"""

from __future__ import annotations

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
"""What becomes of a claim that one side is not below the other, where that is undecided."""
DISTANCE = "distance"
"""The kind of what is no claim."""


class Contender(NamedTuple):
    """Runs that a claim is about."""

    method: str = ""
    """A method; empty for every one that the other side does not name."""
    history: str = "method"
    """Its `--history`."""
    clean: bool = False
    """Whether they saw everything, whatever the setting hides."""


class ReturnClaim(NamedTuple):
    """The left side returns more than the right one."""

    text: str
    left: Contender
    right: Contender
    hidden: bool = True
    """Whether it is about settings that hide something, or about those that hide nothing."""
    kind: str = "above"
    """above; not below, which is refuted where the left side is below; distance, which is no claim."""
    family: str = EXPLORATORY
    """The claims that it is tested with; exploratory: none."""


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
    """One row for every claim and setting of which both sides have finished runs, with its `verdict`.

    `difference` is the left side's mean return less the right one's, `low` and `high` its 95% interval, `p` its
    two-sided p value; `clean_` are the same for the policies played with nothing hidden. A claim of a family is judged
    by `adjusted_p`, an exploratory one by `p`. `smallest` is the difference that a test at 5% finds in 80% of cases
    with this standard error, `smallest_share` the same as a share of the data's return. Where no runs of both sides
    have like settings, there are none, and the verdict says what differs. Nothing is judged unless the critics of both
    sides are known to have converged.

    Args:
        runs: of a report.
        unranked: settings that are undecided: there nothing is judged.
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
    """What becomes of a claim over its settings: "holds in 1 of 2 settings; too few seeds in 1"."""
    if rows[0]["kind"] == DISTANCE:
        return ""
    counts = {verdict: len(members) for verdict, members in groups(rows, lambda row: str(row["verdict"])).items()}
    held = f"{HOLDS} in {counts.pop(HOLDS, 0)} of {len(rows)} setting{'s' * (len(rows) != 1)}"
    return "; ".join([held, *(f"{verdict} in {count}" for verdict, count in counts.items())])


def _place(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in GATED)


def _row(claim: ReturnClaim, place: tuple[str, ...], runs: list[Run]) -> tuple[Row, Sides] | None:
    """A claim in a setting, not yet judged, and what it compares; None where a side has no run."""
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
    return row | _test(compared), compared


def _test(compared: Sides) -> Row:
    """How sure a difference is: its p value, and the smallest that would be found."""
    found = None if compared.unlike else stats.difference(episodes_of(compared.left), episodes_of(compared.right))
    data = [run.reference.data_return for run in (*compared.left, *compared.right)]
    known = [value for value in data if value is not None]
    mean = float(np.mean(known)) if len(known) == len(data) else None
    smallest = found and found.smallest
    return {
        **{"p": found and found.p, "adjusted_p": None, "smallest": smallest, "data_return": mean},
        "smallest_share": smallest / mean if smallest and mean and mean > 0 else None,
    }


def _decisive(left: list[Run], others: list[Run]) -> Sides:
    """The comparison that decides a claim about every other method.

    Of those with other methods and variants it is the one that refutes it with the highest return, or else that leaves
    it open, however few its seeds: the claim holds where it holds against every one.
    """
    pairs = [pair for seeds in seeds_by_variant(others) if (pair := sides(left, seeds)).left]
    alike = [pair for pair in pairs if not pair.unlike]
    refuted = [pair for pair in alike if _beyond(*difference(pair)[1]) == FAILS]
    doubted = [pair for pair in alike if _beyond(*difference(pair)[1]) != HOLDS or not converged(pair.right)]
    # Comparing with the best other method alone would pass over a lesser one that a single seed leaves open.
    decisive = refuted or doubted or alike or pairs
    return max(decisive, key=lambda pair: returns_of(pair.right).mean(), default=Sides([], [], []))


def _beyond(low: float | None, high: float | None) -> str:
    """What the interval of a difference of means says of its left side being above."""
    if low is None or high is None:
        return FEW
    return HOLDS if low > 0 else FAILS if high < 0 else OPEN


def _runs_of(side: Contender, other: Contender, corruption: str, runs: Iterable[Run]) -> list[Run]:
    """Runs of one side: of a method as it is, or of all other methods."""
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
