"""Write a report: one HTML page that opens from disk, beside it what its tables and figures are made of.

index.html                       the page, with all figures in it
NAME.csv, NAME.tex               its tables: all numbers, and as they are shown
figures/NAME.{csv,png,pdf}       its figures
runs.jsonl, episodes.csv         the raw rows that everything is made of, see `vd4rl_pomdp.runs.results`
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.core.text import write_text
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import figures, tables
from vd4rl_pomdp.report.claims import judge_claims, tally
from vd4rl_pomdp.report.figures import Plot, seeds_note, to_svg, write_table
from vd4rl_pomdp.report.films import shown_films
from vd4rl_pomdp.report.gaps import MISSING, find_gaps
from vd4rl_pomdp.report.gates import gates, unranked
from vd4rl_pomdp.report.load import (
    ALL,
    CONDITION,
    COSTS,
    PROBES,
    SETTING,
    TOLD_STATES,
    Choice,
    Run,
    episodes_frame,
    groups,
    label,
    labels,
    load_runs,
    runs_frame,
    setting,
    title,
    variants,
)
from vd4rl_pomdp.report.render import Block, Columns, block, render, texts, write_latex
from vd4rl_pomdp.report.stats import FEW_SEEDS, interval, number, with_interval
from vd4rl_pomdp.report.theory import load_section
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.runs.results import RUNS, refuse_loss, write_results

MARK = "summary"
"""The table that is always there: its file tells a report's folder."""
FIGURES = "figures"
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
    refuse_loss(results, out)
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
        write_text(out / "index.html", page)
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
        "curves": tables.curves(evaluated),
        "aggregate": tables.aggregate(final, gaps),
        "runs": every,
        "representations": tables.representations(every),
        "costs": tables.costs(every),
        "control": tables.control(every),
        "improvement": tables.improvement(final),
        "profiles": tables.profiles(final),
        "missing": gaps,
    }
    return made, judged, claimed


def _values(name: str, ends: str = "", digits: int = 1) -> Callable[[Row], str]:
    """A number and its interval, whose ends' columns have a prefix, or as suffixes of its own name."""
    low, high = (f"{name}_low", f"{name}_high") if ends == "own" else (f"{ends}low", f"{ends}high")
    return lambda row: with_interval(row[name], row[low], row[high], digits)


def _numbers(digits: int, **names: str) -> Columns:
    """Columns of numbers by their titles."""
    return {shown: lambda row, name=name: number(row[name], digits) for shown, name in names.items()}  # type: ignore[misc]


def _count(row: Row) -> str:
    return f"{int(row['seeds'])}†" if row["seeds"] < FEW_SEEDS else str(int(row["seeds"]))


def with_algorithm(row: Row) -> str:
    """A setting in words, with the algorithm where it is not TD3+BC."""
    return setting(row) + ("" if row["algorithm"] == "td3_bc" else f", {row['algorithm']}")


def _side(side: str) -> Callable[[Row], str]:
    return lambda row: f"{row[side]}: {row[f'{side}_return']:.0f} (n = {row[f'{side}_seeds']})"


def _seconds(cost: str) -> Callable[[Row], str]:
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


def _tasks(row: Row) -> str:
    return str(row["tasks"]) if row["tasks"] == row["of_tasks"] else f"{row['tasks']} of {row['of_tasks']}"


SHOWN: dict[str, tuple[int, Columns]] = {
    "gates": (
        2,
        {
            "setting": with_algorithm,
            "verdict": lambda row: row["verdict"],
            **_numbers(0, **{"data's return": "data_return"}),
            **_numbers(2, **{"state": "state_share", "acro, none": "acro_share", "best": "best_share"}),
            "best – random": _values("above_random", digits=0),
        },
    ),
    "claims": (
        4,
        {
            "claim": lambda row: row["claim"],
            "setting": setting,
            "verdict": lambda row: row["verdict"] or "–",
            "left": _side("left"),
            "right": _side("right"),
            "difference": _values("difference", digits=0),
            "played clean": _values("clean_difference", "clean_", 0),
        },
    ),
    MARK: (
        1,
        {
            "setting": setting,
            "method": label,
            "last evaluation": _values("score"),
            **_numbers(0, **{"at update": "step"}),
            "best evaluation": _values("best_score", "best_"),
            **_numbers(0, **{"its update": "best_step"}),
            "seeds": _count,
            "episodes": lambda row: str(row["episodes"]),
            "not there": lambda row: row["missing"],
        },
    ),
    "aggregate": (
        1,
        {
            "corruption": lambda row: row["corruption"],
            "method": label,
            "IQM": _values("iqm", "own"),
            "median": _values("median", "own"),
            "mean": _values("mean", "own"),
            "optimality gap": _values("optimality_gap", "own"),
            "tasks": _tasks,
            "seeds": _count,
        },
    ),
    "improvement": (
        1,
        {
            "corruption": lambda row: row["corruption"],
            "row beats column": lambda row: row["method"],
            "other": lambda row: row["other"],
            "chance": _chance,
        },
    ),
    "representations": (
        1,
        {
            "setting": setting,
            "method": label,
            **_numbers(3, **{"action loss": "action_loss"}),
            **_numbers(1, **{"pose, %": PROBES[0], "velocity, %": PROBES[1]}),
            **_numbers(0, **{"return": "return", "seeds": "seeds"}),
            "not there": lambda row: row["missing"],
        },
    ),
    "control": (
        1,
        {
            "setting": setting,
            "method": label,
            **_numbers(0, **{"data's return": "data_return", "return": "return", "return, clean": "clean_return"}),
            **_numbers(2, **{"above 80%": "share_above_80", "above 80%, clean": "clean_share_above_80"}),
            **_numbers(4, **{"error on path": "path_error", "in loop": "action_error"}),
            **_numbers(4, **{"in loop, clean": "clean_action_error"}),
            **_numbers(0, seeds="seeds"),
        },
    ),
    "costs": (
        2,
        {
            "method": lambda row: row["method"],
            "machines": lambda row: row["machines"] or "not recorded",
            "pretraining, s": _seconds(COSTS[0]),
            "fine-tuning, s": _seconds(COSTS[1]),
            "runs": lambda row: str(row["runs"]),
        },
    ),
}
"""Tables that the page shows: columns of words, and all columns. The first tells one table from the next, but where
all rows are one table."""
WHOLE = ("gates", "costs")
"""Tables that are not cut by their first column."""


def _shown(made: dict[str, pd.DataFrame]) -> dict[str, Shown]:
    """The tables that the page shows, by the name of their rows' file."""
    found = {}
    for name, (words, columns) in SHOWN.items():
        rows = made[name]
        if name == "control" and rows["data_return"].isna().all() and rows["clean_return"].isna().all():
            rows = rows.iloc[:0]  # nothing is known but the return as trained
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
                columns = matrix.iloc[:, start : start + WIDEST].reset_index()
                yield block(str(heading), columns, words, seeds_note(mine["seeds"]))
        else:
            note = seeds_note(mine["seeds"]) + (_told_note(mine["method"]) if name == "representations" else "")
            if "not there" in shown and not shown["not there"].any():
                shown = shown.drop(columns="not there")
            yield block(str(heading), shown, words, note)


def _told_note(methods: Iterable[str]) -> str:
    """What the probes of methods that regress the states are not."""
    names = " and ".join(method for method in dict.fromkeys(methods) if method in TOLD_STATES)
    return f" {names}: trained on the states of all episodes, those that the probe holds out, too." if names else ""


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
    theirs = {
        (run.labels["task"], run.labels["quality"])
        for run in runs
        if run.labels["corruption"] == "none" and run.record.get("collection") == {}
    }
    published = [row for row in published_scores() if (row["env"], row["dataset"]) in theirs]
    return {
        "scores": figures.bar_plots(made[MARK], made["runs"], data, looks, published),
        "profiles": figures.profile_plots(made["profiles"], made["aggregate"], looks),
        "curves": figures.curve_plots(made["curves"], looks),
        **figures.dot_plots(made["runs"], looks),
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
            (f"{title(run)}, seed {run.labels['seed']}", str(run.path), _state(run)) for run in runs if not run.finished
        ],
        gaps=len(made["missing"]),
        rows=sum(len(run.result.rows) for run in runs),
        few=FEW_SEEDS,
        tables={name: one.blocks for name, one in shown.items()},
        plots={name: [(plot, to_svg(plot.figure)) for plot in group] for name, group in plots.items()},
        differing=differing(runs),
        unlike=mixed,
        films=films,
        left_out=left_out,
        published=[] if published.empty else [block("", published, 2)],
        theory=theory,
        facts=[_facts(name, members) for name, members in groups(runs, title).items()],
    )


def _write(out: Path, made: dict[str, pd.DataFrame], shown: dict[str, Shown], plots: dict[str, list[Plot]]) -> None:
    """Every table as CSV and LaTeX, and every figure; those that an earlier report had and this has not are removed."""
    folder = out / FIGURES
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


def _state(run: Run) -> str:
    """How far it is, and why no further."""
    message = (run.result.diverged or {}).get("message")
    return f"{run.progress}: {message}" if message else run.progress


def differing(runs: list[Run]) -> list[tuple[str, str]]:
    """Each set with settings of its own, then each variant with all its settings that differ, a preset's included."""
    words: dict[str, dict[str, None]] = {}
    named: dict[str, str] = {}
    for run, parts in zip(runs, variants(runs, brief=False), strict=True):
        if run.stage == "finetune":
            words.setdefault(run.set_name, {}).update(dict.fromkeys(f"{k} {v}" for k, v in run.of_set.items()))
            named |= {label(run.named): ", ".join(filter(None, parts))} if run.variant else {}
    return [*((place, ", ".join(told)) for place, told in words.items() if told), *named.items()]


def unlike(runs: list[Run]) -> list[str]:
    """What stands side by side and was not made of the same, in sentences: contents of a set, code of a part."""
    told: list[tuple[str, str, str]] = []
    policies = [run for run in runs if run.stage == "finetune" and run.rows]
    for run in policies:
        content = run.record.get("inputs", {}).get("data", "")[:12]
        told += [(f"the set of {run.set_name} has {{}} contents", content, label(run.named))] if content else []
    for run in policies:
        told += [(f"{part} has {{}} states of its code", code, label(run.named)) for part, code in _code(run).items()]
    sentences = []
    for subject, members in groups(told, lambda one: one[0]).items():
        by_value = groups(members, lambda one: one[1])
        if len(by_value) > 1:
            words = (f"{value} ({', '.join(sorted({one[2] for one in some}))})" for value, some in by_value.items())
            sentences.append(f"{subject.replace('{}', str(len(by_value)))}: {'; '.join(words)}")
    return sentences


def _code(run: Run) -> dict[str, str]:
    """Package and file of each part that is not this project's: of a pretraining's, then of a policy's if it is other.

    Of a method those of the pretraining, where they are recorded: nothing of it is used afterwards.
    """
    before, own = _parts_of(run.result.origin), _parts_of(run.record)
    after = {part: told for part, told in own.items() if not (part in before and part.startswith("method "))}
    told = {part: [one[part] for one in (before, after) if part in one] for part in before | after}
    return {part: " then ".join(dict.fromkeys(states)) for part, states in told.items()}


def _parts_of(record: Mapping[str, Any]) -> dict[str, str]:
    """Package and file of each part that a record tells of."""
    told = [record.get(name, {}) for name in ("plugins", "sources")]
    names = dict.fromkeys(name for one in told for name in one)
    return {name: ", ".join(filter(None, (one.get(name) for one in told))) for name in names}


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
    tallies = {claim: tally(rows) for claim, rows in groups(report.claims, lambda row: row["claim"]).items()}
    lines += [f"{claim}: {told}" for claim, told in tallies.items() if told]
    for line in (*lines, f"{tables.SCORE}; mean over seeds [95% t interval]"):
        console.print(line, markup=False, highlight=False)
    for place, rows in groups(report.summary.to_dict("records"), setting).items():
        table = Table(title=Text(place), title_justify="left")
        table.add_column("method", overflow="fold")
        for name in ("score", "interval", "seeds", "episodes"):
            table.add_column(name, justify="right", no_wrap=True)
        if gaps := any(row["missing"] for row in rows):
            table.add_column("not there", overflow="fold")
        for row in rows:
            score = MISSING if pd.isna(row["score"]) else number(row["score"])
            texts = (label(row), score, interval(row["low"], row["high"]), str(row["seeds"]), str(row["episodes"]))
            gap = row["missing"].removesuffix(f" {MISSING}")  # its column's title says so, and labels need the room
            table.add_row(*map(Text, (*texts, gap) if gaps else texts))
        console.print(table)
