"""What is measured, and of what: methods, conditions, measures, and the paper's numbers for them.

A number of a run is named by its `Condition`, its seed and its `Measure`; the fields of both are columns of every table
of runs.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from vd4rl_pomdp.envs.mazes import PAPER_MAZES

PAPER = Path(__file__).parent / "paper.csv"
"""The paper's numbers: one line a table row, one column a maze."""
RAW_PREFIX = "raw_"
"""Before an error's name: it is in the simulator's units x 100, which the paper's numbers seem to be."""

OBJECTIVES = ("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a")
UNTRAINED = "random"
WITH_MEMORY = ("supervised", "supervised+a")
SUPERVISED = ("supervised_picture", *WITH_MEMORY)
REFERENCES = (UNTRAINED, *SUPERVISED)
"""What a table is read against: mik+a's network untrained; no_history's, ah's and ah+a's trained on the true states."""
METHOD_NAMES = (*OBJECTIVES, *REFERENCES)
"""The paper's objectives, the floor and the ceilings."""


class Condition(NamedTuple):
    """What all seeds of an experiment share: what a run trains, without its seed and budget."""

    maze: str
    method: str
    max_k: int = 15
    self_prediction: bool = False
    exogenous: bool = False
    literal_future: bool = False

    @property
    def name(self) -> str:
        """What messages and files call it."""
        return f"{self.maze}/{self.short}"

    @property
    def short(self) -> str:
        """Its name without the maze."""
        words = {"sp": self.self_prediction, "exo": self.exogenous, "literal": self.literal_future}
        return "-".join([self.method, f"K{self.max_k}", *(word for word, told in words.items() if told)])


class Measure(NamedTuple):
    """Which number of a run this is; its fields are the columns that name a value in results.json and rows.csv."""

    measure: str
    """state_error, position_error or velocity_error (% of a standard deviation), the same after RAW_PREFIX, or
    action_loss (nats x 100)."""
    split: str
    """Trajectories: training or held_out."""
    probe: str
    """What estimated the states: online (trained beside the model) or refit; empty for an action loss."""
    rows: str = "all"
    """Rows that count: all, or hidden for those in which a curtain covers the mass."""
    k: int = 0
    """Pairs (t, t+k) that an action loss is over; 0 is the mean over all k, and stands in every error."""

    @property
    def is_raw(self) -> bool:
        """Whether it is an error in the simulator's units."""
        return self.measure.startswith(RAW_PREFIX)

    def raw(self) -> Measure:
        """The same error in the simulator's units x 100; an action loss is itself."""
        if self.is_raw or self.measure == "action_loss":
            return self
        return self._replace(measure=f"{RAW_PREFIX}{self.measure}")


def refitted_error(component: str, rows: str = "all") -> Measure:
    """Error (%) of a component (state, position or velocity) on held-out trajectories, by the refitted probe."""
    return Measure(f"{component}_error", "held_out", "refit", rows)


def online_error(component: str) -> Measure:
    """Error (%) of a component by the paper's protocol: training averages of the probe beside the model."""
    return Measure(f"{component}_error", "training", "online")


def held_out_loss(k: int = 0) -> Measure:
    """Action loss on held-out trajectories at one k, or over all k."""
    return Measure("action_loss", "held_out", "", k=k)


@cache
def paper_rows() -> list[dict[str, str]]:
    """The paper's tables, line by line."""
    with PAPER.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def condition_of(row: Mapping[str, str], maze: str) -> Condition:
    """The condition that a line of the paper's tables is about."""
    method = row["objective"].lower().replace(" ", "_")
    return Condition(maze, method, int(row["k_max"]), row["self_prediction"] == "Y", row["exogenous"] == "Y")


@cache
def _paper_numbers() -> dict[tuple[Condition, str], float]:
    """The paper's number for every condition, and the raw error or action loss that it is one of."""
    return {
        (condition_of(row, maze), what if what == "action_loss" else f"{RAW_PREFIX}{what}_error"): float(row[maze])
        for row in paper_rows()
        for what in (row["component"],)
        for maze in PAPER_MAZES
    }


def paper_number(condition: Condition, measure: Measure) -> float | None:
    """The paper's number for a condition of one of its own mazes and a measure in its units; None for all others."""
    if measure.k or measure.rows != "all":
        return None
    return _paper_numbers().get((condition, measure.measure))
