"""Finished navigation runs: read from run folders or from a report's CSV files, and written as CSV files."""

from __future__ import annotations

import csv
import io
import math
import shlex
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.experiments.navigation.grid import Condition
from vd4rl_pomdp.navigation.measures import Measure, measure_of, measure_rows
from vd4rl_pomdp.runs.files import read_json, write_csv
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.reading import build, regular
from vd4rl_pomdp.runs.settings import settings_of

ROWS, RUNS, TRAJECTORIES = "rows.csv", "runs.csv", "trajectories"

_IDENTITY = ("maze", "method", "max_k", "self_prediction", "exogenous", "literal_future", "preset", "seed")
_MEASURED = (*Measure._fields, "value")
_FACTS = ("steps", "seconds", "set", "git_commit", "processor", "gpu", "command")


@dataclass(frozen=True)
class NavigationRun:
    """One finished run."""

    condition: Condition
    preset: str
    seed: int
    values: dict[Measure, float]
    facts: dict[str, str]
    """Its provenance: steps, seconds, data, commit, machine, command."""
    trajectory: Path | None
    """A held-out trajectory with estimated states."""

    @property
    def identity(self) -> dict[str, Any]:
        """What tells this run from others."""
        fields = {name: getattr(self.condition, name) for name in _IDENTITY[:6]}
        return {k: int(v) if isinstance(v, bool) else v for k, v in fields.items()} | {
            "preset": self.preset,
            "seed": self.seed,
        }

    @property
    def settings(self) -> dict[str, str]:
        """Steps, data, and the flags of its command that change results and are no part of its condition."""
        facts = {name: self.facts[name] for name in ("steps", "set")}
        named = {*_IDENTITY[1:3], "literal_future", "preset"}
        return facts | settings_of(
            {k: v for k, v in flags_of(self.facts["command"]).items() if k not in named | {*facts}}
        )

    @property
    def file_name(self) -> str:
        """Name of its trajectory beside the CSV files."""
        return f"{self.condition.name.replace('/', '-')}-seed{self.seed}.csv"


def read_trajectory(path: Path) -> dict[str, np.ndarray]:
    """Columns of a run's trajectory.csv by name, each (T,) float64; raises UserError for a file that is none."""
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"), newline="")))
        return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    except (OSError, IndexError, KeyError, TypeError, ValueError) as error:
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


def load_runs(sources: Iterable[Path]) -> list[NavigationRun]:
    """Finished runs of all sources: run folders, folders that hold some, or folders with `rows.csv` and `runs.csv`.

    Raises:
        UserError: there is no source, one is missing, damaged or holds nothing, the same run comes with two results,
            seeds of one condition differ in their steps, data or settings, or a value is not finite.
    """
    runs: dict[tuple[Any, ...], NavigationRun] = {}
    for source in sources:
        if not source.exists():
            raise UserError(f"{source}: no such folder; name runs of `vd4rl-pomdp navigation train`")
        found = _from_csv(source) if (source / ROWS).exists() else _from_folders(source)
        if not found:
            raise UserError(f"{source}: holds no finished run of `vd4rl-pomdp navigation train`")
        for run in found:
            key = tuple(run.identity.values())
            if key in runs and runs[key].values != run.values:
                raise UserError(
                    f"{source}: {run.condition.name} seed {run.seed} is there twice with other results; keep one"
                )
            runs.setdefault(key, run)
    if not runs:
        raise UserError("no runs to report: name folders of `vd4rl-pomdp navigation train`, or an earlier report's")
    presets = sorted({run.preset for run in runs.values()})
    if len(presets) > 1:
        raise UserError(f"runs of different presets ({', '.join(presets)}) do not make one table; report them apart")
    _refuse_mixtures(runs.values())
    return sorted(runs.values(), key=lambda run: tuple(run.identity.values()))


def is_missing(condition: Condition, runs: Iterable[NavigationRun]) -> bool:
    """Whether a condition has no run, although its maze has runs and the same condition has some in another maze."""
    conditions = {run.condition for run in runs}
    return (
        condition not in conditions
        and any(other.maze == condition.maze for other in conditions)
        and any(replace(other, maze=condition.maze) == condition for other in conditions)
    )


def unfinished_runs(sources: Iterable[Path]) -> list[tuple[Path, str]]:
    """Unfinished runs at or below the sources, and how far each is: "at 10 of 30 steps"."""
    configs = {path for source in sources for path in source.rglob("config.json") if _is_unfinished(path.parent)}
    return [(path.parent, _progress(path.parent)) for path in sorted(configs)]


def _is_unfinished(folder: Path) -> bool:
    return not (folder / "timing.json").exists() and read_json(folder / "config.json").get("stage") == "navigation"


def _progress(folder: Path) -> str:
    done = max((int(row["step"]) for row in read_metrics(folder / "metrics.jsonl")), default=0)
    return f"at {done} of {read_json(folder / 'config.json').get('config', {}).get('steps', '?')} steps"


def _refuse_mixtures(runs: Iterable[NavigationRun]) -> None:
    """Seeds of one condition make a mean only if they had the same budget, data and settings."""
    first: dict[Condition, NavigationRun] = {}
    for run in runs:
        other = first.setdefault(run.condition, run)
        mine, others = run.settings, other.settings
        for name in dict.fromkeys((*others, *mine)):
            values = [settings.get(name, "the preset's") for settings in (others, mine)]
            if values[0] != values[1]:
                raise UserError(
                    f"{run.condition.name}: seeds {other.seed} and {run.seed} differ in their {name} "
                    f"({', '.join(values)}) and make no mean; report them apart"
                )


def save_runs(runs: list[NavigationRun], out: Path) -> None:
    """Write `rows.csv`, `runs.csv` and `trajectories/`, from which the report can be made again."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [run.identity | row | {"value": f"{row['value']:.6g}"} for run in runs for row in measure_rows(run.values)]
    write_csv(out / ROWS, (*_IDENTITY, *_MEASURED), rows)
    write_csv(out / RUNS, (*_IDENTITY, *_FACTS), [run.identity | run.facts for run in runs])
    (out / TRAJECTORIES).mkdir(exist_ok=True)
    for run in runs:
        target = out / TRAJECTORIES / run.file_name
        if run.trajectory is not None and run.trajectory.resolve() != target.resolve():
            shutil.copyfile(run.trajectory, target)


def _from_folders(source: Path) -> list[NavigationRun]:
    return [_read_run(path.parent) for path in sorted(source.rglob("timing.json")) if _is_navigation(path.parent)]


def _is_navigation(folder: Path) -> bool:
    return (folder / "results.json").exists() and read_json(folder / "config.json").get("stage") == "navigation"


def _read_run(folder: Path) -> NavigationRun:
    try:
        return _run_of(folder)
    except UserError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{folder}: its results are damaged ({error}); train it again") from error


def _run_of(folder: Path) -> NavigationRun:
    record, results = read_json(folder / "config.json"), read_json(folder / "results.json")
    config, timing, machine = record["config"], read_json(folder / "timing.json"), read_json(folder / "machine.json")
    named = {
        "maze": results["maze"],
        **{name: config[name] for name in ("method", "max_k")},
        "exogenous": config["exogenous"] != "none",
        "self_prediction": config.get("self_prediction", 0.0) > 0,  # these two are options of some methods alone
        "literal_future": config.get("literal_future", False),
    }
    condition = build(Condition, named)
    if not isinstance(config["preset"], str):
        raise TypeError(f"its preset is {config['preset']!r}")
    if not all(isinstance(timing[name], int | float) for name in ("steps", "seconds")):
        raise TypeError("timing.json holds no numbers")
    facts = {
        "steps": timing["steps"],
        "seconds": timing["seconds"],
        "set": results["set"],
        "git_commit": record["git_commit"],
        "processor": machine["processor"],
        "gpu": machine["gpu"] or "",
        "command": results.get("command", record["command"]),
    }
    values = {measure_of(row): _finite(folder / "results.json", row, f"{row['value']:.6g}") for row in results["rows"]}
    trajectory = folder / "trajectory.csv"
    if not trajectory.is_file():
        raise UserError(f"{trajectory}: is missing or no file; train it again")
    return NavigationRun(
        condition, config["preset"], config["seed"], values, {k: str(v) for k, v in facts.items()}, trajectory
    )


def _finite(path: Path, row: dict[str, Any], value: str) -> float:
    if not math.isfinite(float(value)):
        raise UserError(f"{path}: a {row['measure']} is {value}: the run has diverged; train it again or leave it out")
    return float(value)


def _from_csv(source: Path) -> list[NavigationRun]:
    try:
        return _runs_of(source)
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{source}: {ROWS} and {RUNS} do not fit together ({error}); make the report anew") from error


def _runs_of(source: Path) -> list[NavigationRun]:
    values: dict[tuple[str, ...], dict[Measure, float]] = {}
    for row in _read(source / ROWS):
        values.setdefault(_identity(row), {})[measure_of(row)] = _finite(source / ROWS, row, row["value"])
    runs = []
    for row in _read(source / RUNS):
        flags = {name: row[name] == "1" for name in ("self_prediction", "exogenous", "literal_future")}
        condition = Condition(row["maze"], row["method"], int(row["max_k"]), **flags)
        facts = {name: row[name] for name in _FACTS}
        run = NavigationRun(condition, row["preset"], int(row["seed"]), values[_identity(row)], facts, None)
        trajectory = source / TRAJECTORIES / run.file_name
        runs.append(replace(run, trajectory=trajectory) if trajectory.exists() else run)
    return runs


def _identity(row: dict[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in _IDENTITY)


def _read(path: Path) -> list[dict[str, str]]:
    try:
        text = regular(path).read_bytes().decode()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); it is written by the report") from error
    if not text.endswith("\n"):
        raise UserError(f"{path}: is cut in its last line; make the report anew")
    return list(csv.DictReader(io.StringIO(text, newline="")))
