"""What MIK+A leads by against the budget of pretraining: does a larger one bring what a smaller one does not show?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.gates import GATED, as_it_is, comparable, episodes_of, sides
from vd4rl_pomdp.report.load import Run
from vd4rl_pomdp.runs.files import Row, groups

LEADER, OTHER = "mik+a", "acro"
OTHERS = {"mik+a less acro": "method", "mik+a less acro with a GRU": "gru"}
"""What stands against it, by the differences' names: the other method's `--history`."""


class Budget(NamedTuple):
    """Of a pretraining."""

    steps: int
    stacks: int
    """In a batch."""


class PolicyBudget(NamedTuple):
    """Of a fine-tuning."""

    updates: int
    units: int
    """Of a hidden layer."""


def leads(runs: list[Run]) -> list[Row]:
    """One row for every setting, policy's budget, difference and pretraining's budget.

    Only where these methods have at least two budgets of pretraining, and each a run. `difference` is the leader's mean
    return less the other method's, every run's in % of the mean return of its own data; `low` and `high` are the ends
    of its 95% interval over seeds and episodes. It is of runs of like settings; where there are none, it is None.
    `left_seeds` and `right_seeds` count both sides' seeds, whether they can be compared or not.
    """
    finished = [run for run in comparable(runs) if (run.reference.data_return or 0) > 0]
    sides_of = [as_it_is(LEADER, finished), *(as_it_is(OTHER, finished, history) for history in OTHERS.values())]
    known = [(run, *budgets) for side in sides_of for run in side if (budgets := _budgets(run))]
    rows: list[Row] = []
    for (place, policy), here in sorted(groups(known, lambda one: (one[0].of(GATED), one[1])).items()):
        by_budget, everyone = groups(here, lambda one: one[2]), [run for run, *_ in here]
        for name, history in OTHERS.items():
            if len(by_budget) < 2 or not (as_it_is(LEADER, everyone) and as_it_is(OTHER, everyone, history)):
                continue
            for budget in sorted(by_budget, key=lambda one: one.steps * one.stacks):
                row = dict(zip(GATED, place, strict=True)) | {"method": name, "variant": ""}
                row |= policy._asdict() | budget._asdict()
                rows.append(row | _lead([run for run, *_ in by_budget[budget]], history))
    if len({(row["updates"], row["units"]) for row in rows}) > 1:
        for row in rows:
            row["variant"] = f"{row['updates']:,} updates of {row['units']:,} units"
    return rows


def _budgets(run: Run) -> tuple[PolicyBudget, Budget] | None:
    """Of a run's policy and of its encoder, if they are recorded."""
    own, card = run.record["config"], run.result.card
    before = card.get("settings") or {}
    if not ({"updates", "hidden_dim"} <= own.keys() and "steps" in card and {"batch_size", "window"} <= before.keys()):
        return None
    policy = PolicyBudget(own["updates"], own["hidden_dim"])
    return policy, Budget(card["steps"], before["batch_size"] * before["window"])


def _lead(runs: list[Run], history: str) -> Row:
    """The difference among runs of one budget."""
    both = as_it_is(LEADER, runs), as_it_is(OTHER, runs, history)
    compared = sides(*both)
    difference, ends = None, None
    if compared.left and not compared.unlike:
        both = compared.left, compared.right
        left, right = (100 * episodes_of(side) / _data_of(side) for side in both)
        difference, ends = float(left.mean() - right.mean()), stats.difference_interval(left, right)
    low, high = ends or (None, None)
    seeds = [len({run.labels["seed"] for run in side}) for side in both]
    row: Row = {"difference": difference, "low": low, "high": high}
    return row | {"seeds": 0 if difference is None else min(seeds), "left_seeds": seeds[0], "right_seeds": seeds[1]}


def _data_of(runs: list[Run]) -> np.ndarray:
    """Mean returns of the data of some runs, (runs, 1)."""
    return np.array([[run.reference.data_return] for run in runs], dtype=float)
