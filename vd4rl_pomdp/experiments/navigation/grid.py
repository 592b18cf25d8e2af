"""Which runs make the paper's tables: their conditions, and the command that trains each."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vd4rl_pomdp.errors import MAX_SEED, UserError, refuse_number
from vd4rl_pomdp.mazes import check_maze
from vd4rl_pomdp.navigation.config import PRESETS
from vd4rl_pomdp.navigation.methods import OBJECTIVES, SUPERVISED, UNTRAINED

PAPER = Path(__file__).parent / "paper.csv"
"""The paper's numbers: one line a table row, one column a maze."""
EVIDENCE_MAZES = ("no_curtain", "three_curtains")


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
        """Folder of the condition's runs."""
        parts = [self.method, f"K{self.max_k}"]
        for flag, short in (("self_prediction", "sp"), ("exogenous", "exo"), ("literal_future", "literal")):
            parts += [short] if getattr(self, flag) else []
        return f"{self.maze}/{'-'.join(parts)}"

    def words(self, preset: str, data: Path, runs: Path, seed: int) -> list[str]:
        """Words of the command that trains it, after `vd4rl-pomdp`."""
        words = ["navigation", "train", "--preset", preset, "--data", str(data / self.maze), "--method", self.method]
        words += ["--max-k", str(self.max_k), "--seed", str(seed)]
        words += ["--self-prediction", "1.0"] if self.self_prediction else []
        words += ["--exogenous", "photographs"] if self.exogenous else []
        words += ["--literal-future"] if self.literal_future else []
        return [*words, "--out", str(runs / self.name / f"seed{seed}")]


def evidence(mazes: tuple[str, ...] = EVIDENCE_MAZES) -> list[Condition]:
    """The first evidence: all objectives and references at K = 15, and what K = 1 does to those that read actions."""
    conditions = [Condition(maze, method) for maze in mazes for method in ("mik+a", "ah+a", "no_history", UNTRAINED)]
    conditions += [Condition(maze, method, 1) for maze in mazes for method in ("ah+a", "mik+a")]
    conditions += [Condition(maze, "mik+a", 1, literal_future=True) for maze in mazes]
    return conditions + [
        Condition(maze, method) for maze in mazes for method in ("mik", "ah", "fj+a", "fj", *SUPERVISED)
    ]


def options(mazes: tuple[str, ...] = EVIDENCE_MAZES) -> list[Condition]:
    """Self-prediction and exogenous noise, for all objectives."""
    conditions = [Condition(maze, method, self_prediction=True) for maze in mazes for method in reversed(OBJECTIVES)]
    return conditions + [Condition(maze, method, exogenous=True) for maze in mazes for method in reversed(OBJECTIVES)]


def paper(mazes: tuple[str, ...]) -> list[Condition]:
    """Every condition in the paper's tables."""
    return list(dict.fromkeys(condition_of(row, maze) for maze in mazes for row in paper_rows()))


GRIDS = {"evidence": evidence, "options": options, "paper": paper}


def grid_commands(
    grid: str, mazes: tuple[str, ...], seeds: tuple[int, ...], preset: str, data: Path, runs: Path
) -> Iterator[list[str]]:
    """Words of all runs of a grid, seed by seed, so that every condition has its first seed early."""
    if grid not in GRIDS:
        raise UserError(f"unknown grid {grid!r}: choose one of {', '.join(GRIDS)}")
    if preset not in PRESETS:
        raise UserError(f"unknown preset {preset!r}: choose one of {', '.join(PRESETS)}")
    for maze in mazes:
        check_maze(maze)
    for seed in seeds:
        refuse_number("seeds", seed, 0, MAX_SEED)
    for seed in seeds:
        for condition in GRIDS[grid](mazes):
            yield condition.words(preset, data, runs, seed)


def paper_rows() -> list[dict[str, str]]:
    """The paper's tables, line by line."""
    with PAPER.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def condition_of(row: dict[str, str], maze: str) -> Condition:
    """The condition that a line of the paper's tables is about."""
    method = row["objective"].lower().replace(" ", "_")
    return Condition(maze, method, int(row["k_max"]), row["self_prediction"] == "Y", row["exogenous"] == "Y")
