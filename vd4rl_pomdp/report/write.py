"""Write a report: one HTML page that opens from disk, and the CSV files its tables and figures are made of."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vd4rl_pomdp.data.published import published_scores
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.report import figures, tables
from vd4rl_pomdp.report.gaps import MISSING, find_gaps
from vd4rl_pomdp.report.gates import gates, unranked
from vd4rl_pomdp.report.load import LoadedRun, compare, load_runs
from vd4rl_pomdp.report.stats import FEW_SEEDS
from vd4rl_pomdp.report.templates import render
from vd4rl_pomdp.report.theory import load_section
from vd4rl_pomdp.results import RUNS, refuse_loss, write_results
from vd4rl_pomdp.runs.files import Row, write_csv
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.text import write_text

_MARK = "summary"
"""The table that is always there: its file tells a report's folder."""


class Report(NamedTuple):
    """What was written."""

    page: Path
    summary: list[Row]
    """Table of final scores."""
    gates: list[Row]
    """Table of what has to hold before methods are ranked."""


def write_report(paths: list[Path], out: Path) -> Report:
    """Write the report of all runs at or below `paths` into `out`.

    The folder is a results folder, too, so that the report can be made again from it alone. A study that
    `vd4rl-pomdp theory` wrote at or below `paths` becomes a section of the page.

    Raises:
        UserError: there is nothing to report, a file is damaged, `out` holds anything but results or an earlier
            report, or it tells of finished runs that are not reported.
    """
    refuse_foreign(out, "report", f"{_MARK}.csv", RUNS)
    runs = load_runs(paths, out)
    refuse_loss([run.result for run in runs], out)
    rows = [row for run in runs for row in run.rows]
    if not rows:
        raise UserError(f"{paths[0]}: holds no evaluated run yet; `vd4rl-pomdp finetune` evaluates")
    final = [row for run in runs if run.finished for row in run.rows]
    gaps = find_gaps(runs)
    gated = gates(runs)
    made = {
        _MARK: tables.summary(final, gaps, unranked(gated)),
        "gates": gated,
        "curves": tables.curves(rows),
        "aggregate": tables.aggregate(final, gaps),
        "runs": tables.representations(runs, gaps),
        "control": tables.control(runs),
        "improvement": tables.improvement(final),
        "profiles": tables.profiles(final, np.linspace(0, 100, 101)),
        "missing": gaps,
    }
    page = _render(runs, rows, made, load_section(paths))
    out.mkdir(parents=True, exist_ok=True)
    for name, table in made.items():
        path = out / f"{name}.csv"
        if table:
            write_csv(path, list(table[0]), table)
        else:
            path.unlink(missing_ok=True)
    write_results(out, [run.result for run in runs])
    write_text(out / "index.html", page)
    return Report(out / "index.html", made[_MARK], gated)


def print_summary(report: Report, console: Console | None = None) -> None:
    """The verdicts of the gates, then the tables of final scores, one a setting, on the terminal."""
    console = console or Console()
    for row in report.gates:
        console.print(f"{_setting(row)}: {row['verdict']}", markup=False, highlight=False)
    console.print("score = return / 10, mean over seeds [95% interval]", markup=False, highlight=False)
    for setting, members in _by_setting(report.summary):
        console.print(_terminal_table(setting, members))


def _terminal_table(setting: str, rows: list[Row]) -> Table:
    table = Table(title=Text(setting), title_justify="left")
    table.add_column("method", overflow="fold")
    for name in ("score", "interval", "seeds", "episodes"):
        table.add_column(name, justify="right", no_wrap=True)
    gaps = any(row["missing"] for row in rows)
    if gaps:
        table.add_column("not there", overflow="fold")
    for row in rows:
        interval = f"{row['low']:.1f} - {row['high']:.1f}" if row["low"] is not None else "-"
        score = f"{row['score']:.1f}" if row["score"] is not None else MISSING
        texts = (tables.label(row), score, interval, str(row["seeds"]), str(row["episodes"]))
        table.add_row(*map(Text, (*texts, row["missing"]) if gaps else texts))
    return table


def _render(runs: list[LoadedRun], rows: list[Row], made: dict[str, list[Row]], theory: str | None) -> str:
    names = list(dict.fromkeys(map(tables.label, (*made[_MARK], *rows))))
    pretraining: dict[str, list[tuple[str, list[tuple[int, float]]]]] = {}
    for run in runs:
        if run.stage == "pretrain" and _has_losses(run):
            pretraining.setdefault(_setting(run.labels), []).append((tables.label(_row(run)), run.result.losses))
    settings = dict(_by_setting(made[_MARK]))
    return render(
        "page.html",
        label=tables.label,
        number=_number,
        finished=sum(run.finished for run in runs),
        unfinished=[(str(run.path), _title(run), run.progress) for run in runs if not run.finished],
        gaps=len(made["missing"]),
        rows=sum(len(run.rows) + len(run.others) for run in runs),
        few=FEW_SEEDS,
        tables=list(settings.items()),
        gates=[(_setting(row), row) for row in made["gates"]],
        differing=_differing(runs),
        aggregate=made["aggregate"],
        representations=_by_setting(made["runs"]),
        control=_by_setting(made["control"]) if _has_diagnostics(made["control"]) else [],
        probes=_probe_figures(made["runs"], names),
        improvement=_matrices(made["improvement"]),
        curves=[
            (name, figures.curve_figure(part, names, settings[name])) for name, part in _by_setting(made["curves"])
        ],
        profiles=[
            (name, figures.profile_figure(part, names, _partial(made["aggregate"], name)))
            for name, part in _by(made["profiles"], "corruption")
        ],
        losses=[(name, figures.loss_figure(series, names)) for name, series in pretraining.items()],
        films=_films(runs),
        published=_published(rows),
        theory=theory,
        runs=[_facts(run) for run in runs],
    )


def _has_diagnostics(control: list[Row]) -> bool:
    """Whether anything is known but the return as trained; earlier versions kept no more."""
    return any(row["data_return"] is not None or row["clean_return"] is not None for row in control)


def _probe_figures(runs: list[Row], names: list[str]) -> list[tuple[str, str, str]]:
    """Setting, figure and words of probes against returns, wherever there is something to show."""
    probed = [row for row in runs if any(row[probe] is not None for probe in figures.PROBES)]
    return [(setting, *figures.probe_figure(members, names)) for setting, members in _by_setting(probed)]


def _has_losses(run: LoadedRun) -> bool:
    return bool(run.result.losses)


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


def _partial(aggregate: list[Row], corruption: str) -> dict[str, str]:
    """Methods that have not been run on all tasks of a corruption, and on how many."""
    mine = [row for row in aggregate if row["corruption"] == corruption and row["tasks"] < row["of_tasks"]]
    return {tables.label(row): f"{row['tasks']} of {row['of_tasks']} tasks" for row in mine}


def _differing(runs: list[LoadedRun]) -> list[tuple[str, str]]:
    """Each method of which there are several variants, and all settings that differ, those of a preset included."""
    told = zip(runs, compare(runs, brief=False), strict=True)
    named = {
        tables.label(_row(run)): ", ".join(filter(None, parts))
        for run, parts in told
        if run.stage == "finetune" and run.variant
    }
    return list(named.items())


def _row(run: LoadedRun) -> Row:
    return run.labels | {"variant": run.variant}


def _setting(row: Row) -> str:
    return f"{row['task']} {row['quality']}, {row['corruption']}"


def _by_setting(rows: list[Row]) -> list[tuple[str, list[Row]]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(_setting(row), []).append(row)
    return list(groups.items())


def _title(run: LoadedRun) -> str:
    return f"{run.stage} {tables.label(_row(run))}, {_setting(run.labels)}, seed {run.labels['seed']}"


def _films(runs: list[LoadedRun]) -> list[Row]:
    """The film of the first seed of every method and setting."""
    chosen: dict[tuple[str, ...], LoadedRun] = {}
    for run in runs:
        if run.rows and (run.path / "film.npz").exists():
            chosen.setdefault(run.identity[:-1], run)
    shown = []
    for run in chosen.values():
        film = run.film()
        assert film is not None
        strip, movie = figures.strip(film), figures.movie(film)
        share = min(1.0, len(film["clean"]) / figures.STRIP_FRAMES)
        shown.append(
            {"title": _title(run), "strip": _base64(strip), "movie": _base64(movie)}
            | {"share": share, "total": film["return"][-1]}
        )
    return shown


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _published(rows: list[Row]) -> list[dict[str, str]]:
    wanted = {(row["task"], row["quality"]) for row in rows}
    return [row for row in published_scores() if (row["env"], row["dataset"]) in wanted]


def _facts(run: LoadedRun) -> dict[str, str]:
    return {
        "title": _title(run),
        "commit": run.record.get("git_commit", ""),
        "time": f"{run.seconds:.0f} s" if run.seconds is not None else run.progress,
        "command": run.record.get("command", ""),
        "config": json.dumps({k: run.record.get(k) for k in ("config", "versions")}, indent=1),
    }
