"""Writes a report: an HTML page that opens from disk, and the files behind its tables and figures.

index.html                       the page, with all figures embedded
NAME.csv, NAME.tex               its tables: all numbers, and as displayed
figures/NAME.{csv,png,pdf}       its figures
runs.jsonl, episodes.csv         the raw rows behind everything, see `vd4rl_pomdp.runs.results`
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from rich.console import Console

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.core.text import write_text
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import figures, load, tables
from vd4rl_pomdp.report.claims import judge_claims, leads, tally
from vd4rl_pomdp.report.figures import Plot, draw_plots
from vd4rl_pomdp.report.films import shown_films
from vd4rl_pomdp.report.gates import gates, unranked, verdicts
from vd4rl_pomdp.report.load import (
    ALL,
    CONDITION,
    SETTING,
    Choice,
    Run,
    a_set_a_seed,
    find_gaps,
    label,
    load_runs,
    title,
)
from vd4rl_pomdp.report.render import block, render, terminal, texts, write_latex
from vd4rl_pomdp.report.shown import MARK, NOTES, SHOWN, WHOLE, Shown, claim_of, shown_tables, with_algorithm
from vd4rl_pomdp.report.stats import FEW_SEEDS
from vd4rl_pomdp.report.theory import load_section
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.results import NOT_CERTIFIED, RUNS, certificates_of, keep_certificates, refuse_loss, write_results

SEEDS = 12
"""Maximum seeds that are listed individually."""


class Report(NamedTuple):
    """What was written."""

    page: Path
    summary: pd.DataFrame
    """Table of final scores."""
    gates: list[Row]
    """Gates that must pass before methods are ranked, by setting."""
    claims: list[Row]
    """The paper's claims and their verdicts, by setting."""
    unlike: list[str]
    """Warnings, as sentences, about results that were made with different data or code."""


def write_report(paths: list[Path], out: Path, choice: Choice = ALL) -> Report:
    """Write a report of the runs at or below `paths` into `out`; `choice` narrows them.

    The folder is also a results folder, so the report can be rebuilt from it alone. A study that `vd4rl-pomdp theory`
    wrote at or below `paths` becomes a section of the page.

    Raises:
        UserError: there is nothing to report, a file is damaged, or `out` holds something else or finished runs that
            this report lacks.
    """
    refuse_foreign(out, "report", f"{MARK}.csv", RUNS)
    runs = load_runs(paths, out, choice)
    results = [run.result for run in runs]
    refuse_loss(results, out)  # check early: drawing takes most of the time
    if all(run.stage == "navigation" for run in runs):
        raise UserError(f"{paths[0]}: holds no evaluated run; `vd4rl-pomdp navigation report` reports its mazes")
    certificates = certificates_of(results, paths, None if out in paths else out)
    made, judged, claimed = _tables(runs, choice, verdicts(runs, certificates))
    shown = shown_tables(made)
    plots = draw_plots(runs, made)
    mixed = unlike(runs)
    page = _page(runs, made, shown, plots, mixed, load_section(paths))
    with owned(out):
        refuse_loss(results, out)  # again: runs may have been added meanwhile
        _write(out, made, shown, plots)
        write_results(out, results)
        keep_certificates(out, certificates)
        write_text(out / "index.html", page)  # last, so that everything it links to exists
    return Report(out / "index.html", made[MARK], judged, claimed, mixed)


def _tables(
    runs: list[Run], choice: Choice, memory: dict[tuple[str, ...], str]
) -> tuple[dict[str, pd.DataFrame], list[Row], list[Row]]:
    """All tables of a report by name, as in its CSV files; and the rows of gates and claims."""
    evaluated = tables.evaluations(load.episodes_frame(runs))
    finished = load.episodes_frame(run for run in runs if run.finished)
    final = tables.evaluations(finished)
    gaps = pd.DataFrame(find_gaps(runs, choice), columns=[*CONDITION, "seed", "state"])
    judged = [row | {"memory": memory[tuple(row[name] for name in SETTING)]} for row in gates(runs)]
    claimed = judge_claims(runs, unranked(judged))
    summary = tables.summary(final, gaps, unranked(judged, SETTING))
    places = summary[list(SETTING)].itertuples(index=False, name=None)
    summary["memory"] = [memory.get(place, NOT_CERTIFIED) for place in places]
    every = tables.all_runs(load.runs_frame(runs), gaps)
    made = {
        MARK: summary,
        "gates": pd.DataFrame(judged),
        "claims": pd.DataFrame(claimed),
        "lead": pd.DataFrame(leads(runs)),
        "curves": tables.curves(evaluated),
        "aggregate": tables.aggregate(final, gaps),
        "runs": every,
        "representations": tables.representations(every),
        "costs": tables.costs(every),
        "control": tables.control(every),
        "elsewhere": tables.elsewhere(finished),
        "critics": tables.critics(every),
        "improvement": tables.improvement(final),
        "profiles": tables.profiles(final),
        "missing": gaps,
    }
    return made, judged, claimed


def _page(
    runs: list[Run],
    made: dict[str, pd.DataFrame],
    shown: dict[str, Shown],
    plots: dict[str, list[Plot]],
    mixed: list[str],
    theory: str | None,
) -> str:
    sets = set(made[MARK][["task", "quality"]].itertuples(index=False, name=None))
    published = pd.DataFrame([row for row in published_scores() if (row["env"], row["dataset"]) in sets])
    films, left_out = shown_films(runs)
    return render(
        "page.html",
        score=tables.SCORE,
        finished=sum(run.finished for run in runs),
        unfinished=[
            (
                f"{title(run)}, seed {run.labels['seed']}",
                run.path,
                (run.result.diverged or {}).get("message"),
                run.progress,
            )
            for run in runs
            if not run.finished
        ],
        gaps=len(made["missing"]),
        rows=sum(len(run.result.rows) for run in runs),
        few=FEW_SEEDS,
        tables={name: one.blocks for name, one in shown.items()},
        plots={name: [(plot, figures.to_svg(plot.figure)) for plot in group] for name, group in plots.items()},
        unlike=mixed,
        films=films,
        left_out=left_out,
        published=[] if published.empty else [block("", published, 2)],
        theory=theory,
        facts=[_facts(name, members) for name, members in groups(runs, title).items()],
    )


def _write(out: Path, made: dict[str, pd.DataFrame], shown: dict[str, Shown], plots: dict[str, list[Plot]]) -> None:
    """Write every table as CSV and LaTeX, and every figure. Removes those of an earlier report that no longer exist."""
    folder = out / "figures"
    with disk_errors(out):
        folder.mkdir(exist_ok=True)
    for name, table in made.items():
        if len(table):
            figures.write_table(out / f"{name}.csv", table)
        else:
            (out / f"{name}.csv").unlink(missing_ok=True)
    for name, (table, _, words) in shown.items():
        if len(table):
            write_latex(out / f"{name}.tex", table, words + (name not in WHOLE), NOTES.get(name, ""))
        else:
            (out / f"{name}.tex").unlink(missing_ok=True)
    drawn = [plot for group in plots.values() for plot in group]
    for plot in drawn:
        figures.save_plot(folder, plot)
    for path in folder.iterdir():
        of_report = path.suffix in (".csv", ".png", ".pdf") and path.stem.partition("_")[0] in plots
        if of_report and path.stem not in {plot.name for plot in drawn}:
            path.unlink()


def unlike(runs: list[Run]) -> list[str]:
    """Sentences about compared runs that differ in a dataset's content or in a plug-in's code."""
    told: dict[str, dict[str, set[str]]] = {}
    played = [run for run in runs if run.stage == "finetune" and run.rows]
    own = {name for name, mine in groups(played, lambda run: run.set_name).items() if a_set_a_seed(mine)}
    for run in played:
        content = "" if run.set_name in own else str(run.record.get("inputs", {}).get("data", ""))[:12]
        states = {f"the set of {run.set_name} has {{}} contents": content}
        states |= {f"{part} has {{}} states of its code": code for part, code in _code(run).items()}
        for subject, state in states.items():
            if state:
                told.setdefault(subject, {}).setdefault(state, set()).add(label(run.named))
    sentences = []
    for subject, known in told.items():
        words = "; ".join(f"{state} ({', '.join(sorted(methods))})" for state, methods in known.items())
        sentences += [f"{subject.format(len(known))}: {words}"] if len(known) > 1 else []
    return sentences


def _code(run: Run) -> dict[str, str]:
    """Package and file of each third-party plug-in, as in the pretraining and then, if different, in the fine-tuning.

    For a method, only the pretraining's version counts if recorded, since fine-tuning does not use it.
    """
    found: dict[str, list[str]] = {}
    for record in (run.result.origin, run.record):
        plugins, sources = record.get("plugins", {}), record.get("sources", {})
        for part in dict.fromkeys((*plugins, *sources)):
            state = ", ".join(filter(None, (plugins.get(part), sources.get(part))))
            if not (part in found and part.startswith("method ")) and state not in found.get(part, ()):
                found.setdefault(part, []).append(state)
    return {part: " then ".join(states) for part, states in found.items()}


def _facts(name: str, runs: list[Run]) -> dict[str, str]:
    """What all seeds of a condition share, and what they were computed with."""
    seeds = sorted({str(run.labels["seed"]) for run in runs}, key=lambda seed: (len(seed), seed))
    shown = seeds if len(seeds) <= SEEDS else [*seeds[:3], "...", seeds[-1]]
    seconds = [value for run in runs if (value := run.measures["finetune_seconds"]) is not None]
    first = runs[0].record
    return {
        "title": f"{name}, {'seeds' if len(seeds) > 1 else 'seed'} {', '.join(shown)}",
        "made": made_with(runs),
        "time": f"{min(seconds):.0f} to {max(seconds):.0f} s" if seconds else runs[0].progress,
        "command": first.get("command", ""),
        "config": json.dumps({"config": settings_of(first["config"]), "versions": first.get("versions")}, indent=1),
    }


def made_with(runs: list[Run]) -> str:
    """Commits and machines of runs, in words."""
    commits = ", ".join(dict.fromkeys(run.result.commit or "unknown" for run in runs))
    machines = "; ".join(dict.fromkeys(run.result.machine or "not recorded" for run in runs))
    return f"commit {commits}; {machines}"


def print_summary(report: Report, console: Console | None = None) -> None:
    """Print the verdicts of gates and claims, then the tables of final scores, one per setting."""
    console = console or Console()
    lines = [f"{with_algorithm(row)}: {row['verdict']}" for row in report.gates]
    tallies = {claim: tally(rows) for claim, rows in groups(report.claims, claim_of).items()}
    lines += [f"{claim}: {told}" for claim, told in tallies.items() if told]
    for line in (*lines, f"{tables.SCORE}; mean over seeds [95% t interval]"):
        console.print(line, markup=False, highlight=False)
    shown = texts(report.summary, SHOWN[MARK])
    for place, part in shown.groupby("setting", sort=False):
        missing = ["not there"] if part["not there"].any() else []
        console.print(f"memory: {report.summary.loc[part.index[0], 'memory']}", markup=False, highlight=False)
        console.print(terminal(str(place), part[["method", "last evaluation", "seeds", "episodes", *missing]]))
