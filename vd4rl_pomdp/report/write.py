"""Write a report: one HTML page that opens from disk, and the CSV files its tables and figures are made of."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from vd4rl_pomdp.data.published import published_scores
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import COLUMNS
from vd4rl_pomdp.report import figures, tables
from vd4rl_pomdp.report.load import Run, load_runs
from vd4rl_pomdp.report.stats import FEW_SEEDS
from vd4rl_pomdp.report.templates import render
from vd4rl_pomdp.report.theory import load_study, section
from vd4rl_pomdp.runs.folder import write_csv

Row = dict[str, Any]


def write_report(paths: list[Path], out: Path) -> tuple[Path, list[Row]]:
    """Write the report of all runs at or below `paths` into `out`; returns the page and the table of final scores.

    A study that `vd4rl-pomdp theory` wrote at or below `paths` becomes a section of the page.
    """
    runs, study = load_runs(paths), load_study(paths)
    rows = [row for run in runs for row in run.rows]
    if not rows:
        raise UserError(f"{paths[0]}: holds no evaluated run yet; `vd4rl-pomdp finetune` evaluates")
    made = {
        "summary": tables.summary(rows),
        "curves": tables.curves(rows),
        "aggregate": tables.aggregate(rows),
        "runs": tables.representations(runs),
        "improvement": tables.improvement(rows),
        "profiles": tables.profiles(rows, np.linspace(0, 100, 101)),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, table in made.items():
        if table:
            write_csv(out / f"{name}.csv", list(table[0]), table)
    write_csv(out / "episodes.csv", COLUMNS, rows)
    (out / "index.html").write_text(_render(runs, rows, made, study))
    return out / "index.html", made["summary"]


def print_summary(summary: list[Row], console: Console | None = None) -> None:
    """The table of final scores on the terminal."""
    table = Table(title="score = return / 10, mean over seeds [95% interval]")
    for name in ("setting", "method"):
        table.add_column(name)
    for name in ("score", "interval", "seeds", "episodes"):
        table.add_column(name, justify="right")
    for row in summary:
        interval = f"{row['low']:.1f} - {row['high']:.1f}" if row["low"] is not None else "-"
        cells = (f"{row['score']:.1f}", interval, str(row["seeds"]), str(row["episodes"]))
        table.add_row(_setting(row), tables.label(row), *cells)
    (console or Console()).print(table)


def _render(runs: list[Run], rows: list[Row], made: dict[str, list[Row]], study: Row | None) -> str:
    names = list(dict.fromkeys(map(tables.label, made["summary"])))
    pretraining = {_title(run): run.metrics for run in runs if run.stage == "pretrain" and _has_losses(run)}
    return render(
        "page.html",
        label=tables.label,
        number=_number,
        finished=sum(run.seconds is not None for run in runs),
        rows=len(rows),
        few=FEW_SEEDS,
        tables=_by_setting(made["summary"]),
        aggregate=made["aggregate"],
        representations=made["runs"],
        improvement=_matrices(made["improvement"]),
        curves=[(name, figures.curve_figure(part, names)) for name, part in _by_setting(made["curves"])],
        profiles=[(name, figures.profile_figure(part, names)) for name, part in _by(made["profiles"], "corruption")],
        losses=figures.loss_figure(pretraining) if pretraining else "",
        films=_films(runs),
        published=_published(rows),
        theory=section(study) if study else None,
        runs=[_facts(run) for run in runs],
    )


def _has_losses(run: Run) -> bool:
    return any("action_loss" in row for row in run.metrics)


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _by(rows: list[Row], name: str) -> list[tuple[str, list[Row]]]:
    return [(key, [row for row in rows if row[name] == key]) for key in dict.fromkeys(row[name] for row in rows)]


def _matrices(rows: list[Row]) -> list[Row]:
    """Improvement tables by corruption: names, and the probability for every pair of them."""
    matrices = []
    for corruption, members in _by(rows, "corruption"):
        names = list(dict.fromkeys(row["method"] for row in members))
        values = {(row["method"], row["other"]): row["probability"] for row in members}
        matrices.append({"corruption": corruption, "names": names, "values": values})
    return matrices


def _setting(row: Row) -> str:
    return f"{row['task']} {row['quality']}, {row['corruption']}"


def _by_setting(rows: list[Row]) -> list[tuple[str, list[Row]]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(_setting(row), []).append(row)
    return list(groups.items())


def _title(run: Run) -> str:
    config = run.record["config"]
    if run.rows:
        return f"{run.stage} {tables.label(run.rows[0])}, {_setting(run.rows[0])}, seed {config['seed']}"
    return f"{run.stage} {config.get('method', run.path.name)}, {config.get('corruption', '')}, seed {config['seed']}"


def _films(runs: list[Run]) -> list[Row]:
    """The film of the first seed of every method and setting."""
    chosen: dict[tuple[str, ...], Run] = {}
    for run in runs:
        if run.rows and (run.path / "film.npz").exists():
            chosen.setdefault(run.identity[:-1], run)
    shown = []
    for run in chosen.values():
        film = run.film()
        assert film is not None
        strip, movie = figures.strip(film), figures.movie(film)
        shown.append(
            {"title": _title(run), "strip": _base64(strip), "movie": _base64(movie), "total": film["return"][-1]}
        )
    return shown


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _published(rows: list[Row]) -> list[dict[str, str]]:
    wanted = {(row["task"], row["quality"]) for row in rows}
    return [row for row in published_scores() if (row["env"], row["dataset"]) in wanted]


def _facts(run: Run) -> dict[str, str]:
    return {
        "title": _title(run),
        "commit": run.record.get("git_commit", ""),
        "time": f"{run.seconds:.0f} s" if run.seconds is not None else "unfinished",
        "command": run.record.get("command", ""),
        "config": json.dumps({k: run.record.get(k) for k in ("config", "versions")}, indent=1),
    }
