"""Finished navigation runs: read from run and results folders, as one tidy frame, and saved as a results folder."""

from __future__ import annotations

import csv
import io
import math
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.runs import TRAJECTORY_FILE
from vd4rl_pomdp.runs.files import write_csv
from vd4rl_pomdp.runs.results import Result, find_results, refuse_loss, write_results
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.measures import UNTRAINED, Condition, Measure

ROWS, TRAJECTORIES = "rows.csv", "trajectories"
KEYS = [*Condition._fields, *Measure._fields]
"""Columns that identify a number; means are over seeds."""
COLUMNS = [*Condition._fields, "preset", "seed", *Measure._fields, "value"]
"""Columns of the frame of runs and of rows.csv."""
_DRAWN = ("x", "y", "estimated_x", "estimated_y")
"""Columns of a trajectory for figures and videos."""


@dataclass(frozen=True)
class NavigationRun:
    """One finished run."""

    result: Result
    """Its files."""
    condition: Condition
    values: dict[Measure, float]
    """Values rounded to six digits, as in the tables."""

    @property
    def preset(self) -> str:
        """Its training preset."""
        return self.result.record["config"]["preset"]

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.result.record["config"]["seed"]

    @property
    def identity(self) -> tuple[Any, ...]:
        """Identifies this run."""
        return (*self.condition, self.preset, self.seed)

    @property
    def settings(self) -> dict[str, str]:
        """Steps, dataset, and settings that change results but are not part of the condition.

        Exogenous images are identified by content. Settings without effect on an untrained network are left out.
        """
        record, results = self.result.record, self.result.files["results"]
        told = settings_of(record["config"]) | {"steps": self.result.files["timing"]["steps"], "set": results["set"]}
        if "exogenous" in record.get("inputs", {}):
            told["exogenous"] = record["inputs"]["exogenous"]
        left_out = {"method", "max_k", "literal_future", "preset", "steps" * (self.condition.method == UNTRAINED)}
        return {name: str(value) for name, value in told.items() if name not in left_out}

    @property
    def file_name(self) -> str:
        """File name of its trajectory in a results folder."""
        return f"{self.condition.name.replace('/', '-')}-seed{self.seed}.csv"

    @property
    def trajectory(self) -> Path | None:
        """A held-out trajectory with estimated states; run folders have one, results folders may."""
        folder = self.result.path
        path = folder / TRAJECTORY_FILE if self.result.folder else folder / TRAJECTORIES / self.file_name
        return path if path.is_file() else None


def read_trajectory(path: Path) -> dict[str, np.ndarray]:
    """Columns of a run's trajectory.csv by name, (T,) float64 each; UserError for an invalid file."""
    try:
        rows = list(csv.DictReader(io.StringIO(read_bytes(path).decode(), newline="")))
        table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
        if missing := [name for name in _DRAWN if name not in table]:
            raise ValueError(f"it has no {', '.join(missing)}")
        return table
    except UserError:
        raise
    except (FileNotFoundError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: is not a trajectory of a run ({error}); train the run again") from error


def find_navigation(sources: Sequence[Path], but: Path | None = None) -> list[Result]:
    """Runs of `navigation train` at or below some paths, finished or not; `but` and errors as in `find_results`."""
    return [result for result in find_results(sources, but) if result.record["stage"] == "navigation"]


def load_runs(results: Iterable[Result]) -> list[NavigationRun]:
    """The finished runs, sorted.

    Raises:
        UserError: no run is finished, one is damaged, a run occurs twice, seeds of one condition differ in steps, data
            or settings, or a value is not finite.
    """
    runs = sorted((_read_run(result) for result in results if result.finished), key=lambda run: run.identity)
    if not runs:
        raise UserError("there is no finished run of `vd4rl-pomdp navigation train`; name folders that have one")
    presets = sorted({run.preset for run in runs})
    if len(presets) > 1:
        raise UserError(
            f"runs of different presets ({', '.join(presets)}) cannot share a table; report them separately"
        )
    first: dict[Condition, NavigationRun] = {}
    for before, run in zip([None, *runs], runs, strict=False):
        if before is not None and before.identity == run.identity:
            places = f"{before.result.path} and {run.result.path}"
            raise UserError(f"{places}: {run.condition.name} seed {run.seed} occurs twice; keep one")
        other = first.setdefault(run.condition, run)
        for name in {**other.settings, **run.settings}:
            values = [one.settings.get(name, "none") for one in (other, run)]
            if values[0] != values[1]:
                raise UserError(
                    f"{run.condition.name}: seeds {other.seed} and {run.seed} differ in their {name} "
                    f"({', '.join(values)}) and cannot be averaged; report them separately"
                )
    return runs


def _read_run(result: Result) -> NavigationRun:
    """Read a finished run; UserError if its files are damaged."""
    try:
        config, results, timing = result.record["config"], result.files["results"], result.files["timing"]
        if missing := sorted({"maze", "set", "command", "rows"} - results.keys()):
            raise ValueError(f"results.json has no {missing[0]}")
        for name, value, known in (
            ("maze", results["maze"], MAZES),
            ("preset", config["preset"], NavigationConfig.presets),
        ):
            if value not in known:
                raise ValueError(f"its {name} is {value!r}")
        if not results["rows"]:
            raise ValueError("it has no rows")
        if not all(isinstance(timing[name], int | float) for name in ("steps", "seconds")):
            raise TypeError("timing.json holds no numbers")
        condition = Condition(
            str(results["maze"]),
            str(config["method"]),
            int(config.get("max_k", 1)),  # only some methods have it, as with the other options
            config.get("self_prediction", 0.0) > 0,
            config["exogenous"] != "none",
            bool(config.get("literal_future", False)),
        )
        values = {
            Measure(row["measure"], row["split"], row["probe"], row["rows"], int(row["k"])): float(
                f"{row['value']:.6g}"
            )
            for row in results["rows"]
        }
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{result.place}: its results are damaged ({error}); train it again") from error
    if wrong := {measure.measure: value for measure, value in values.items() if not math.isfinite(value)}:
        name, value = next(iter(wrong.items()))
        raise UserError(f"{result.place}: a {name} is {value}: the run has diverged; train it again or leave it out")
    run = NavigationRun(result, condition, values)
    if result.folder and run.trajectory is None:
        raise UserError(f"{result.path / TRAJECTORY_FILE}: is missing or not a file; train it again")
    return run


def frame_of(runs: Iterable[NavigationRun]) -> pd.DataFrame:
    """Every number of some runs, one per row, with COLUMNS."""
    rows = ((*run.identity, *measure, value) for run in runs for measure, value in run.values.items())
    return pd.DataFrame(rows, columns=COLUMNS)


def conditions_of(frame: pd.DataFrame) -> set[Condition]:
    """The conditions with runs."""
    return {Condition(*row) for row in frame[list(Condition._fields)].drop_duplicates().itertuples(index=False)}


def is_missing(condition: Condition, trained: set[Condition]) -> bool:
    """Whether a condition has no run, although its maze has runs and another maze has runs of it."""
    return (
        condition not in trained
        and any(other.maze == condition.maze for other in trained)
        and any(other[1:] == condition[1:] for other in trained)
    )


def numbers_of(frame: pd.DataFrame) -> dict[tuple[Any, ...], dict[int, float]]:
    """Numbers by seed for each condition and measure, with key `(*condition, *measure)`."""
    found: dict[tuple[Any, ...], dict[int, float]] = {}
    keys = frame[KEYS].itertuples(index=False, name=None)
    for key, seed, value in zip(keys, frame["seed"], frame["value"], strict=True):
        found.setdefault(key, {})[seed] = value
    return found


def save_runs(runs: list[NavigationRun], out: Path) -> None:
    """Write runs as a results folder with `trajectories/`, from which the report can be rebuilt.

    `rows.csv` also has every value as a table.
    """
    results = [run.result for run in runs]
    refuse_loss(results, out)
    write_results(out, results)
    frame = frame_of(runs)
    switches = frame.select_dtypes(bool).astype(int)
    rows = frame.assign(**switches, value=[f"{value:.6g}" for value in frame["value"]])
    write_csv(out / ROWS, COLUMNS, rows.to_dict("records"))
    (out / TRAJECTORIES).mkdir(exist_ok=True)
    for run in runs:
        target = out / TRAJECTORIES / run.file_name
        if run.trajectory is not None and run.trajectory.resolve() != target.resolve():
            shutil.copyfile(run.trajectory, target)
