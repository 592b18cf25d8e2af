"""Results that outlive their run folders: one folder an experiment, small enough to commit.

    runs.jsonl     one JSON object a run: its id, and what its small files hold, by their names
    episodes.csv   raw evaluation rows, the run's id first

A report of a results folder is the same as one of the run folders, but for films. Both files are written whole, the
rows first: rows of a run that runs.jsonl does not name were left by a cut writing, and are ignored.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.core.settings import LABELS, settings_of
from vd4rl_pomdp.runs import CONFIG_FILE, EPISODES_FILE, METRICS_FILE, RECORDS
from vd4rl_pomdp.runs.episodes import COLUMNS, episodes_until, read_episodes
from vd4rl_pomdp.runs.files import Row, read_json, replacing_file, write_csv
from vd4rl_pomdp.runs.identity import content_hash, identity
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.provenance import CONTINUED
from vd4rl_pomdp.runs.run import remedy

RUNS = "runs.jsonl"
RECORD, ENCODER = "config", "encoder"
FILES = {Path(file).stem: file for file in RECORDS} | {ENCODER: f"{ENCODER}/{CONFIG_FILE}"}
"""A run's small files: the name of their content in runs.jsonl, and their place in the run folder."""


@dataclass(frozen=True)
class Result:
    """One run, finished or not, from its folder or from a results folder."""

    id: str
    """Name of what it computes, see `runs.identity`."""
    path: Path
    """Its folder, or the results folder that tells of it."""
    files: dict[str, dict[str, Any]]
    """Content of the FILES that it has."""
    step: int
    """The last step of which its metrics tell, 0 before the first."""
    losses: list[tuple[int, float]]
    """Step and action loss in the course of a pretraining."""
    rows: list[Row]
    """Evaluation rows, one an episode."""
    folder: bool = False
    """Whether `path` is its own folder."""

    @property
    def place(self) -> str:
        """Where it is told of, for a message."""
        return str(self.path) if self.folder else f"{self.path}: run {self.id}"

    @property
    def record(self) -> dict[str, Any]:
        """config.json: stage, config, inputs, versions, git_commit, command."""
        return self.files[RECORD]

    @property
    def parts(self) -> list[dict[str, Any]]:
        """Hardware and `git_commit` of the run, and of each later part of it that had others."""
        told = self.files.get("machine", {})
        return [told | {"git_commit": self.record.get("git_commit")}, *told.get(CONTINUED, [])]

    @property
    def machine(self) -> str:
        """What it was computed on: its GPU, or its processor and cores; empty if it is not known."""
        return _in_turn(map(_hardware, self.parts))

    @property
    def commit(self) -> str:
        """The commit it was computed with; empty if it is not known."""
        return _in_turn(part.get("git_commit") for part in self.parts)

    @property
    def encoder(self) -> dict[str, Any]:
        """What its encoder says of its pretraining; empty where there is none yet."""
        return self.files.get(ENCODER, {}).get("pretrain", {})

    @property
    def origin(self) -> dict[str, Any]:
        """What its encoder says of the code that made it, and of its probe; empty where there is none yet."""
        return self.files.get(ENCODER, {}).get("origin", {})

    @property
    def card(self) -> dict[str, Any]:
        """The same of the encoder that it started from; empty for a pretraining run."""
        return self.encoder if self.record["stage"] == "finetune" else {}

    @property
    def labels(self) -> dict[str, Any]:
        """Values of LABELS; the task is empty until the run has opened its data."""
        return {name: self.files["labels"][name] for name in LABELS}

    @property
    def measured(self) -> list[Row]:
        """What it found: evaluation rows, or the measures of a navigation run."""
        return self.rows or self.files.get("results", {}).get("rows", [])

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end."""
        return "timing" in self.files

    @property
    def diverged(self) -> dict[str, Any] | None:
        """Where it diverged, as `step` and `message`; None if it did not."""
        return self.files.get("diverged")

    @property
    def settled(self) -> bool:
        """Whether nothing is left to be done: it has finished, or it diverged."""
        return self.finished or self.diverged is not None


def _in_turn(words: Iterable[Any]) -> str:
    """What the parts of a run tell, each word once: "A then B"."""
    return " then ".join(dict.fromkeys(str(word) for word in words if word))


def _hardware(part: dict[str, Any]) -> str | None:
    if part.get("gpu"):
        return str(part["gpu"])
    processor, cores = part.get("processor"), part.get("cores")
    return f"{processor}, {cores} cores" if processor and cores else processor


def read_run(folder: Path | str) -> Result:
    """What a run folder holds; raises UserError for damaged files."""
    folder = Path(folder)
    files = {name: read_json(folder / place) for name, place in FILES.items() if (folder / place).exists()}
    if ENCODER in files and not isinstance(files[ENCODER].get("pretrain"), dict):
        raise UserError(f"{folder / FILES[ENCODER]}: does not say how the encoder was pretrained; pretrain it again")
    metrics, rows = read_metrics(folder / METRICS_FILE), _folder_rows(folder / EPISODES_FILE, "timing" in files)
    step = max((int(row["step"]) for row in (*metrics, *rows)), default=0)
    with whole_files(folder):
        losses = [(int(row["step"]), row["action_loss"]) for row in metrics if "action_loss" in row]
        run = Result("", folder, files, step, losses if files[RECORD]["stage"] == "pretrain" else [], rows, True)
        _check(run)
        _check_last_evaluation(run)
        files["labels"] = files.get("labels", {}) | _labels(run)
        return replace(run, id=_id(run))


def _folder_rows(path: Path, finished: bool) -> list[Row]:
    """A run folder's rows; what cut a run that is not finished may have cut its last row, which is left out."""
    rows = read_episodes(path) if finished else episodes_until(path, sys.maxsize)
    return [{name: row[name] for name in COLUMNS} for row in rows]


def _check_last_evaluation(run: Result) -> None:
    """Raise UserError if a finished fine-tuning's folder lacks episodes of its last evaluation."""
    last, episodes = run.files.get("timing", {}).get("updates"), run.record["config"].get("eval_episodes")
    found = [row for row in run.rows if row["step"] == last and row["evaluated_under"] == row["corruption"]]
    if last is not None and episodes is not None and len(found) < episodes:
        what = f"{len(found)} of {episodes} episodes of the last evaluation"
        raise UserError(f"{run.path / EPISODES_FILE}: has {what}; {remedy(run.path)}")


def _labels(run: Result) -> dict[str, Any]:
    """A run's labels: from its rows, from its labels.json, or else as many as its config tells."""
    known = run.rows[0] if run.rows else run.files.get("labels")
    if known is not None:
        missing = [name for name in LABELS if name not in known]
        if missing:
            place = run.path / FILES["labels"]
            raise UserError(f"{place}: has no {missing[0]!r}; {remedy(run.path)}")
        return {name: known[name] for name in LABELS}
    told = {"method": run.path.name, "task": run.encoder.get("task"), "quality": run.encoder.get("quality")}
    told |= run.record["config"]
    return {name: told.get(name) or "" for name in LABELS if name != "seed"} | {"seed": told["seed"]}


def read_results(folder: Path | str) -> list[Result]:
    """All runs of a results folder; raises UserError if it is none, or damaged."""
    folder = Path(folder)
    path, by_run = folder / RUNS, dict[str, list[Row]]()
    lines = _lines(path)  # before the rows, which are written first: one that is written meanwhile lacks none
    for row in read_episodes(folder / EPISODES_FILE):
        if "id" not in row:
            raise UserError(f"{folder / EPISODES_FILE}: has no column 'id'; it was not written beside {RUNS}")
        by_run.setdefault(row["id"], []).append({name: _shared(row[name]) for name in COLUMNS})
    runs = [_parse(path, number, line, by_run) for number, line in enumerate(lines, 1)]
    if len({run.id for run in runs}) != len(runs):
        raise UserError(f"{path}: names a run twice; remove one of the two lines")
    return runs


def _shared(value: Any) -> Any:
    """A word that many rows hold, kept once."""
    return sys.intern(value) if isinstance(value, str) else value


def _lines(path: Path) -> list[str]:
    """The lines of a runs.jsonl."""
    folder = path.parent
    try:
        lines = read_bytes(path).decode().splitlines()
    except FileNotFoundError as error:
        raise UserError(f"{folder}: holds no {RUNS}, so it is no results folder") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no UTF-8 ({error}); take another copy") from error
    if not lines:
        raise UserError(f"{path}: is empty; take another copy, or remove it")
    return lines


def write_results(out: Path, runs: Iterable[Result]) -> None:
    """Write runs as a results folder that holds nothing else of the kind; a reader sees each file whole."""
    runs = list(runs)
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    write_csv(out / EPISODES_FILE, ("id", *COLUMNS), ({"id": run.id} | row for run in runs for row in run.rows))
    with replacing_file(out / RUNS) as fresh, fresh.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(_object(run)) + "\n" for run in runs)


def _object(run: Result) -> dict[str, Any]:
    """A run's line of runs.jsonl."""
    files = {name: run.files[name] for name in FILES if name in run.files}
    told = {"id": run.id, **files, "step": run.step, "episodes": len(run.rows)}
    return told | ({"losses": run.losses} if run.losses else {})


def _parse(path: Path, number: int, line: str, rows: dict[str, list[Row]]) -> Result:
    with whole_files(f"{path}: line {number}"):
        told = parse_json(line)
        files = {name: told[name] for name in FILES if name in told}
        losses = [(int(step), float(loss)) for step, loss in told.get("losses", [])]
        mine = _rows(path, told["id"], rows, int(told["episodes"]))
        run = Result(told["id"], path.parent, files, int(told["step"]), losses, mine)
        _check(run)
        return run


def _rows(path: Path, run: str, rows: dict[str, list[Row]], count: int) -> list[Row]:
    """The rows that a run had when its line was written: a cut writing may have added later ones."""
    mine = rows.get(run, [])
    if len(mine) < count:
        raise UserError(
            f"{path.parent / EPISODES_FILE}: has {len(mine)} of {count} rows of run {run}; take another copy"
        )
    return mine[:count]


@contextmanager
def whole_files(where: Path | str) -> Iterator[None]:
    """Whatever is wrong with a run's content becomes a sentence that says where."""
    try:
        yield
    except UserError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{where}: its files are damaged ({error}); take another copy, or leave it out") from error


def _check(run: Result) -> None:
    """Look at the parts of a run that everything relies on; raises KeyError, TypeError or AttributeError."""
    if not all(isinstance(part, dict) for part in (*run.files.values(), *run.parts, run.record["config"], run.encoder)):
        raise TypeError("a part of it is no JSON object")
    if "seed" not in run.record["config"]:
        raise TypeError("its record holds no settings")
    if not isinstance(run.record["stage"], str):
        raise TypeError(f"its stage is {run.record['stage']!r}")


def _id(run: Result) -> str:
    """Its identity; of a run that an early version began, which did not record all of that, a hash of what it did."""
    recorded = {"settings", "seed"} <= run.card.keys() or run.record["stage"] != "finetune"
    data = run.record.get("inputs", {}).get("data")
    if recorded and data:
        return identity(run.record, run.card)
    told = [run.record["stage"], settings_of(run.record["config"]), run.labels, run.card, data]
    return content_hash(told)
