"""Read run folders: configs, metrics, evaluation rows and films."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import read_episodes
from vd4rl_pomdp.reference import Reference
from vd4rl_pomdp.report.variants import Parts, Settings, differences, read_settings
from vd4rl_pomdp.runs.files import Row, read_json
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.reading import regular

LABELS = ("task", "quality", "corruption", "algorithm", "method", "seed")
"""Columns that a run's files name it by."""
IDENTITY = ("task", "quality", "corruption", "algorithm", "method", "variant", "seed")
"""Columns that tell a run's rows from all others of a report: LABELS, and its variant."""
FILM = {"clean": 4, "corrupted": 4, "return": 1}
"""Arrays of a film and their axes."""


@dataclass(frozen=True)
class LoadedRun:
    """A run of pretraining or fine-tuning, finished or not, as its folder tells it."""

    path: Path
    stage: str
    record: dict[str, Any]
    """config.json: stage, config, versions, git_commit, command, inputs."""
    labels: dict[str, Any]
    """Values of LABELS; the task is empty until the run has opened its data."""
    settings: Settings
    """All settings in which runs of its method may differ, in words."""
    rows: list[Row]
    """Evaluation rows under the corruption of training, numbers parsed, with the run's `variant`."""
    metrics: list[dict[str, float]]
    seconds: float | None
    """Wall-clock time; None while the run is unfinished."""
    representation: dict[str, float | None]
    """Measures of its encoder: action_loss, probe_pose, probe_velocity, pretrain_seconds."""
    others: list[Row]
    """Evaluation rows under other corruptions, likewise: under none, if it was trained under one."""
    reference: Reference
    """What its policy is held against."""
    parts: Parts = ("", "", "")
    """Its settings that differ from those of other runs of its method, by the runs it is compared with."""

    @property
    def variant(self) -> str:
        """Its settings that differ from those of other runs of its method: "max_k 1"; empty if none does."""
        return ", ".join(filter(None, self.parts))

    @property
    def identity(self) -> tuple[str, ...]:
        """Values of IDENTITY."""
        labels = self.labels | {"variant": self.variant}
        return tuple(str(labels[name]) for name in IDENTITY)

    @property
    def clean(self) -> list[Row]:
        """Evaluation rows under no corruption, whatever it was trained under."""
        return [row for row in (*self.rows, *self.others) if row["evaluated_under"] == "none"]

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end."""
        return self.seconds is not None

    @property
    def progress(self) -> str:
        """How far it is: "finished", or "unfinished at 20 of 40 updates"."""
        if self.finished:
            return "finished"
        unit = "updates" if self.stage == "finetune" else "steps"
        done = max((int(row["step"]) for row in (*self.metrics, *self.rows)), default=0)
        return f"unfinished at {done} of {self.record['config'].get(unit, '?')} {unit}"

    def film(self) -> dict[str, np.ndarray] | None:
        """Pictures of an evaluation episode, if the run kept them; raises UserError for a damaged file."""
        path = self.path / "film.npz"
        if not path.exists():
            return None
        try:
            with np.load(regular(path)) as file:
                film = dict(file)
            if [film[name].ndim for name in FILM] != list(FILM.values()):
                raise ValueError("its arrays have other shapes")
            return film
        except UserError:
            raise
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise UserError(f"{path}: cannot be read ({error}); remove it, and the report goes without") from error


def load_runs(paths: list[Path]) -> list[LoadedRun]:
    """Every run at or below the paths.

    Raises:
        UserError: there is no run, two have the same identity, or a file of one is damaged.
    """
    if not paths:
        raise UserError("name at least one run folder, or a folder that contains some")
    folders: list[Path] = []
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: no such folder")
        folders += sorted(p.parent for p in path.rglob("config.json") if _is_run(p))
    runs = [_read(folder) for folder in dict.fromkeys(folders)]
    if not runs:
        raise UserError(f"{paths[0]}: contains no runs (a run is a folder with config.json and metrics.jsonl)")
    named = [_with_parts(run, parts) for run, parts in zip(runs, compare(runs), strict=True)]
    _refuse_twins(named)
    _check_films(named)
    return named


def _check_films(runs: list[LoadedRun]) -> None:
    """Raise UserError for a damaged film, before anything is written."""
    for run in runs:
        run.film()


def compare(runs: list[LoadedRun], brief: bool = True) -> list[Parts]:
    """The settings in which each run differs from others of its stage, method and algorithm."""
    parts: dict[Path, Parts] = {}
    for members in _groups(runs, lambda run: (run.stage, run.labels["method"], run.labels["algorithm"])):
        corruption = [str(run.labels["corruption"]) for run in members]
        setting = [tuple(run.labels[name] for name in ("task", "quality", "corruption")) for run in members]
        words = differences([run.settings for run in members], corruption, setting, brief)
        parts |= dict(zip((run.path for run in members), words, strict=True))
    return [parts[run.path] for run in runs]


def _groups(runs: Iterable[LoadedRun], key: Callable[[LoadedRun], Any]) -> list[list[LoadedRun]]:
    groups: dict[Any, list[LoadedRun]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())


def _with_parts(run: LoadedRun, parts: Parts) -> LoadedRun:
    named = replace(run, parts=parts)
    rows, others = ([row | {"variant": named.variant} for row in part] for part in (run.rows, run.others))
    return replace(named, rows=rows, others=others)


def _is_run(config: Path) -> bool:
    return "stage" in read_json(config)


def _read(folder: Path) -> LoadedRun:
    """Load a run; raises UserError for files that are valid JSON, but not what a run writes."""
    try:
        return _load(folder)
    except UserError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{folder}: its files are damaged ({error}); take another copy, or leave it out") from error


def _load(folder: Path) -> LoadedRun:
    record = read_json(folder / "config.json")
    if not isinstance(record["config"], dict) or "seed" not in record["config"]:
        raise TypeError("config.json holds no settings")
    if not isinstance(record["stage"], str):
        raise TypeError(f"its stage is {record['stage']!r}")
    rows = read_episodes(folder / "episodes.csv")
    card = _card(folder)
    timing = folder / "timing.json"
    return LoadedRun(
        path=folder,
        stage=record["stage"],
        record=record,
        labels=_labels(folder, record, rows, card),
        settings=read_settings(record, card if record["stage"] == "finetune" else {}),
        rows=[row for row in rows if row["evaluated_under"] == row["corruption"]],
        others=[row for row in rows if row["evaluated_under"] != row["corruption"]],
        reference=Reference.read(folder),
        metrics=read_metrics(folder / "metrics.jsonl"),
        seconds=_number(read_json(timing)["seconds"]) if timing.exists() else None,
        representation=_representation(folder, card),
    )


def _card(folder: Path) -> dict[str, Any]:
    """What a run's encoder says of its pretraining; empty where there is none yet."""
    path = folder / "encoder" / "config.json"
    card = read_json(path).get("pretrain") if path.exists() else {}
    if not isinstance(card, dict):
        raise UserError(f"{path}: does not say how the encoder was pretrained; pretrain it again")
    return card


def _labels(folder: Path, record: dict[str, Any], rows: list[Row], card: dict[str, Any]) -> dict[str, Any]:
    """A run's labels: from its rows, from its labels.json, or else as many as its config tells."""
    path = folder / "labels.json"
    if rows or path.exists():
        known = rows[0] if rows else read_json(path)
        missing = [name for name in LABELS if name not in known]
        if missing:
            raise UserError(f"{path}: has no {missing[0]!r}; start the same command again, which writes it anew")
        return {name: known[name] for name in LABELS}
    told = {"method": folder.name, "task": card.get("task"), "quality": card.get("quality")} | record["config"]
    return {name: told.get(name) or "" for name in LABELS if name != "seed"} | {"seed": told.get("seed", "")}


def _representation(folder: Path, card: dict[str, Any]) -> dict[str, float | None]:
    probe, timing = (
        read_json(path) if path.exists() else {} for path in (folder / "probe.json", folder / "pretrain_timing.json")
    )
    return {
        "action_loss": _number(card.get("action_loss")),
        "probe_pose": _number(probe.get("probe_pose")),
        "probe_velocity": _number(probe.get("probe_velocity")),
        "pretrain_seconds": _number(timing.get("seconds")),
    }


def _number(value: Any) -> float | None:
    if value is not None and not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return value


def _refuse_twins(runs: list[LoadedRun]) -> None:
    """Raise UserError for two evaluated runs with the same identity."""
    seen: dict[tuple[str, ...], Path] = {}
    for run in runs:
        if not run.rows:
            continue
        if run.identity in seen:
            raise UserError(
                f"{run.path} and {seen[run.identity]}: two runs of one method, setting and seed; report one of them"
            )
        seen[run.identity] = run.path
