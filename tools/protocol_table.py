"""Make the tables of results/protocol/README.md from the rows there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from offline_table import CLEAN, mean_text

from vd4rl_pomdp.core.text import table_lines
from vd4rl_pomdp.report.gates import EXPLORATORY, PRIMARY, UNJUDGED, episodes_of, gates, judge_claims, unranked
from vd4rl_pomdp.report.load import PROBES, Run, label
from vd4rl_pomdp.report.stats import number, with_interval
from vd4rl_pomdp.runs.files import groups


def method_lines(runs: Sequence[Run]) -> Iterator[str]:
    """One row per setting and method, by decreasing return: returns as trained and clean, probes and critics."""
    rows = []
    for place, here in groups(runs, lambda run: run.of(("task", "quality", "corruption"))).items():
        by_method = groups(here, lambda run: label(run.named))
        for name, mine in sorted(by_method.items(), key=lambda item: -episodes_of(item[1]).mean()):
            clean = number(None) if place[2] == CLEAN else mean_text(episodes_of(mine, clean=True))
            probes = ", ".join(f"{np.mean([run.measures[probe] for run in mine]):.0f}" for probe in PROBES)
            moved = 100 * np.max(np.abs(np.array([run.measures["critic_moved"] for run in mine], dtype=float)))
            cells = mean_text(episodes_of(mine)), clean, probes, f"{moved:.2f}%"
            rows.append((", ".join(place), f"`{name}`", len(mine), *cells))
    head = ("setting", "method", "n", "return", "evaluated clean", "probe: pose, velocity", "critic moved at most")
    return table_lines(head, rows, (0, 1))


LEAST_SEEDS = 4
"""Seeds of both methods of a primary contrast, of five, without which it is not judged."""


def contrast_lines(runs: Sequence[Run]) -> Iterator[str]:
    """The contrasts that the protocol tests, with Holm's p values and verdicts."""
    rows = []
    for row in judge_claims(list(runs), unranked(gates(list(runs)))):
        if row["family"] in ("", EXPLORATORY):
            continue
        found, clean = (
            with_interval(row[f"{kind}difference"], row[f"{kind}low"], row[f"{kind}high"], 0) for kind in ("", "clean_")
        )
        setting = ", ".join(row[name] for name in ("task", "quality", "corruption"))
        sides = f"`{row['left']}` minus `{row['right']}`"
        seeds = row["left_seeds"], row["right_seeds"]
        few = row["family"] == PRIMARY and min(seeds) < LEAST_SEEDS
        verdict = f"{UNJUDGED}missing seeds" if few else row["verdict"]
        tested = (number(row["adjusted_p"], 3), number(row["smallest"], 0), verdict)
        rows.append((setting, sides, ", ".join(map(str, seeds)), found, clean, *tested))
    head = ("setting", "contrast", "n", "difference", "evaluated clean", "p (Holm)", "detectable", "verdict")
    return table_lines(head, rows, (0, 1, 7))
