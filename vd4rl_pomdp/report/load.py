"""Read run folders: configs, metrics, evaluation rows and films."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import read_rows
from vd4rl_pomdp.runs.folder import read_json
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.reading import regular

FILM = {"clean": 4, "corrupted": 4, "return": 1}
"""Arrays of a film and their axes."""
IDENTITY = ("task", "quality", "corruption", "algorithm", "method", "seed")


@dataclass(frozen=True)
class Run:
    """One run's files, in memory."""

    path: Path
    stage: str
    record: dict[str, Any]
    """config.json: stage, config, versions, git_commit, command."""
    rows: list[dict[str, Any]]
    """Evaluation rows, numbers parsed."""
    metrics: list[dict[str, float]]
    seconds: float | None
    """Wall-clock time; None while the run is unfinished."""
    representation: dict[str, float | None]
    """What is known of its encoder: action_loss, probe_pose, probe_velocity, pretrain_seconds."""

    @property
    def identity(self) -> tuple[str, ...]:
        """Values of IDENTITY, from the first row."""
        return tuple(str(self.rows[0][name]) for name in IDENTITY)

    def film(self) -> dict[str, np.ndarray] | None:
        """Pictures of an evaluation episode, if the run kept them."""
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


def load_runs(paths: list[Path]) -> list[Run]:
    """Every run at or below the paths; none, or two with the same identity, raises UserError."""
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
    _refuse_twins(runs)
    for run in runs:
        run.film()  # a damaged one is told before anything is written
    return runs


def _is_run(config: Path) -> bool:
    return "stage" in read_json(config)


def _read(folder: Path) -> Run:
    """`_load`, with a sentence for files of a run that are JSON but not what a run writes."""
    try:
        return _load(folder)
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{folder}: its files are damaged ({error}); take another copy, or leave it out") from error


def _load(folder: Path) -> Run:
    record = read_json(folder / "config.json")
    if not isinstance(record["config"], dict) or "seed" not in record["config"]:
        raise TypeError("config.json holds no settings")
    timing = folder / "timing.json"
    return Run(
        path=folder,
        stage=record["stage"],
        record=record,
        rows=read_rows(folder / "episodes.csv"),
        metrics=read_metrics(folder / "metrics.jsonl"),
        seconds=_number(read_json(timing)["seconds"]) if timing.exists() else None,
        representation=_representation(folder),
    )


def _representation(folder: Path) -> dict[str, float | None]:
    card, probe, timing = (
        read_json(path) if path.exists() else {}
        for path in (folder / "encoder" / "config.json", folder / "probe.json", folder / "pretrain_timing.json")
    )
    return {
        "action_loss": _number(card.get("pretrain", {}).get("action_loss")),
        "probe_pose": _number(probe.get("probe_pose")),
        "probe_velocity": _number(probe.get("probe_velocity")),
        "pretrain_seconds": _number(timing.get("seconds")),
    }


def _number(value: Any) -> float | None:
    if value is not None and not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return value


def _refuse_twins(runs: list[Run]) -> None:
    seen: dict[tuple[str, ...], Path] = {}
    for run in runs:
        if not run.rows:
            continue
        if run.identity in seen:
            raise UserError(
                f"{run.path} and {seen[run.identity]}: two runs of one method, setting and seed; report one of them"
            )
        seen[run.identity] = run.path
