"""Make the tables of results/protocol/README.md from the rows there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter

import numpy as np
from earlier_table import CLEAN, mean_text

from vd4rl_pomdp.core.text import table_lines
from vd4rl_pomdp.report.gates import (
    EXPLORATORY,
    PRIMARY,
    UNJUDGED,
    episodes_of,
    gates,
    judge_claims,
    opposite,
    unranked,
)
from vd4rl_pomdp.report.load import PROBES, Run, label
from vd4rl_pomdp.report.stats import number, with_interval
from vd4rl_pomdp.runs.files import groups


def place_of(run: Run) -> tuple[str, str, str, int]:
    """Task, quality, corruption and updates."""
    task, quality, corruption = run.of(("task", "quality", "corruption"))
    return task, quality, corruption, int(run.settings["updates"])


def setting(place: Iterable[str], updates: int) -> str:
    """Such as "walker_walk, medium_expert, patch, 60,000 updates"."""
    return f"{', '.join(place)}, {updates:,} updates"


def method_lines(runs: Sequence[Run]) -> Iterator[str]:
    """One row per setting and method, by decreasing return: returns as trained and clean, probes and critics."""
    rows = []
    for (*place, updates), here in groups(runs, place_of).items():
        by_method = groups(here, called)
        for name, mine in sorted(by_method.items(), key=lambda item: -episodes_of(item[1]).mean()):
            clean = number(None) if place[2] == CLEAN else _of_seeds(episodes_of(mine, clean=True))
            probes = ", ".join(f"{np.mean([run.measures[probe] for run in mine]):.0f}" for probe in PROBES)
            moved = 100 * np.max(np.abs(np.array([run.measures["critic_moved"] for run in mine], dtype=float)))
            cells = _of_seeds(episodes_of(mine)), clean, probes, f"{moved:.2f}%"
            rows.append((setting(place, updates), f"`{name}`", len(mine), *cells))
    head = ("setting", "method", "n", "return", "evaluated clean", "probe: pose, velocity", "critic moved at most")
    return table_lines(head, rows, (0, 1))


def _of_seeds(returns: np.ndarray) -> str:
    """Mean and interval of (seeds, episodes) returns; of two seeds, whose interval says little, both means."""
    if len(returns) != 2:
        return mean_text(returns)
    return f"{returns.mean():.0f} ({', '.join(f'{seed:.0f}' for seed in returns.mean(1))})"


GRU = "acro, history gru"
"""`acro` with a GRU. With a shared shift, as in all grids, it is the paper's AH."""
PAIRS = (("mik", "acro"), (GRU, "acro"), ("mik+a", "mik"), ("mik+a", "acro"), ("mik+a", GRU))


def called(run: Run) -> str:
    """A run's method or GRU, whatever its budget."""
    return GRU if run.method == "acro" and run.settings.get("history") == "gru" else run.method


def paired_lines(runs: Sequence[Run]) -> Iterator[str]:
    """Differences paired by training seed, since methods share its dataset; where three seeds were evaluated clean."""
    rows = []
    for (*place, updates), here in groups(runs, place_of).items():
        by_method = groups((run for run in here if run.last_clean), called)
        by_seed = {name: {run.labels["seed"]: run for run in mine} for name, mine in by_method.items()}
        for names in PAIRS:
            left, right = (by_seed.get(name, {}) for name in names)
            if len(seeds := sorted(left.keys() & right.keys())) >= 3:
                trained, clean = (
                    episodes_of([left[seed] for seed in seeds], kind)
                    - episodes_of([right[seed] for seed in seeds], kind)
                    for kind in (False, True)
                )
                change = trained.mean(1, keepdims=True) - clean.mean(1, keepdims=True)
                cells = mean_text(trained), mean_text(clean), mean_text(change)
                rows.append((setting(place, updates), f"`{names[0]}` minus `{names[1]}`", len(seeds), *cells))
    return table_lines(("setting", "contrast", "n", "as trained", "clean", "as trained minus clean"), rows, (0, 1))


SECOND_BUDGETS = ("finetune.updates=120000", "finetune.updates=160000")
"""Changes of the grid for twice the updates: the walker's, the cheetah's."""
LEAST_SEEDS = 4
"""Seeds of both methods of a primary contrast, of five, without which it is not judged."""


def contrast_lines(runs: Sequence[Run]) -> Iterator[str]:
    """The contrasts that the protocol tests, with Holm's p values and verdicts; one row per budget."""
    found = []
    for row in judge_claims(list(runs), unranked(gates(list(runs)))):
        few = row["family"] == PRIMARY and min(row["left_seeds"], row["right_seeds"]) < LEAST_SEEDS
        if row["family"] not in ("", EXPLORATORY):
            verdict = row["verdict"]
            other = f", {verdict.removeprefix(UNJUDGED)}" * verdict.startswith(UNJUDGED)
            found.append(row | {"verdict": f"{UNJUDGED}missing seeds{other}" if few else verdict})
    place = itemgetter("claim", "task", "quality", "corruption")
    rows, same_claim = [], groups(found, place)
    labelled = {(*place_of(run)[:3], label(run.named)): run for run in runs}
    for row in found:
        shown, clean = (
            with_interval(row[f"{kind}difference"], row[f"{kind}low"], row[f"{kind}high"], 0) for kind in ("", "clean_")
        )
        share = f" ({100 * row['smallest_share']:.0f}%)" if row["smallest_share"] else ""
        notes = ["opposite sign evaluated clean"] * opposite(row)
        judged = {other["verdict"] for other in same_claim[place(row)]}
        judged = {verdict for verdict in judged if not verdict.startswith(UNJUDGED)}
        notes += ["depends on the budget"] * (len(judged) > 1)
        _, *where = place(row)
        left, right = (labelled[*where, row[side]] for side in ("left", "right"))
        sides = f"`{called(left)}` minus `{called(right)}`"
        seeds = f"{row['left_seeds']}, {row['right_seeds']}"
        tested = number(row["adjusted_p"], 3), number(row["smallest"], 0) + share, "; ".join([row["verdict"], *notes])
        rows.append((setting(where, place_of(left)[-1]), sides, seeds, shown, clean, *tested))
    head = ("setting", "contrast", "n", "difference", "evaluated clean", "p (Holm)", "detectable", "verdict")
    return table_lines(head, rows, (0, 1, 7))
