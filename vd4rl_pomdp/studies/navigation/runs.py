"""Methods, conditions and measures of the navigation study, the paper's numbers, and finished runs.

A number of a run is identified by its `Condition`, its seed and its `Measure`; the fields of both are columns of every
table of runs. Runs are read from run and results folders, as one tidy frame, and saved as a results folder.
"""

from __future__ import annotations

import csv
import io
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.core.reading import damaged, inside, read_bytes
from vd4rl_pomdp.envs.mazes import MAZES, PAPER_MAZES
from vd4rl_pomdp.runs import TRAJECTORY_FILE
from vd4rl_pomdp.runs.results import Result, find_results, refuse_loss, write_results

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
        return "-".join([self.method, f"K{self.max_k}", *(word for word, is_on in words.items() if is_on)])


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
    return None if measure.k or measure.rows != "all" else _paper_numbers().get((condition, measure.measure))


ROWS, TRAJECTORIES = "rows.csv", "trajectories"
Numbers = dict[tuple[Condition, Measure], dict[int, float]]
"""Numbers by seed for each condition and measure."""


@dataclass(frozen=True)
class NavigationRun:
    """One finished run."""

    result: Result
    """Its files."""
    condition: Condition
    preset: str
    seed: int
    settings: dict[str, str]
    """Steps, dataset, and settings that change results but are not part of the condition.

    Exogenous images are identified by content. Settings without effect on an untrained network are left out.
    """
    values: dict[Measure, float]
    """Values rounded to six digits, as in the tables."""

    @property
    def identity(self) -> tuple[Any, ...]:
        """Identifies this run."""
        return (*self.condition, self.preset, self.seed)

    @property
    def file_name(self) -> str:
        """File name of its trajectory in a results folder."""
        return f"{self.condition.name.replace('/', '-')}-seed{self.seed}.csv"

    @property
    def trajectory(self) -> Path | None:
        """A held-out trajectory with estimated states; run folders have one, results folders may."""
        folder = self.result.path
        path = folder / TRAJECTORY_FILE if self.result.folder else folder / TRAJECTORIES / self.file_name
        return inside(folder, path) if path.is_file() else None


def read_trajectory(path: Path) -> pd.DataFrame:
    """A run's trajectory.csv, float64; UserError for an invalid file."""
    with damaged(path, "is not a trajectory of a run", "train the run again"):
        table = pd.read_csv(io.BytesIO(read_bytes(path)), dtype=str).astype(float)  # as Python parses them
        if table[["x", "y", "estimated_x", "estimated_y"]].empty:
            raise ValueError("it has no rows")
    return table


def find_navigation(sources: Sequence[Path], but: Path | None = None) -> list[Result]:
    """Runs of `navigation train` at or below some paths, finished or not; `but` and errors as in `find_results`."""
    return [result for result in find_results(sources, but) if result.record["stage"] == "navigation"]


def load_runs(results: Iterable[Result]) -> list[NavigationRun]:
    """The finished runs, sorted.

    Raises:
        UserError: no run is finished, one is damaged or occurs twice, runs of one condition differ in steps, data
            or settings, or a value is not finite.
    """
    runs = sorted((_read_run(result) for result in results if result.finished), key=lambda run: run.identity)
    if not runs:
        raise UserError("there is no finished run of `vd4rl-pomdp navigation train`; name folders that have one")
    if len(presets := sorted({run.preset for run in runs})) > 1:
        names = ", ".join(presets)
        raise UserError(f"runs of different presets ({names}) cannot share a table; report them separately")
    first: dict[Condition, NavigationRun] = {}
    for run in runs:
        other = first.setdefault(run.condition, run)
        for name in {**other.settings, **run.settings}:
            values = [one.settings.get(name, "none") for one in (other, run)]
            if values[0] != values[1]:
                raise UserError(
                    f"{run.condition.name}: seeds {other.seed} and {run.seed} differ in their {name} "
                    f"({', '.join(values)}) and cannot be averaged; report them separately"
                )
    for before, run in pairwise(runs):
        if before.identity == run.identity:
            places = f"{before.result.path} and {run.result.path}"
            raise UserError(f"{places}: {run.condition.name} seed {run.seed} occurs twice; keep one")
    return runs


def _read_run(result: Result) -> NavigationRun:
    """Read a finished run; UserError if its files are damaged."""
    with damaged(result.place, "its results are damaged", "train it again"):
        config, results, timing = result.record["config"], result.files["results"], result.files["timing"]
        condition = Condition(
            MAZES[results["maze"]].name,
            str(config["method"]),
            int(config.get("max_k", 1)),  # only some methods have it, as with the other options
            config.get("self_prediction", 0.0) > 0,
            config["exogenous"] != "none",
            bool(config.get("literal_future", False)),
        )
        values = {
            Measure(*(row[name] for name in Measure._fields)): float(f"{row['value']:.6g}") for row in results["rows"]
        }
        settings = settings_of(config) | {"steps": int(timing["steps"]), "set": results["set"]}
        settings |= {name: value for name, value in result.record.get("inputs", {}).items() if name == "exogenous"}
        left_out = {"method", "max_k", "literal_future", "preset", "steps" * (condition.method == UNTRAINED)}
        settings = {name: str(value) for name, value in settings.items() if name not in left_out}
        run = NavigationRun(result, condition, config["preset"], int(config["seed"]), settings, values)
        _ = float(timing["seconds"]), result.record["command"]  # for the report
    for measure, value in values.items():
        if not math.isfinite(value):
            what = f"a {measure.measure} is {value}: the run has diverged"
            raise UserError(f"{result.place}: {what}; train it again or leave it out")
    if result.folder and run.trajectory is None:
        raise UserError(f"{result.path / TRAJECTORY_FILE}: is missing or not a file; train it again")
    return run


def is_missing(condition: Condition, trained: set[Condition]) -> bool:
    """Whether a condition has no run, although its maze has runs and another maze has runs of it."""
    return (
        condition not in trained
        and any(other.maze == condition.maze for other in trained)
        and any(other[1:] == condition[1:] for other in trained)
    )


def numbers_of(runs: Iterable[NavigationRun]) -> Numbers:
    """The numbers of some runs."""
    found: Numbers = {}
    for run in runs:
        for measure, value in run.values.items():
            found.setdefault((run.condition, measure), {})[run.seed] = value
    return found


def save_runs(runs: list[NavigationRun], out: Path) -> None:
    """Write runs as a results folder with `trajectories/`, from which the report can be rebuilt.

    `rows.csv` also has every value as a table.
    """
    results = [run.result for run in runs]
    refuse_loss(results, out)
    write_results(out, results)
    rows = ((*run.identity, *measure, f"{value:.6g}") for run in runs for measure, value in run.values.items())
    frame = pd.DataFrame(rows, columns=[*Condition._fields, "preset", "seed", *Measure._fields, "value"])
    switches = frame.select_dtypes(bool).astype(int)
    frame.assign(**switches).to_csv(out / ROWS, index=False, lineterminator="\n")
    (out / TRAJECTORIES).mkdir(exist_ok=True)
    for run in runs:
        target = out / TRAJECTORIES / run.file_name
        if run.trajectory is not None and run.trajectory.resolve() != target.resolve():
            shutil.copyfile(run.trajectory, target)
