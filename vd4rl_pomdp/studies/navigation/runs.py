"""Finished navigation runs: read from run folders or results folders, and kept as a results folder."""

from __future__ import annotations

import csv
import io
import math
import shlex
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import build, read_bytes
from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.runs import TRAJECTORY_FILE
from vd4rl_pomdp.runs.files import write_csv
from vd4rl_pomdp.runs.results import Result, find_results, refuse_loss, write_results
from vd4rl_pomdp.studies.navigation.grid import Condition
from vd4rl_pomdp.studies.navigation.measures import Measure, measure_of, measure_rows
from vd4rl_pomdp.studies.navigation.sets import PRESETS

ROWS, TRAJECTORIES = "rows.csv", "trajectories"

_IDENTITY = (*(field.name for field in fields(Condition)), "preset", "seed")
_MEASURED = (*Measure._fields, "value")
_DRAWN = ("x", "y", "estimated_x", "estimated_y")
"""Columns of a trajectory that figures and films draw."""


@dataclass(frozen=True)
class NavigationRun:
    """One finished run."""

    result: Result
    """Its files."""
    condition: Condition
    preset: str
    seed: int
    values: dict[Measure, float]
    facts: dict[str, str]
    """Its provenance: steps, seconds, data, machine, command."""
    trajectory: Path | None
    """A held-out trajectory with estimated states."""

    @property
    def identity(self) -> dict[str, Any]:
        """What tells this run from others."""
        told = {k: int(v) if isinstance(v, bool) else v for k, v in asdict(self.condition).items()}
        return told | {"preset": self.preset, "seed": self.seed}

    @property
    def collection(self) -> dict[str, Any]:
        """How its set was made, by setting of `MazeCollectConfig`; {} if nothing whole tells.

        Early runs, which do not tell, took their preset's.
        """
        usual = asdict(PRESETS[self.preset])
        sizes = {name: usual[name] for name in ("trajectories", "trajectory_rows")}
        told = self.result.record.get("collection", sizes) or {}
        kept = {name: value for name, value in told.items() if name in usual and type(value) is type(usual[name])}
        return kept if sizes.keys() <= kept.keys() else {}

    @property
    def file_name(self) -> str:
        """Name of its trajectory beside the CSV files."""
        return f"{self.condition.name.replace('/', '-')}-seed{self.seed}.csv"


def read_trajectory(path: Path) -> dict[str, np.ndarray]:
    """Columns of a run's trajectory.csv by name, each (T,) float64; raises UserError for a file that is none."""
    try:
        rows = list(csv.DictReader(io.StringIO(read_bytes(path).decode(), newline="")))
        table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
        if missing := [name for name in _DRAWN if name not in table]:
            raise ValueError(f"it has no {', '.join(missing)}")
        return table
    except UserError:
        raise
    except (FileNotFoundError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: is no trajectory of a run ({error}); train the run again") from error


def flags_of(command: str) -> dict[str, str]:
    """Flags of a command line by field name: "--max-k 1 --k-embedding" is {"max_k": "1", "k_embedding": "yes"}.

    Numbers are written in one way, so that 1 and 1.0 agree.
    """
    flags: dict[str, str] = {}
    name = ""
    for word in _split(command):
        if word.startswith("--"):
            flag, _, value = word[2:].partition("=")
            name = flag.replace("-", "_")
            flags[name] = _number(value) if value else "yes"
        elif name:
            flags[name] = _number(word)
    return flags


def _split(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError as error:
        raise UserError(f"a run's command is damaged ({error}): {command}") from error


def _number(word: str) -> str:
    try:
        return f"{float(word):g}"
    except ValueError:
        return word


def find_navigation(sources: Sequence[Path], but: Path | None = None) -> list[Result]:
    """Runs of `navigation train` at or below some paths, finished or not; `but` and errors as in `find_results`."""
    return [result for result in find_results(sources, but) if result.record["stage"] == "navigation"]


def load_runs(results: Sequence[Result]) -> list[NavigationRun]:
    """The finished ones among some runs, in order.

    Raises:
        UserError: none is finished, one is damaged, two results are of the same run, seeds of one condition differ in
            their steps, data or settings, or a value is not finite.
    """
    runs: dict[tuple[Any, ...], NavigationRun] = {}
    for run in (_read_run(result) for result in results if result.finished):
        other = runs.setdefault(tuple(run.identity.values()), run)
        if other is not run:
            places = f"{other.result.path} and {run.result.path}"
            raise UserError(f"{places}: {run.condition.name} seed {run.seed} is there twice; keep one")
    if not runs:
        raise UserError("no finished run of `vd4rl-pomdp navigation train` is there; name folders of some")
    presets = sorted({run.preset for run in runs.values()})
    if len(presets) > 1:
        raise UserError(f"runs of different presets ({', '.join(presets)}) do not make one table; report them apart")
    _refuse_mixtures(runs.values())
    return sorted(runs.values(), key=lambda run: tuple(run.identity.values()))


def comparable(runs: Sequence[NavigationRun]) -> list[dict[str, str]]:
    """Steps, data, and the settings that change results and are no part of a condition, run by run.

    Those of their configs if all have whole ones. The flags of their commands else: early runs kept no more, and a
    setting that none names is "the preset's". Exogenous images are told by their content, where it is known.
    """
    whole = all("format" in run.result.record for run in runs)
    told = [run.result.record["config"] if whole else flags_of(run.facts["command"]) for run in runs]
    names = {} if whole else dict.fromkeys((name for one in told for name in one), "the preset's")
    found = [{name: str(value) for name, value in settings_of(names | one).items()} for one in told]
    told_apart = {"method", "max_k", "literal_future", "preset"}
    facts = [{name: run.facts[name] for name in ("steps", "set")} | _images(run) for run in runs]
    return [
        {k: v for k, v in one.items() if k not in told_apart} | fact for one, fact in zip(found, facts, strict=True)
    ]


def _images(run: NavigationRun) -> dict[str, str]:
    inputs = run.result.record.get("inputs", {})
    return {"exogenous": inputs["exogenous"]} if "exogenous" in inputs else {}


def is_missing(condition: Condition, runs: Iterable[NavigationRun]) -> bool:
    """Whether a condition has no run, although its maze has runs and the same condition has some in another maze."""
    conditions = {run.condition for run in runs}
    return (
        condition not in conditions
        and any(other.maze == condition.maze for other in conditions)
        and any(replace(other, maze=condition.maze) == condition for other in conditions)
    )


def progress(result: Result) -> str:
    """How far an unfinished run is: "at 10 of 30 steps"."""
    return f"at {result.step} of {result.record['config'].get('steps', '?')} steps"


def _refuse_mixtures(runs: Iterable[NavigationRun]) -> None:
    """Seeds of one condition make a mean only if they had the same budget, data and settings."""
    first: dict[Condition, NavigationRun] = {}
    for run in runs:
        other = first.setdefault(run.condition, run)
        others, mine = comparable([other, run])
        for name in dict.fromkeys((*others, *mine)):
            values = [settings.get(name, "none") for settings in (others, mine)]
            if values[0] != values[1]:
                raise UserError(
                    f"{run.condition.name}: seeds {other.seed} and {run.seed} differ in their {name} "
                    f"({', '.join(values)}) and make no mean; report them apart"
                )


def save_runs(runs: list[NavigationRun], out: Path) -> None:
    """Write runs as a results folder, from which the report can be made again, with their `trajectories/`.

    Beside it, `rows.csv` has every value for whoever wants to read them as a table.
    """
    results = [run.result for run in runs]
    refuse_loss(results, out)
    write_results(out, results)
    rows = [run.identity | row | {"value": f"{row['value']:.6g}"} for run in runs for row in measure_rows(run.values)]
    write_csv(out / ROWS, (*_IDENTITY, *_MEASURED), rows)
    (out / TRAJECTORIES).mkdir(exist_ok=True)
    for run in runs:
        target = out / TRAJECTORIES / run.file_name
        if run.trajectory is not None and run.trajectory.resolve() != target.resolve():
            shutil.copyfile(run.trajectory, target)


def _read_run(result: Result) -> NavigationRun:
    try:
        return _with_trajectory(_run_of(result))
    except UserError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{result.place}: its results are damaged ({error}); train it again") from error


def _run_of(result: Result) -> NavigationRun:
    record, results, timing = result.record, result.files["results"], result.files["timing"]
    config = record["config"]
    named = {
        "maze": results["maze"],
        "method": config["method"],
        "exogenous": config["exogenous"] != "none",
        "max_k": config.get("max_k", 1),  # these three are options of some methods alone
        "self_prediction": config.get("self_prediction", 0.0) > 0,
        "literal_future": config.get("literal_future", False),
    }
    for name, value, known in (("maze", results["maze"], MAZES), ("preset", config["preset"], PRESETS)):
        if value not in known:
            raise ValueError(f"its {name} is {value!r}")
    if not results["rows"]:
        raise ValueError("it has measured nothing")
    condition = build(Condition, named)
    if not all(isinstance(timing[name], int | float) for name in ("steps", "seconds")):
        raise TypeError("timing.json holds no numbers")
    facts: dict[str, Any] = {
        "steps": timing["steps"],
        "seconds": timing["seconds"],
        "set": results["set"],
        "machine": result.machine,
        "command": results.get("command", record["command"]),
    }
    values = {measure_of(row): _finite(result.place, row, f"{row['value']:.6g}") for row in results["rows"]}
    told = {name: str(fact) for name, fact in facts.items()}
    return NavigationRun(result, condition, config["preset"], config["seed"], values, told, None)


def _with_trajectory(run: NavigationRun) -> NavigationRun:
    """A run with its trajectory: a run folder has one, a results folder may have it."""
    folder = run.result.path
    path = folder / TRAJECTORY_FILE if run.result.folder else folder / TRAJECTORIES / run.file_name
    if path.is_file():
        return replace(run, trajectory=path)
    if run.result.folder:
        raise UserError(f"{path}: is missing or no file; train it again")
    return run


def _finite(place: str, row: dict[str, Any], value: str) -> float:
    if not math.isfinite(float(value)):
        raise UserError(f"{place}: a {row['measure']} is {value}: the run has diverged; train it again or leave it out")
    return float(value)
