"""Write a report: one HTML page that opens from disk, beside it what its tables and figures are made of.

index.html                       the page, with all figures in it
NAME.csv, NAME.tex               its tables: all numbers, and as they are shown
figures/NAME.{csv,png,pdf}       its figures
runs.jsonl, episodes.csv         the raw rows that everything is made of, see `vd4rl_pomdp.results`
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.text import write_text
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import bars, dots, lines, measures, overall, present, tables
from vd4rl_pomdp.report.claims import judge_claims
from vd4rl_pomdp.report.facts import differing, facts, unfinished, unlike
from vd4rl_pomdp.report.figures import Plot, save_plot, to_svg
from vd4rl_pomdp.report.films import shown_films
from vd4rl_pomdp.report.gaps import find_gaps, never_begun
from vd4rl_pomdp.report.gates import gates, unranked
from vd4rl_pomdp.report.layout import ShownTable, write_latex
from vd4rl_pomdp.report.load import ALL, SETTING, Choice, LoadedRun, load_runs
from vd4rl_pomdp.report.stats import FEW_SEEDS
from vd4rl_pomdp.report.templates import render
from vd4rl_pomdp.report.theory import load_section
from vd4rl_pomdp.runs.files import Row, write_csv
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.runs.results import RUNS, refuse_loss, write_results

_MARK = "summary"
"""The table that is always there: its file tells a report's folder."""
FIGURES = "figures"


class Report(NamedTuple):
    """What was written."""

    page: Path
    summary: list[Row]
    """Table of final scores."""
    gates: list[Row]
    """Table of what has to hold before methods are ranked."""
    claims: list[Row]
    """Table of the paper's claims and what becomes of them."""
    unlike: list[str]
    """What stands side by side and was not made of the same, in sentences."""


def write_report(paths: list[Path], out: Path, choice: Choice = ALL) -> Report:
    """Write the report of the runs at or below `paths` that `choice` is about, all of them by default, into `out`.

    The folder is a results folder, too, so that the report can be made again from it alone. A study that
    `vd4rl-pomdp theory` wrote at or below `paths` becomes a section of the page.

    Raises:
        UserError: there is nothing to report, a file is damaged, `out` holds anything but results or an earlier
            report, or it tells of finished runs that are not reported.
    """
    refuse_foreign(out, "report", f"{_MARK}.csv", RUNS)
    runs = load_runs(paths, out, choice)
    results = [run.result for run in runs]
    refuse_loss(results, out)
    if not any(run.rows for run in runs):
        mazes = all(result.record["stage"] == "navigation" for result in results)
        told = "`vd4rl-pomdp navigation report` reports its mazes" if mazes else "`vd4rl-pomdp finetune` evaluates"
        raise UserError(f"{paths[0]}: holds no evaluated run yet; {told}")
    made = _tables(runs, choice)
    shown = _shown(made)
    plots = _plots(runs, made)
    mixed = unlike(runs)
    page = _render(runs, made, shown, plots, mixed, load_section(paths))
    with owned(out):
        refuse_loss(results, out)  # of runs that were added while this was drawn
        with disk_errors(out):
            (out / FIGURES).mkdir(exist_ok=True)
        _write_tables(out, made, shown)
        _write_plots(out / FIGURES, plots)
        write_results(out, results)
        write_text(out / "index.html", page)
    return Report(out / "index.html", made[_MARK], made["gates"], made["claims"], mixed)


def _tables(runs: list[LoadedRun], choice: Choice) -> dict[str, list[Row]]:
    """All tables of a report as its CSV files hold them, by name."""
    evaluated = tables.evaluations(runs)
    final = tables.evaluations(run for run in runs if run.finished)
    gaps = [row for row in find_gaps(runs) if choice.asks(row)]
    gaps += never_begun(runs, gaps, choice.wanted)
    gated = gates(runs)
    of_runs = measures.run_table(runs, evaluated, gaps)
    return {
        _MARK: tables.summary(final, gaps, unranked(gated, SETTING)),
        "gates": gated,
        "claims": judge_claims(runs, unranked(gated)),
        "curves": tables.curves(evaluated),
        "aggregate": overall.aggregate(final, gaps),
        "runs": of_runs,
        "representations": measures.representations(of_runs),
        "costs": measures.costs(of_runs),
        "control": measures.control(runs),
        "improvement": overall.improvement(final),
        "profiles": overall.profiles(final),
        "missing": gaps,
    }


def _shown(made: dict[str, list[Row]]) -> dict[str, list[ShownTable]]:
    """The tables that the page shows, by the name of their rows' file."""
    return {
        "gates": present.gates(made["gates"]),
        "claims": present.claims(made["claims"]),
        _MARK: present.scores(made[_MARK]),
        "aggregate": present.aggregates(made["aggregate"]),
        "improvement": present.improvements(made["improvement"]),
        "representations": present.representations(made["representations"]),
        "control": present.control(made["control"]) if _has_diagnostics(made["control"]) else [],
        "costs": present.costs(made["costs"]),
    }


def _has_diagnostics(control: list[Row]) -> bool:
    """Whether anything is known but the return as trained; earlier versions kept no more."""
    return any(row["data_return"] is not None or row["clean_return"] is not None for row in control)


def _plots(runs: list[LoadedRun], made: dict[str, list[Row]]) -> dict[str, list[Plot]]:
    """All figures, by section."""
    losses = lines.loss_rows([run for run in runs if run.result.losses])
    named = (*made[_MARK], *made["curves"], *losses)
    looks = _looks(sorted(set(map(tables.label, named)), key=_method_order))
    return {
        "scores": bars.bar_plots(made[_MARK], made["runs"], made["gates"], looks, _published_here(runs)),
        "profiles": lines.profile_plots(made["profiles"], made["aggregate"], looks),
        "curves": lines.curve_plots(made["curves"], made[_MARK], looks),
        "probes": dots.return_plots(made["runs"], looks, dots.PROBED),
        "errors": dots.return_plots(made["runs"], looks, dots.ACTED),
        "costs": dots.cost_plots(made["costs"]),
        "losses": lines.loss_plots(losses, looks),
    }


def _method_order(name: str) -> tuple[bool, str]:
    """References last: a method's place does not depend on its score."""
    return name.partition(",")[0] in tables.REFERENCES, name


def _looks(names: list[str]) -> dict[str, int]:
    """Numbers of looks, in the order of the names: the package's methods have their own, others those that follow."""
    others = [name for name in names if name not in tables.LOOKS]
    return {name: ([*tables.LOOKS, *others]).index(name) for name in names}


def _published_here(runs: list[LoadedRun]) -> list[dict[str, str]]:
    """Published scores of the sets on which runs were trained: V-D4RL's own, not sets collected by this package."""
    theirs = {
        (run.labels["task"], run.labels["quality"])
        for run in runs
        if run.labels["corruption"] == "none" and run.record.get("collection") == {}
    }
    return [row for row in published_scores() if (row["env"], row["dataset"]) in theirs]


def _render(
    runs: list[LoadedRun],
    made: dict[str, list[Row]],
    shown: dict[str, list[ShownTable]],
    plots: dict[str, list[Plot]],
    mixed: list[str],
    theory: str | None,
) -> str:
    wanted = {(row["task"], row["quality"]) for row in made[_MARK]}
    films, left_out = shown_films(runs)
    values: dict[str, Any] = {
        "score": tables.SCORE,
        "finished": sum(run.finished for run in runs),
        "unfinished": unfinished(runs),
        "gaps": len(made["missing"]),
        "rows": sum(len(run.result.rows) for run in runs),
        "few": FEW_SEEDS,
        "tables": shown,
        "plots": {name: [(plot, to_svg(plot.figure)) for plot in group] for name, group in plots.items()},
        "differing": differing(runs),
        "unlike": mixed,
        "films": films,
        "left_out": left_out,
        "published": present.published([r for r in published_scores() if (r["env"], r["dataset"]) in wanted]),
        "theory": theory,
        "facts": facts(runs),
    }
    return render("page.html", **values)


_NOTES = {
    "summary": tables.SCORES_NOTE,
    "aggregate": "Over all tasks and seeds, 95% stratified bootstrap intervals.",
    "improvement": "Probability that a run of the row's method ends above one of the column's.",
}
_DAGGER = f"†: fewer than {FEW_SEEDS} seeds."


def _write_tables(out: Path, made: dict[str, list[Row]], shown: dict[str, list[ShownTable]]) -> None:
    """Every table as CSV and LaTeX; those that an earlier report had and this one has not are removed."""
    for name, rows in made.items():
        path = out / f"{name}.csv"
        if rows:
            write_csv(path, list(rows[0]), rows)
        else:
            path.unlink(missing_ok=True)
    for name, group in shown.items():
        path = out / f"{name}.tex"
        if group and made[name]:
            note = " ".join(filter(None, (_NOTES.get(name, ""), _DAGGER)))
            write_latex(path, group, note)
        else:
            path.unlink(missing_ok=True)


def _write_plots(folder: Path, plots: dict[str, list[Plot]]) -> None:
    """Every figure; those that an earlier report had and this one has not are removed, by their sections' names."""
    made = [plot for group in plots.values() for plot in group]
    for plot in made:
        save_plot(folder, plot)
    names = {plot.name for plot in made}
    for path in folder.iterdir():
        of_report = path.suffix in (".csv", ".png", ".pdf") and path.stem.partition("_")[0] in plots
        if of_report and path.stem not in names:
            path.unlink()
