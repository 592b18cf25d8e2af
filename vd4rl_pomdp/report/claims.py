"""What the paper states of offline control, judged on returns, a setting at a time.

Its text and its two figures (Wu et al., arXiv 2404.14552, Section 4.2) say that baselines fail considerably under
partial observability, that a history and then past actions improve on them, and that MIK+A is ahead in almost all
tasks. Two distances stand beside that: to a memory that was told the states, and to the states themselves.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import NamedTuple

from vd4rl_pomdp.report.gates import (
    FAILED,
    SETTING,
    STANDARD_ERRORS,
    as_it_is,
    best_of,
    difference,
    returns_of,
    seen_under,
)
from vd4rl_pomdp.report.load import LoadedRun
from vd4rl_pomdp.report.tables import END_TO_END, REFERENCES, grouped, label
from vd4rl_pomdp.runs.files import Row

HOLDS, FAILS, OPEN, FEW = "holds", "does not hold", "not told apart", "too few seeds"


class Contender(NamedTuple):
    """Runs that a claim is about."""

    method: str = ""
    """A method; empty for the best of those that the other side does not name."""
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
    """above; not below, which the left side's missing advantage does not refute; distance, which is no claim."""


CLAIMS = (
    ReturnClaim("acro returns less where pixels are hidden", Contender("acro", clean=True), Contender("acro")),
    ReturnClaim("a memory pays: mik above acro", Contender("mik"), Contender("acro")),
    ReturnClaim("a memory pays: acro with a GRU above acro", Contender("acro", history="gru"), Contender("acro")),
    ReturnClaim("past actions pay: mik+a above mik", Contender("mik+a"), Contender("mik")),
    ReturnClaim("mik+a is above every other method", Contender("mik+a"), Contender()),
    ReturnClaim(
        "a memory costs nothing where nothing is hidden: mik+a not below acro",
        Contender("mik+a"),
        Contender("acro"),
        hidden=False,
        kind="not below",
    ),
    ReturnClaim(
        "what is left to a memory that was told the states",
        Contender("supervised+a"),
        Contender("mik+a"),
        kind="distance",
    ),
    ReturnClaim(
        "what is left to the states themselves", Contender("state", clean=True), Contender("mik+a"), kind="distance"
    ),
)


def judge_claims(runs: list[LoadedRun], unranked: Collection[tuple[str, ...]] = ()) -> list[Row]:
    """One row for every claim and setting of which both sides have finished runs, with its `verdict`.

    `difference` is the left side's mean return less the right one's, `error` its standard error over seeds.

    Args:
        runs: of a report.
        unranked: settings that do not discriminate: there nothing is judged.
    """
    finished = [run for run in runs if run.rows and run.finished and run.labels["method"] not in END_TO_END]
    settings = sorted({tuple(str(run.labels[name]) for name in SETTING) for run in finished})
    rows = (_row(claim, place, finished) for claim in CLAIMS for place in settings)
    return [row | {"verdict": _verdict(row, unranked)} for row in rows if row is not None]


def tally(rows: list[Row]) -> str:
    """What becomes of a claim over its settings: "holds in 1 of 2 settings; too few seeds in 1"."""
    if not rows[0]["verdict"]:
        return ""
    counts = {verdict: len(members) for (verdict,), members in grouped(rows, ("verdict",))}
    held = f"{HOLDS} in {counts.pop(HOLDS, 0)} of {len(rows)} setting{'s' * (len(rows) != 1)}"
    return "; ".join([held, *(f"{verdict} in {count}" for verdict, count in counts.items())])


def _row(claim: ReturnClaim, place: tuple[str, ...], runs: list[LoadedRun]) -> Row | None:
    task, quality, corruption, algorithm = place
    if claim.hidden == (corruption == "none"):
        return None
    alike = [run for run in runs if _at(run, task, quality, algorithm)]
    left = _runs_of(claim.left, claim.right, corruption, alike)
    right = _runs_of(claim.right, claim.left, corruption, alike)
    if not left or not right:
        return None
    above, error = difference(left, right)
    named = {"claim": claim.text, "kind": claim.kind} | dict(zip(SETTING, place, strict=True))
    return named | {
        **{"left": _name(left), "left_return": float(returns_of(left).mean()), "left_seeds": len(left)},
        **{"right": _name(right), "right_return": float(returns_of(right).mean()), "right_seeds": len(right)},
        **{"difference": above, "error": error},
    }


def _at(run: LoadedRun, *place: str) -> bool:
    return tuple(run.labels[name] for name in ("task", "quality", "algorithm")) == place


def _runs_of(side: Contender, other: Contender, corruption: str, runs: Iterable[LoadedRun]) -> list[LoadedRun]:
    """Seeds of one side: of the variant that has two of them, and returns most."""
    seen = seen_under("none" if side.clean else corruption, runs)
    if side.method:
        return as_it_is(side.method, seen, side.history)
    return best_of(run for run in seen if run.labels["method"] not in (other.method, *REFERENCES))


def _name(runs: list[LoadedRun]) -> str:
    return label(runs[0].labels | {"variant": runs[0].variant})


def _verdict(row: Row, unranked: Collection[tuple[str, ...]]) -> str:
    if row["kind"] == "distance":
        return ""
    if tuple(row[name] for name in SETTING) in unranked:
        return f"not judged: the setting {FAILED}"
    if row["error"] is None:
        return FEW
    margin = STANDARD_ERRORS * row["error"]
    if row["difference"] < -margin:
        return FAILS
    return HOLDS if row["kind"] == "not below" or row["difference"] > margin else OPEN
