"""Write a report: one HTML page that opens from disk, beside it what its tables and figures are made of.

index.html                       the page, with all figures in it
NAME.csv, NAME.tex               its tables: all numbers, and as they are shown
figures/NAME.{csv,png,pdf}       its figures
runs.jsonl, episodes.csv         the raw rows that everything is made of, see `vd4rl_pomdp.runs.results`
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from rich.console import Console

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.core.text import write_text
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import figures, tables
from vd4rl_pomdp.report.claims import judge_claims, tally
from vd4rl_pomdp.report.figures import Plot, seeds_note, to_svg, write_table
from vd4rl_pomdp.report.films import shown_films
from vd4rl_pomdp.report.gaps import find_gaps
from vd4rl_pomdp.report.gates import gates, unranked
from vd4rl_pomdp.report.lead import leads
from vd4rl_pomdp.report.load import (
    ALL,
    CONDITION,
    COSTS,
    PROBES,
    SETTING,
    TOLD_STATES,
    Choice,
    Run,
    a_set_a_seed,
    episodes_frame,
    label,
    labels,
    load_runs,
    runs_frame,
    setting,
    title,
)
from vd4rl_pomdp.report.render import Block, Columns, block, render, terminal, texts, write_latex
from vd4rl_pomdp.report.stats import FEW_SEEDS, number, with_interval
from vd4rl_pomdp.report.theory import load_section
from vd4rl_pomdp.report.variants import groups
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.results import RUNS, refuse_loss, write_results

MARK = "summary"
"""The table that is always there: its file tells a report's folder."""
WIDEST = 6
"""Methods side by side in a matrix, at most: the others are put below."""
SEEDS = 12
"""Seeds that are named one by one, at most."""


class Report(NamedTuple):
    """What was written."""

    page: Path
    summary: pd.DataFrame
    """Table of final scores."""
    gates: list[Row]
    """What has to hold before methods are ranked, by setting."""
    claims: list[Row]
    """The paper's claims and what becomes of them, by setting."""
    unlike: list[str]
    """What stands side by side and was not made of the same, in sentences."""


class Shown(NamedTuple):
    """A table as a reader sees it."""

    table: pd.DataFrame
    """Texts, as LaTeX sets them."""
    blocks: list[Block]
    words: int
    """Columns at the left that hold words; the others hold numbers."""


def write_report(paths: list[Path], out: Path, choice: Choice = ALL) -> Report:
    """Write the report of the runs at or below `paths` that `choice` is about, all of them by default, into `out`.

    The folder is a results folder, too, so that the report can be made again from it alone. A study that
    `vd4rl-pomdp theory` wrote at or below `paths` becomes a section of the page.

    Raises:
        UserError: there is nothing to report, a file is damaged, `out` holds anything but results or an earlier
            report, or it tells of finished runs that are not reported.
    """
    refuse_foreign(out, "report", f"{MARK}.csv", RUNS)
    runs = load_runs(paths, out, choice)
    results = [run.result for run in runs]
    refuse_loss(results, out)  # early: drawing takes most of the time
    if not any(run.rows for run in runs):
        mazes = all(run.stage == "navigation" for run in runs)
        told = "`vd4rl-pomdp navigation report` reports its mazes" if mazes else "`vd4rl-pomdp finetune` evaluates"
        raise UserError(f"{paths[0]}: holds no evaluated run yet; {told}")
    made, judged, claimed = _tables(runs, choice)
    shown = _shown(made)
    plots = _plots(runs, made)
    mixed = unlike(runs)
    page = _page(runs, made, shown, plots, mixed, load_section(paths))
    with owned(out):
        refuse_loss(results, out)  # of runs that were added while this was drawn
        _write(out, made, shown, plots)
        write_results(out, results)
        write_text(out / "index.html", page)  # last: whoever sees it finds what it links to
    return Report(out / "index.html", made[MARK], judged, claimed, mixed)


def _tables(runs: list[Run], choice: Choice) -> tuple[dict[str, pd.DataFrame], list[Row], list[Row]]:
    """All tables of a report as its CSV files hold them, by name; and the rows of gates and claims."""
    evaluated = tables.evaluations(episodes_frame(runs))
    final = tables.evaluations(episodes_frame(run for run in runs if run.finished))
    gaps = pd.DataFrame(find_gaps(runs, choice), columns=[*CONDITION, "seed", "state"])
    judged = gates(runs)
    claimed = judge_claims(runs, unranked(judged))
    every = tables.all_runs(runs_frame(runs), gaps)
    made = {
        MARK: tables.summary(final, gaps, unranked(judged, SETTING)),
        "gates": pd.DataFrame(judged),
        "claims": pd.DataFrame(claimed),
        "lead": pd.DataFrame(leads(runs)),
        "curves": tables.curves(evaluated),
        "aggregate": tables.aggregate(final, gaps),
        "runs": every,
        "representations": tables.representations(every),
        "costs": tables.costs(every),
        "control": tables.control(every),
        "elsewhere": tables.elsewhere(episodes_frame(run for run in runs if run.finished)),
        "critics": tables.critics(every),
        "improvement": tables.improvement(final),
        "profiles": tables.profiles(final),
        "missing": gaps,
    }
    return made, judged, claimed


def with_algorithm(row: Row) -> str:
    """A setting in words, with the algorithm where it is not TD3+BC."""
    return setting(row) + ("" if row["algorithm"] == "td3_bc" else f", {row['algorithm']}")


def _count(row: Row) -> str:
    return f"{int(row['seeds'])}" + "†" * (0 < row["seeds"] < FEW_SEEDS)


def _side(side: str) -> Callable[[Row], str]:
    return lambda row: f"{row[side]}: {row[f'{side}_return']:.0f} (n = {row[f'{side}_seeds']})"


def _bar(row: Row) -> str:
    return f"{number(row['acro_bar'], 2)} ({row['bar_from']})"


def _converged(row: Row) -> str:
    return "not recorded" if pd.isna(row["converged"]) else f"{row['converged']:.0f} of {row['seeds']}"


def _span(cost: str) -> Callable[[Row], str]:
    """Mean, least and most seconds."""

    def told(row: Row) -> str:
        low, high = row[f"{cost}_min"], row[f"{cost}_max"]
        return number(row[cost], 0) + (f" ({low:.0f} – {high:.0f})" if low < high else "")

    return told


def _chance(row: Row) -> str:
    """A probability with its interval, or the count of wins where one seed tells no probability."""
    if pd.isna(row["probability"]):
        return f"{row['wins']:g} of {row['pairs']}"
    few = "†" if row["seeds"] < FEW_SEEDS else ""
    return with_interval(row["probability"], row["low"], row["high"], 2) + few


def _claim(row: Row) -> str:
    return row["claim"] + (f" ({row['family']})" if row["family"] else "")


def _p(row: Row) -> str:
    """A p value, and the one that is adjusted for its family."""
    if pd.isna(row["p"]):
        return number(None)
    told = "" if pd.isna(row["adjusted_p"]) else f" ({row['adjusted_p']:.3f})"
    return f"{row['p']:.3f}{told}"


def _smallest(row: Row) -> str:
    """The difference that would be found, and as a share of the data's return."""
    share = "" if pd.isna(row["smallest_share"]) else f" ({100 * row['smallest_share']:.0f}%)"
    return number(row["smallest"], 0) + share


SHOWN: dict[str, tuple[int, Columns]] = {
    "gates": (
        2,
        {
            "setting": with_algorithm,
            "verdict": "verdict",
            "data's return": ("data_return", 0),
            "state": ("state_share", 2),
            "acro, none": ("acro_share", 2),
            "its bar": _bar,
            "best": ("best_share", 2),
            "best – random": ("above_random", "low", "high", 0),
        },
    ),
    "claims": (
        4,
        {
            "claim": _claim,
            "setting": setting,
            "verdict": lambda row: row["verdict"] or "–",
            "left": _side("left"),
            "right": _side("right"),
            "difference": ("difference", "low", "high", 0),
            "p (Holm)": _p,
            "would be found": _smallest,
            "played clean": ("clean_difference", "clean_low", "clean_high", 0),
        },
    ),
    "lead": (
        3,
        {
            "setting": with_algorithm,
            "difference": label,
            "pretraining": lambda row: f"{row['steps']:,} x {row['stacks']}",
            "% of the data's return": ("difference", "low", "high", 1),
            "seeds": lambda row: f"{row['left_seeds']}, {row['right_seeds']}",
        },
    ),
    MARK: (
        1,
        {
            "setting": setting,
            "method": label,
            "last evaluation": ("score", "low", "high", 1),
            "at update": ("step", 0),
            "best evaluation": ("best_score", "best_low", "best_high", 1),
            "its update": ("best_step", 0),
            "seeds": _count,
            "episodes": "episodes",
            "not there": "missing",
        },
    ),
    "aggregate": (
        1,
        {
            "corruption": "corruption",
            "method": label,
            **{
                name.replace("_", " ").replace("iqm", "IQM"): (name, f"{name}_low", f"{name}_high", 1)
                for name in tables.AGGREGATES
            },
            "tasks": lambda row: f"{row['tasks']} of {row['of_tasks']}",
            "seeds": _count,
        },
    ),
    "improvement": (
        1,
        {"corruption": "corruption", "row beats column": "method", "other": "other", "chance": _chance},
    ),
    "representations": (
        1,
        {
            "setting": setting,
            "method": label,
            "action loss": ("action_loss", 3),
            "pose, %": (PROBES[0], 1),
            "velocity, %": (PROBES[1], 1),
            "return": ("return", 0),
            "seeds": ("seeds", 0),
            "not there": "missing",
        },
    ),
    "control": (
        1,
        {
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
    ),
    "elsewhere": (
        2,
        {
            "setting": setting,
            "method": label,
            "played under": "evaluated_under",
            "score": ("score", "low", "high", 1),
            "seeds": _count,
            "episodes": "episodes",
        },
    ),
    "critics": (
        1,
        {
            "setting": setting,
            "method": label,
            "critic's value": ("critic_value", 1),
            "data's discounted return": ("data_value", 1),
            "moved, %": lambda row: number(100 * row["critic_moved"]),
            "converged": _converged,
        },
    ),
    "costs": (
        2,
        {
            "method": "method",
            "machines": lambda row: row["machines"] or "not recorded",
            "pretraining, s": _span(COSTS[0]),
            "fine-tuning, s": _span(COSTS[1]),
            "runs": "runs",
        },
    ),
}
"""Tables that the page shows: how many columns of words they have at the left, and all columns. All but those of WHOLE
are cut into one table for each value of the first column."""
WHOLE = ("gates", "costs")


def _shown(made: dict[str, pd.DataFrame]) -> dict[str, Shown]:
    """The tables that the page shows, by the name of their rows' file."""
    found = {}
    for name, (words, columns) in SHOWN.items():
        rows = made[name]
        if name == "control" and rows["data_return"].isna().all() and rows["clean_return"].isna().all():
            rows = rows.iloc[:0]  # nothing is known but the return as trained
        if name == "critics" and rows["critic_value"].isna().all():
            rows = rows.iloc[:0]
        table = texts(rows, columns)
        found[name] = Shown(table, list(_blocks(name, table, rows, words)), words)
    return found


def _blocks(name: str, table: pd.DataFrame, rows: pd.DataFrame, words: int) -> Iterator[Block]:
    """A table as the page shows it: cut by its first column, and a matrix of what is about two methods."""
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
            told = [method for method in dict.fromkeys(mine["method"]) if method in TOLD_STATES]
            if name == "representations" and told:
                # A linear probe reads easily what the encoder was trained to tell.
                names = " and ".join(told)
                note += f" {names}: trained on the states of all episodes, those that the probe holds out, too."
            if "not there" in shown and not shown["not there"].any():
                shown = shown.drop(columns="not there")
            yield block(str(heading), shown, words, note)


NOTES = {
    MARK: f"{tables.SCORE}. Mean over seeds, 95% t intervals over seeds and episodes.",
    "aggregate": "Over all tasks and seeds, 95% stratified bootstrap intervals.",
    "improvement": "Probability that a run of the row's method ends above one of the column's.",
}


def _plots(runs: list[Run], made: dict[str, pd.DataFrame]) -> dict[str, list[Plot]]:
    """All figures, by section."""
    finished = [run for run in runs if run.finished and run.result.losses]
    losses = tables.losses([(run.named, run.result.losses) for run in finished])
    looks = figures.looks_of(name for table in (made[MARK], made["curves"], losses) for name in labels(table))
    judged = made["gates"].to_dict("records")
    data = {(row["task"], row["quality"]): row["data_return"] for row in judged if pd.notna(row["data_return"])}
    return {
        "scores": figures.bar_plots(made[MARK], made["runs"], data, looks),
        "profiles": figures.profile_plots(made["profiles"], made["aggregate"], looks),
        "lead": figures.lead_plots(made["lead"]),
        "curves": figures.curve_plots(made["curves"], looks),
        **{name: figures.dot_plots(made["runs"], looks, name) for name in figures.DOTS},
        "costs": figures.cost_plots(made["costs"]),
        "losses": figures.loss_plots(losses, looks),
    }


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
        plots={name: [(plot, to_svg(plot.figure)) for plot in group] for name, group in plots.items()},
        unlike=mixed,
        films=films,
        left_out=left_out,
        published=[] if published.empty else [block("", published, 2)],
        theory=theory,
        facts=[_facts(name, members) for name, members in groups(runs, title).items()],
    )


def _write(out: Path, made: dict[str, pd.DataFrame], shown: dict[str, Shown], plots: dict[str, list[Plot]]) -> None:
    """Every table as CSV and LaTeX, and every figure; those that an earlier report had and this has not are removed."""
    folder = out / "figures"
    with disk_errors(out):
        folder.mkdir(exist_ok=True)
    for name, table in made.items():
        if len(table):
            write_table(out / f"{name}.csv", table)
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
    """What stands side by side and was not made of the same, in sentences: contents of a set, code of a part."""
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
    """Package and file of each part that is not this project's: of a pretraining's, then of a policy's if it is other.

    Of a method those of the pretraining, where they are recorded: nothing of it is used afterwards.
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
    """The commits and machines of runs, in words."""
    commits = ", ".join(dict.fromkeys(run.result.commit or "unknown" for run in runs))
    machines = "; ".join(dict.fromkeys(run.result.machine or "not recorded" for run in runs))
    return f"commit {commits}; {machines}"


def print_summary(report: Report, console: Console | None = None) -> None:
    """The verdicts of the gates and claims, then the tables of final scores, one a setting."""
    console = console or Console()
    lines = [f"{with_algorithm(row)}: {row['verdict']}" for row in report.gates]
    tallies = {claim: tally(rows) for claim, rows in groups(report.claims, _claim).items()}
    lines += [f"{claim}: {told}" for claim, told in tallies.items() if told]
    for line in (*lines, f"{tables.SCORE}; mean over seeds [95% t interval]"):
        console.print(line, markup=False, highlight=False)
    shown = texts(report.summary, SHOWN[MARK][1])
    for place, part in shown.groupby("setting", sort=False):
        columns = [
            "method",
            "last evaluation",
            "seeds",
            "episodes",
            *(["not there"] if part["not there"].any() else []),
        ]
        console.print(terminal(str(place), part[columns]))
