"""Methods, conditions and measures of the navigation study, and the paper's numbers.

A number of a run is identified by its `Condition`, its seed and its `Measure`; the fields of both are columns of every
table of runs.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from vd4rl_pomdp.envs.mazes import PAPER_MAZES

PAPER = Path(__file__).parent / "paper.csv"
"""The paper's numbers: a row per table row, a column per maze."""
RAW_PREFIX = "raw_"
"""Prefix of errors in the simulator's units x 100, which the paper's numbers seem to be."""

OBJECTIVES = ("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a")
UNTRAINED = "random"
WITH_MEMORY = ("supervised", "supervised+a")
SUPERVISED = ("supervised_picture", *WITH_MEMORY)
REFERENCES = (UNTRAINED, *SUPERVISED)
"""Reference methods: mik+a's network untrained; no_history's, ah's and ah+a's trained on the true states."""
METHOD_NAMES = (*OBJECTIVES, *REFERENCES)
"""The paper's objectives and the references."""


class Condition(NamedTuple):
    """What all seeds of an experiment share: maze, method and options, without seed and budget."""

    maze: str
    method: str
    max_k: int = 15
    self_prediction: bool = False
    exogenous: bool = False
    literal_future: bool = False

    @property
    def name(self) -> str:
        """Name for messages and files."""
        return f"{self.maze}/{self.short}"

    @property
    def short(self) -> str:
        """Name without the maze."""
        words = {"sp": self.self_prediction, "exo": self.exogenous, "literal": self.literal_future}
        return "-".join([self.method, f"K{self.max_k}", *(word for word, told in words.items() if told)])


class Measure(NamedTuple):
    """Identifies a number of a run; the fields are columns of results.json and rows.csv."""

    measure: str
    """state_error, position_error or velocity_error (% of a standard deviation), the same after RAW_PREFIX, or
    action_loss (nats x 100)."""
    split: str
    """Split of the trajectories: training or held_out."""
    probe: str
    """Probe of the states: online (trained beside the model) or refit; empty for an action loss."""
    rows: str = "all"
    """Rows that count: all, or hidden (a curtain covers the mass)."""
    k: int = 0
    """Gap k of the pairs (t, t+k) of an action loss; 0 is the mean over all k, and the value for errors."""

    @property
    def is_raw(self) -> bool:
        """Whether it is an error in the simulator's units."""
        return self.measure.startswith(RAW_PREFIX)

    def raw(self) -> Measure:
        """The same error in the simulator's units x 100; action losses are unchanged."""
        if self.is_raw or self.measure == "action_loss":
            return self
        return self._replace(measure=f"{RAW_PREFIX}{self.measure}")


def refitted_error(component: str, rows: str = "all") -> Measure:
    """Error (%) of a component (state, position or velocity) on held-out trajectories by the refitted probe."""
    return Measure(f"{component}_error", "held_out", "refit", rows)


def online_error(component: str) -> Measure:
    """Error (%) of a component by the paper's protocol: training averages of the online probe."""
    return Measure(f"{component}_error", "training", "online")


def held_out_loss(k: int = 0) -> Measure:
    """Action loss on held-out trajectories at one k, or over all k."""
    return Measure("action_loss", "held_out", "", k=k)


@cache
def paper_rows() -> list[dict[str, str]]:
    """Rows of the paper's tables."""
    with PAPER.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def condition_of(row: Mapping[str, str], maze: str) -> Condition:
    """The condition of a row of the paper's tables."""
    method = row["objective"].lower().replace(" ", "_")
    return Condition(maze, method, int(row["k_max"]), row["self_prediction"] == "Y", row["exogenous"] == "Y")


@cache
def _paper_numbers() -> dict[tuple[Condition, str], float]:
    """The paper's numbers by condition and measure name (a raw error or the action loss)."""
    return {
        (condition_of(row, maze), what if what == "action_loss" else f"{RAW_PREFIX}{what}_error"): float(row[maze])
        for row in paper_rows()
        for what in (row["component"],)
        for maze in PAPER_MAZES
    }


def paper_number(condition: Condition, measure: Measure) -> float | None:
    """The paper's number for a condition and a measure in its units; None if it has none."""
    if measure.k or measure.rows != "all":
        return None
    return _paper_numbers().get((condition, measure.measure))
