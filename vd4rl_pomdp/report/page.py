"""Writes a report: an HTML page that opens from disk, and the files behind its tables and figures.

index.html                       the page, with all figures embedded
NAME.csv, NAME.tex               its tables: all numbers, and as displayed
figures/NAME.{csv,png,pdf}       its figures
runs.jsonl, episodes.csv         the raw rows behind everything, see `vd4rl_pomdp.runs.results`
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from rich.console import Console

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.core.text import one_line, write_text
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import figures, load, tables
from vd4rl_pomdp.report.figures import Plot, draw_plots, seeds_note
from vd4rl_pomdp.report.films import shown_films
from vd4rl_pomdp.report.gates import gates, judge_claims, leads, opposite, tally, unranked, verdicts
from vd4rl_pomdp.report.load import ALL, COSTS, PROBES, SETTING, Choice, Run, label, setting, title
from vd4rl_pomdp.report.render import Block, Columns, block, print_setting, render, texts, write_latex
from vd4rl_pomdp.report.stats import FEW_SEEDS, number, with_interval
from vd4rl_pomdp.report.theory import load_section
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.results import NOT_CERTIFIED, RUNS, certificates_of, keep_certificates, refuse_loss, write_results

MARK = "summary"  # the table that every report has; its file identifies a report's folder
WIDEST = 6  # maximum methods side by side in a matrix; further ones go below
Tables = dict[str, pd.DataFrame]
Shown = dict[str, tuple[pd.DataFrame, list[Block]]]
Plots = dict[str, list[Plot]]


def with_algorithm(row: Row) -> str:
    """A setting in words, with the algorithm unless it is TD3+BC."""
    return setting(row) + ("" if row["algorithm"] == "td3_bc" else f", {row['algorithm']}")


def _count(row: Row) -> str:
    return f"{int(row['seeds'])}" + "†" * (0 < row["seeds"] < FEW_SEEDS)


def _span(row: Row, cost: str) -> str:
    """Mean, minimum and maximum of seconds."""
    low, high = row[f"{cost}_min"], row[f"{cost}_max"]
    return number(row[cost], 0) + (f" ({low:.0f} – {high:.0f})" if low < high else "")


def _chance(row: Row) -> str:
    """A probability with its interval, or the number of wins if a single seed allows no probability."""
    if pd.isna(row["probability"]):
        return f"{row['wins']:g} of {row['pairs']}"
    few = "†" if row["seeds"] < FEW_SEEDS else ""
    return with_interval(row["probability"], row["low"], row["high"], 2) + few


def claim_of(row: Row) -> str:
    """A claim, with its family."""
    return row["claim"] + (f" ({row['family']})" if row["family"] else "")


def _two(value: float | None, other: float | None, digits: int, unit: str = "") -> str:
    """A number, and another one in brackets if it is known."""
    return number(value, digits) + ("" if pd.isna(other) else f" ({number(other, digits)}{unit})")


SHOWN: dict[str, Columns] = {
    "gates": {
        "setting": with_algorithm,
        "verdict": "verdict",
        "memory": "memory",
        "data's return": ("data_return", 0),
        "state": ("state_share", 2),
        "acro, none": ("acro_share", 2),
        "acro's threshold": lambda row: f"{number(row['acro_bar'], 2)} ({row['bar_from']})",
        "best": ("best_share", 2),
        "best – random": ("above_random", "low", "high", 0),
    },
    "claims": {
        "claim": claim_of,
        "setting": setting,
        "verdict": lambda row: (row["verdict"] or "–") + "; opposite sign evaluated clean" * opposite(row),
        "left": lambda row: f"{row['left']}: {row['left_return']:.0f} (n = {row['left_seeds']})",
        "right": lambda row: f"{row['right']}: {row['right_return']:.0f} (n = {row['right_seeds']})",
        "difference": ("difference", "low", "high", 0),
        "p (Holm)": lambda row: _two(row["p"], row["adjusted_p"], 3).replace("0.000", "< 0.001"),
        "detectable difference": lambda row: _two(
            row["smallest"], row["smallest_share"] and 100 * row["smallest_share"], 0, "%"
        ),
        "evaluated clean": ("clean_difference", "clean_low", "clean_high", 0),
    },
    "lead": {
        "setting": with_algorithm,
        "difference": label,
        "pretraining": lambda row: f"{row['steps']:,} x {row['stacks']}",
        "% of the data's return": ("difference", "low", "high", 1),
        "seeds": lambda row: f"{row['left_seeds']}, {row['right_seeds']}",
    },
    MARK: {
        "setting": setting,
        "method": label,
        "last evaluation": ("score", "low", "high", 1),
        "at update": ("step", 0),
        "best evaluation": ("best_score", "best_low", "best_high", 1),
        "its update": ("best_step", 0),
        "seeds": _count,
        "episodes": "episodes",
        "no result": "missing",
    },
    "aggregate": {
        "corruption": "corruption",
        "method": label,
        **{
            name.replace("_", " ").replace("iqm", "IQM"): (name, f"{name}_low", f"{name}_high", 1)
            for name in tables.AGGREGATES
        },
        "tasks": lambda row: f"{row['tasks']} of {row['of_tasks']}",
        "seeds": _count,
    },
    "improvement": {"corruption": "corruption", "row beats column": "method", "other": "other", "chance": _chance},
    "representations": {
        "setting": setting,
        "method": label,
        "action loss": ("action_loss", 3),
        "pose, %": (PROBES[0], 1),
        "velocity, %": (PROBES[1], 1),
        "return": ("return", 0),
        "seeds": ("seeds", 0),
        "no result": "missing",
    },
    "control": {
        "setting": setting,
        "method": label,
        "data's return": ("data_return", 0),
        "return": ("return", 0),
        "return, clean": ("clean_return", 0),
        "above 80%": ("share_above_80", 2),
        "above 80%, clean": ("clean_share_above_80", 2),
        "error on path": ("path_error", 4),
        "in loop": ("action_error", 4),
        "in loop, clean": ("clean_action_error", 4),
        "seeds": ("seeds", 0),
    },
    "elsewhere": {
        "setting": setting,
        "method": label,
        "evaluated under": "evaluated_under",
        "score": ("score", "low", "high", 1),
        "seeds": _count,
        "episodes": "episodes",
    },
    "critics": {
        "setting": setting,
        "method": label,
        "critic's value": ("critic_value", 1),
        "data's discounted return": ("data_value", 1),
        "moved, %": lambda row: number(100 * row["critic_moved"]),
        "converged": lambda row: (
            "not recorded" if pd.isna(row["converged"]) else f"{row['converged']:.0f} of {row['seeds']}"
        ),
    },
    "costs": {
        "method": "method",
        "machines": lambda row: row["machines"] or "not recorded",
        "pretraining, s": lambda row: _span(row, COSTS[0]),
        "fine-tuning, s": lambda row: _span(row, COSTS[1]),
        "runs": "runs",
    },
}
"""Columns of the page's tables. All tables except WHOLE are split by the values of their first column."""
WORDS = {"gates": 3, "claims": 4, "lead": 3, "elsewhere": 2, "costs": 2}
"""Number of text columns at the left, if not 1."""
WHOLE = ("gates", "costs")
NOTES = {
    MARK: f"{tables.SCORE}. Mean over seeds, 95% t intervals over seeds and episodes.",
    "aggregate": "Over all tasks and seeds, 95% stratified bootstrap intervals.",
    "improvement": "Probability that a run of the row's method scores higher than one of the column's.",
}


def shown_tables(made: Tables) -> Shown:
    """The page's tables, by the base name of their files: their texts, as in the LaTeX file, and as displayed."""
    needed = {"control": ["data_return", "clean_return"], "critics": ["critic_value"]}  # else nothing new is shown
    found = {}
    for name, columns in SHOWN.items():
        rows = made[name]
        rows = rows.iloc[:0] if name in needed and rows[needed[name]].isna().all(axis=None) else rows
        table = texts(rows, columns)
        found[name] = table, list(_blocks(name, table, rows))
    return found


def _blocks(name: str, table: pd.DataFrame, rows: pd.DataFrame) -> Iterator[Block]:
    """Split a table by its first column; comparisons of two methods become a matrix."""
    words = WORDS.get(name, 1)
    if name in WHOLE:
        note = seeds_note(rows["runs"], "run") if name == "costs" else ""
        yield from [block("", table, words, note)] if len(table) else []
        return
    for heading, part in table.groupby(table.columns[0], sort=False):
        mine, shown = rows.loc[part.index], part.drop(columns=table.columns[0])
        if name == "claims":
            yield block(str(heading), shown, words, tally(mine.to_dict("records")))
        elif name == "improvement":
            order = list(dict.fromkeys(shown["row beats column"]))
            matrix = shown.pivot(index="row beats column", columns="other", values="chance")
            matrix = matrix.reindex(index=order, columns=order).fillna("no common task")
            for one in order:
                matrix.loc[one, one] = ""
            for start in range(0, len(order), WIDEST):
                columns = matrix.iloc[:, start : start + WIDEST].reset_index().rename_axis(columns=None)
                yield block(str(heading), columns, words, seeds_note(mine["seeds"]))
        else:
            note = seeds_note(mine["seeds"])
            privileged = " and ".join(
                method for method in dict.fromkeys(mine["method"]) if method in load.TRAINED_ON_STATES
            )
            if name == "representations" and privileged:
                # A linear probe trivially reads out what the encoder was trained to predict.
                note += f" {privileged}: trained on the states of all episodes, including the probe's held-out ones "
                note += "(unless --hold-out)."
            if name == MARK:
                note += f" Memory: {mine['memory'].iloc[0]}."
            if "no result" in shown and not shown["no result"].any():
                shown = shown.drop(columns="no result")
            yield block(str(heading), shown, words, note)


class Report(NamedTuple):
    """What was written."""

    page: Path
    summary: pd.DataFrame
    gates: list[Row]
    claims: list[Row]
    unlike: list[str]  # warnings about results that were made with different data or code


def write_report(paths: list[Path], out: Path, choice: Choice = ALL) -> Report:
    """Write a report of the runs at or below `paths` into `out`; `choice` narrows them.

    The folder is also a results folder, so the report can be rebuilt from it alone. A study that `vd4rl-pomdp theory`
    wrote at or below `paths` becomes a section of the page. UserError if there is nothing to report, a file is damaged,
    or `out` holds something else or finished runs that this report lacks.
    """
    refuse_foreign(out, "report", f"{MARK}.csv", RUNS)
    runs = load.load_runs(paths, out, choice)
    results = [run.result for run in runs]
    refuse_loss(results, out)  # check early: drawing takes most of the time
    if all(run.stage == "navigation" for run in runs):
        raise UserError(f"{paths[0]}: holds no evaluated run; `vd4rl-pomdp navigation report` reports its mazes")
    certificates = certificates_of(results, paths)
    made, judged, claimed = _tables(runs, choice, verdicts(runs, certificates))
    shown, plots, mixed = shown_tables(made), draw_plots(runs, made), unlike(runs)
    page = _page(runs, made, shown, plots, mixed, load_section(paths), bool(choice.wanted))
    with owned(out):
        refuse_loss(results, out)  # again: runs may have been added meanwhile
        _write(out, made, shown, plots)
        write_results(out, results)
        keep_certificates(out, certificates)
        write_text(out / "index.html", page)  # last, so that everything it links to exists
    return Report(out / "index.html", made[MARK], judged, claimed, mixed)


def _tables(runs: list[Run], choice: Choice, memory: dict[tuple, str]) -> tuple[Tables, list[Row], list[Row]]:
    """All tables of a report by name, as in its CSV files; and the rows of gates and claims."""
    evaluated = tables.evaluations(load.episodes_frame(runs))
    finished = load.episodes_frame(run for run in runs if run.finished)
    final = tables.evaluations(finished)
    gaps = pd.DataFrame(load.find_gaps(runs, choice), columns=[*load.CONDITION, "seed", "state"])
    judged = [row | {"memory": memory[tuple(row[name] for name in SETTING)]} for row in gates(runs)]
    claimed = judge_claims(runs, unranked(judged))
    undecided = unranked(judged, SETTING)
    summary = tables.summary(final, gaps, undecided)
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
        "representations": tables.representations(every, undecided),
        "costs": tables.costs(every),
        "control": tables.control(every, undecided),
        "elsewhere": tables.elsewhere(finished),
        "critics": tables.critics(every),
        "improvement": tables.improvement(final),
        "profiles": tables.profiles(final),
        "missing": gaps,
    }
    return made, judged, claimed


def _page(
    runs: list[Run], made: Tables, shown: Shown, plots: Plots, mixed: list[str], theory: str | None, wanted: bool
) -> str:
    sets = set(made[MARK][["task", "quality"]].itertuples(index=False, name=None))
    published = pd.DataFrame([row for row in published_scores() if (row["env"], row["dataset"]) in sets])
    films, left_out = shown_films(runs)
    return render(
        "page.html",
        score=tables.SCORE,
        finished=sum(run.finished for run in runs),
        unfinished=[(title(run), run) for run in runs if not run.finished],
        gaps=len(made["missing"]),
        wanted=wanted,
        rows=sum(len(run.result.rows) for run in runs),
        few=FEW_SEEDS,
        tables={name: blocks for name, (_, blocks) in shown.items()},
        plots={name: [(plot, figures.to_svg(plot.figure)) for plot in group] for name, group in plots.items()},
        unlike=mixed,
        films=films,
        left_out=left_out,
        published=[] if published.empty else [block("", published, 2)],
        theory=theory,
        facts=[_facts(name, members) for name, members in groups(runs, title).items()],
    )


def _write(out: Path, made: Tables, shown: Shown, plots: Plots) -> None:
    """Write every table as CSV and LaTeX, and every figure. Removes those of an earlier report that no longer exist."""
    folder = out / "figures"
    with disk_errors(out):
        folder.mkdir(exist_ok=True)
    for name, table in made.items():
        if len(table):
            figures.write_table(out / f"{name}.csv", table)
    for name, (table, _) in shown.items():
        if len(table):
            write_latex(out / f"{name}.tex", table, WORDS.get(name, 1) + (name not in WHOLE), NOTES.get(name, ""))
    drawn = {plot.name: plot for group in plots.values() for plot in group}
    for plot in drawn.values():
        figures.save_plot(folder, plot)
    gone = [out / f"{name}.csv" for name, table in made.items() if table.empty]
    gone += [out / f"{name}.tex" for name, (table, _) in shown.items() if table.empty]
    own = (path for path in folder.iterdir() if path.suffix in (".csv", ".png", ".pdf"))
    gone += [path for path in own if path.stem.partition("_")[0] in plots and path.stem not in drawn]
    for path in gone:
        path.unlink(missing_ok=True)


def unlike(runs: list[Run]) -> list[str]:
    """Sentences about compared runs that differ in a dataset's content or in a plug-in's code."""
    played = [run for run in runs if run.stage == "finetune" and run.rows]
    found: list[tuple[str, str, Run]] = []
    for name, mine in groups(played, lambda run: run.set_name).items():
        if not load.a_set_a_seed(mine):
            found += [(f"the set of {name} has {{}} contents", run.result.data[:12], run) for run in mine]
    for run in played:
        found += [(f"{part} has {{}} states of its code", state, run) for part, state in _code(run).items()]
    sentences = []
    for subject, members in groups((one for one in found if one[1]), itemgetter(0)).items():
        by_state = groups(members, itemgetter(1))
        methods = {state: sorted({run.method for *_, run in mine}) for state, mine in by_state.items()}
        if len(methods) > 1:
            states = "; ".join(f"{state} ({', '.join(names)})" for state, names in methods.items())
            sentences.append(f"{subject.format(len(methods))}: {states}")
    return sentences


def _code(run: Run) -> dict[str, str]:
    """Package and file of each third-party plug-in, as in the pretraining and then, if different, in the fine-tuning.

    For a method, only the pretraining's version counts if recorded, since fine-tuning does not use it.
    """
    found: dict[str, list[str]] = {}
    for record in (run.result.origin, run.record):
        plugins, sources = record.get("plugins", {}), record.get("sources", {})
        for part in plugins | sources:
            state = ", ".join(filter(None, (plugins.get(part), sources.get(part))))
            if not (part in found and part.startswith("method ")) and state not in found.get(part, ()):
                found.setdefault(part, []).append(state)
    return {part: " then ".join(states) for part, states in found.items()}


def _facts(name: str, runs: list[Run]) -> dict[str, str]:
    """What all seeds of a condition share, and what they were computed with."""
    seeds = [str(seed) for seed in sorted({int(run.labels["seed"]) for run in runs})]
    seconds = [value for run in runs if (value := run.measures["finetune_seconds"]) is not None]
    first = runs[0].record
    return {
        "title": f"{name}, {'seeds' if len(seeds) > 1 else 'seed'} {', '.join(seeds)}",
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
    lines += [f"{claim}: {text}" for claim, text in tallies.items() if text]
    for line in (*lines, f"{tables.SCORE}; mean over seeds [95% t interval]"):
        console.print(one_line(line), markup=False, highlight=False)
    shown = texts(report.summary, SHOWN[MARK])
    for place, part in shown.groupby("setting", sort=False):
        missing = ["no result"] if part["no result"].any() else []
        table = part[["method", "last evaluation", "seeds", "episodes", *missing]]
        print_setting(console, str(place), report.summary.loc[part.index[0], "memory"], table)
