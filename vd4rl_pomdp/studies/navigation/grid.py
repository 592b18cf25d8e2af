"""What the paper's tables are about, line by line. The runs behind them are the grid `navigation`."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

PAPER = Path(__file__).parent / "paper.csv"
"""The paper's numbers: one line a table row, one column a maze."""


@dataclass(frozen=True)
class Condition:
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
        parts = [self.method, f"K{self.max_k}"]
        for flag, word in (("self_prediction", "sp"), ("exogenous", "exo"), ("literal_future", "literal")):
            parts += [word] if getattr(self, flag) else []
        return "-".join(parts)


def paper_rows() -> list[dict[str, str]]:
    """The paper's tables, line by line."""
    with PAPER.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def condition_of(row: dict[str, str], maze: str) -> Condition:
    """The condition that a line of the paper's tables is about."""
    method = row["objective"].lower().replace(" ", "_")
    return Condition(maze, method, int(row["k_max"]), row["self_prediction"] == "Y", row["exogenous"] == "Y")
