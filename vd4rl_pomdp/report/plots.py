"""A report's figures, one panel a task and quality: each shows a table of `report.tables`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report import tables
from vd4rl_pomdp.report.figures import COLOURS, HATCHES, Draw, Plot, file_name, looks_of, seeds_note, sheet, style
from vd4rl_pomdp.report.load import ACTION_ERRORS, COSTS, PROBES, SETTING, Run, labels

QUALITIES = ("expert", "medium_expert", "medium")
"""Those of the paper's figures, which come first."""
NAME_WIDTH = 28
"""Characters of a method's name in a figure before it is wrapped."""
MANY = 300
"""Dots of a figure, above which they are one picture within it."""


def draw_plots(runs: list[Run], made: dict[str, pd.DataFrame]) -> dict[str, list[Plot]]:
    """All figures, by section."""
    finished = [run for run in runs if run.finished and run.result.losses]
    losses = tables.losses([(run.named, run.result.losses) for run in finished])
    looks = looks_of(name for table in (made["summary"], made["curves"], losses) for name in labels(table))
    data = {
        (row["task"], row["quality"]): row["data_return"] / TASKS[row["task"]].score_divisor
        for row in made["gates"].to_dict("records")
        if pd.notna(row["data_return"]) and row["task"] in TASKS
    }
    return {
        "scores": bar_plots(made["summary"], made["runs"], data, looks),
        "profiles": profile_plots(made["profiles"], made["aggregate"], looks),
        "lead": lead_plots(made["lead"]),
        "curves": curve_plots(made["curves"], looks),
        **{name: dot_plots(made["runs"], looks, name) for name in DOTS},
        "costs": cost_plots(made["costs"]),
        "losses": loss_plots(losses, looks),
    }


def _figures(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame, list[tuple[str, pd.DataFrame]]]]:
    """By corruption: its rows, and the title and rows of each task and quality, the paper's qualities first."""
    rank = rows["quality"].map({name: place for place, name in enumerate(QUALITIES)}).fillna(len(QUALITIES))
    for corruption, mine in rows.assign(_rank=rank, label=labels(rows)).groupby("corruption", sort=False):
        ordered = mine.sort_values(["_rank", "quality", "task"], kind="stable").drop(columns="_rank")
        places = ordered.groupby(["task", "quality"], sort=False)
        yield str(corruption), ordered, [(" ".join(place), members) for place, members in places]


def _by_label(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    return ((str(name), mine) for name, mine in rows.groupby("label", sort=False))


def _told(places: Iterable[tuple[str, pd.DataFrame]], value: str, digits: int = 1) -> str:
    """What a figure shows, in words: the last value of each method."""
    return "; ".join(
        f"{title}: {', '.join(f'{name} {mine[value].iloc[-1]:.{digits}f}' for name, mine in _by_label(rows))}"
        for title, rows in places
    )


def bar_plots(
    summary: pd.DataFrame, runs: pd.DataFrame, data: dict[tuple[str, str], float], looks: dict[str, int]
) -> list[Plot]:
    """Final scores: one figure a corruption, a panel for each task and quality, a bar for each method.

    Args:
        summary: scores of every condition.
        runs: table of runs, whose final scores are the dots.
        data: the data's score by task and quality, which stands beside their names.
        looks: numbers of all labels in `style`.
    """
    seeds = runs[runs["score"].notna()].assign(label=lambda table: labels(table), kind="seed")
    dots = seeds.groupby([*SETTING, "label"])["score"].agg(list).to_dict()

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        names = []
        for place, row in enumerate(rows.to_dict("records")):
            look = looks[row["label"]]
            colour, hatch = COLOURS[look % len(COLOURS)], HATCHES[look // len(COLOURS) % len(HATCHES)]
            axes.barh(place, row["score"], 0.75, color=colour, hatch=hatch, edgecolor="white", linewidth=0, alpha=0.55)
            axes.hlines(place, row["low"], row["high"], color="black", lw=1.4, zorder=3)
            mine = dots[(*(row[name] for name in SETTING), row["label"])]
            spread = np.linspace(-0.2, 0.2, len(mine)) if len(mine) > 1 else np.zeros(1)
            axes.scatter(mine, place + spread, 7, color=colour, ec="black", lw=0.4, zorder=4)
            if row["best_score"] > row["score"]:
                axes.scatter(row["best_score"], place, 16, marker="D", fc="none", ec="black", lw=0.7, zorder=4)
            names.append(plain(row["label"] + (f" (×{row['absent']})" if row["absent"] else ""), NAME_WIDTH))
        axes.set_yticks(range(len(rows)), names, fontsize=7)
        axes.set_ylim(max(len(rows), 4) - 0.4, -0.6)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("score")
        if axes.dataLim.x0 >= 0:
            axes.set_xlim(left=0)

    plots = []
    for corruption, rows, places in _figures(summary[summary["score"].notna()]):
        panels = []
        for title, members in places:
            known = data.get((members["task"].iloc[0], members["quality"].iloc[0]))
            panels.append((title if known is None else f"{title} (data score {known:.1f})", members, draw))
        figure = sheet(panels, 2, [0.3 + 0.2 * max(len(members), 4) for _, members in places])
        shown = pd.concat([rows.assign(kind="mean"), seeds[seeds["corruption"] == corruption]])
        columns = ["kind", *SETTING, "label", "seed", "score", "low", "high", "seeds", "best_score", "missing"]
        caption = (
            f"Final scores under {corruption}. Bars: mean over seeds at the last evaluation; lines: 95% t intervals "
            "over seeds and episodes; dots: seeds; open diamonds: mean at the best evaluation, where the last is not "
            f"the best; ×2: two seeds are missing, unfinished or diverged. {seeds_note(rows['seeds'])}"
        )
        table = shown.reindex(columns=columns).rename(columns={"label": "method"})
        plots.append(Plot(file_name("scores", corruption), caption, _told(places, "score"), figure, table))
    return plots


def _lines(axes: Axes, rows: pd.DataFrame, looks: dict[str, int], x: str, y: str, **more: Any) -> None:
    """A line for each label, with a band where the rows have one."""
    for name, mine in _by_label(rows):
        look = style(looks[name]) | more
        draw, fill = (axes.step, {"step": more["where"]}) if "where" in more else (axes.plot, {})
        draw(mine[x], mine[y], lw=1.3, label=plain(name, NAME_WIDTH), **look)
        if "low" in mine:
            band = mine["low"].astype(float), mine["high"].astype(float)
            axes.fill_between(mine[x], *band, color=look["color"], alpha=0.1, lw=0, **fill)
    axes.set(xlabel=x, ylabel=y)


def curve_plots(curves: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Score against updates, one figure a corruption, one line a method."""

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        _lines(axes, rows, looks, "step", "score")
        axes.set(xlabel="gradient updates", xlim=(0, None))
        axes.set_ylim(1.05 * min(0.0, rows["low"].min()), 1.05 * max(rows["high"].max(), 0.0) or 1.0)

    caption = "Learning curves under {}: mean over the seeds that have got there, bands from the lowest to the highest "
    caption += "seed, unfinished runs among them."
    return _plots(curves, "curves", caption, draw, "score")


def loss_plots(losses: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Action loss of pretraining against steps, one figure a corruption, one line a method."""

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        _lines(axes, rows, looks, "step", "action_loss", marker=None)
        axes.set(xlabel="gradient steps", ylabel="action loss")

    caption = "Action loss of pretraining under {}, mean over finished runs."
    return _plots(losses, "losses", caption, draw, "action_loss")


def _plots(table: pd.DataFrame, name: str, caption: str, draw: Draw, value: str) -> list[Plot]:
    """One figure a corruption, one panel a task and quality."""
    plots = []
    for corruption, rows, places in _figures(table):
        figure = sheet([(title, members, draw) for title, members in places])
        told = f"{caption.format(corruption or 'any corruption')} {seeds_note(rows['seeds'])}"
        plots.append(Plot(file_name(name, corruption), told, _told(places, value), figure, rows))
    return plots


def profile_plots(profiles: pd.DataFrame, aggregate: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Share of runs above a score, one panel a corruption, one line a method."""
    if profiles.empty:
        return []

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        _lines(axes, rows, looks, "threshold", "share", marker=None, where="post")
        axes.set(xlabel="score", ylabel="share of runs above it", ylim=(0, 1.02))
        axes.set_xlim(rows["threshold"].min(), rows["threshold"].max())

    shown = profiles.assign(label=profiles["method"])
    panels = [(str(corruption), members) for corruption, members in shown.groupby("corruption", sort=False)]
    lacking = aggregate[(aggregate["tasks"] < aggregate["of_tasks"]) & (aggregate["tasks"] > 0)]
    partial = zip(lacking["corruption"], labels(lacking), lacking["tasks"], lacking["of_tasks"], strict=True)
    caption = (
        "Performance profiles: share of the runs of all tasks and seeds whose final score is above a threshold, with "
        f"pointwise 95% bands. {seeds_note(aggregate['seeds'])} "
        + "; ".join(f"{name} under {corruption}: {tasks} of {of} tasks" for corruption, name, tasks, of in partial)
    ).strip()
    middle = [(title, members[members["threshold"] <= 50]) for title, members in panels]
    words = f"Share of runs above 50: {_told(middle, 'share', 2)}"
    figure = sheet([(title, members, draw) for title, members in panels], 2)
    return [Plot("profiles", caption, words, figure, shown)]


def lead_plots(leads: pd.DataFrame) -> list[Plot]:
    """Differences against the budget of pretraining, one figure a corruption, a line for each difference."""
    if leads.empty:
        return []
    looks = {name: number for number, name in enumerate(sorted(set(labels(leads))))}

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        seen = rows["steps"] * rows["stacks"]
        for number, (name, mine) in enumerate(_by_label(rows)):
            look, place = style(looks[name]), seen[mine.index] * 1.05**number
            middle, low, high = (mine[column].astype(float) for column in ("difference", "low", "high"))
            reach = [(middle - low).fillna(0), (high - middle).fillna(0)]
            axes.errorbar(place, middle, reach, lw=1.3, capsize=3, label=plain(name, NAME_WIDTH), **look)
            for where in place[middle.isna()]:
                axes.text(where, 0, "missing", color=look["color"], rotation=90, fontsize=7, ha="center", va="bottom")
        axes.axhline(0, color="black", lw=0.8)
        axes.set_xscale("log")
        ticks = dict(zip(seen, rows["steps"].map("{:,}".format) + "\nx " + rows["stacks"].astype(str), strict=True))
        axes.set_xticks(list(ticks), list(ticks.values()))
        axes.minorticks_off()
        axes.set_xlim(min(ticks) / 1.5, 1.5 * max(ticks))
        axes.set(xlabel="pretraining: steps x stacks in a batch", ylabel="lead, % of the data's return")

    plots = []
    for corruption, rows, places in _figures(leads):
        caption = (
            f"Lead against the budget of pretraining under {corruption}: difference of mean returns, each in % of the "
            "mean return of its own data, with 95% t intervals over seeds and episodes if both sides have two seeds. "
            + seeds_note(rows["seeds"])
        )
        words = _told([(title, mine[mine["difference"].notna()]) for title, mine in places], "difference")
        figure = sheet([(title, members, draw) for title, members in places], 2)
        plots.append(Plot(file_name("lead", corruption), caption, words, figure, rows))
    return plots


DOTS = {
    "probes": (
        dict(zip(PROBES, ("pose", "velocity"), strict=True)),
        "error, %",
        "the error of a linear probe of pose and of velocity, in percent of a standard deviation",
    ),
    "errors": (
        dict(zip(ACTION_ERRORS, ("actions on the data", "actions in closed loop"), strict=True)),
        "mean squared error",
        "the mean squared difference of its actions from the data's actor's, on the data and in closed loop",
    ),
}
"""What returns are drawn against, by the names of the files: titles of two panels by the measures' columns, what the
measures are in short, and at length."""


def dot_plots(runs: pd.DataFrame, looks: dict[str, int], name: str) -> list[Plot]:
    """Return against what probes read from representations, or how actions err: a dot a run, two panels a setting."""
    measures, axis, words = DOTS[name]

    def draw_against(column: str, many: bool) -> Draw:
        def draw(axes: Axes, rows: pd.DataFrame) -> None:
            for label, mine in _by_label(rows[rows[column].notna()]):
                look = style(looks[label])
                marks = {"marker": look["marker"], "ec": "white", "lw": 0.5, "rasterized": many}
                axes.scatter(mine[column], mine["return"], 26, look["color"], label=plain(label, NAME_WIDTH), **marks)
            axes.set(xlabel=axis, ylabel="return")
            axes.update_datalim([(0, 0)])
            axes.autoscale_view()

        return draw

    known = runs[runs["return"].notna() & runs[list(measures)].notna().any(axis=1)]
    plots = []
    for corruption, rows, places in _figures(known):
        panels = [
            (f"{title}, {measures[column]}", members, draw_against(column, len(rows) > MANY))
            for title, members in places
            for column in measures
        ]
        caption = f"Final return under {corruption} against {words}; further left is better. One dot a run, "
        caption += f"n = {len(rows)} runs."
        shown = rows[[*SETTING, "label", "seed", *measures, "return"]].rename(columns={"label": "method"})
        figure = sheet(panels, 4 if len(places) > 1 else 2)
        told = f"Returns: {_told(places, 'return', 0)}"
        plots.append(Plot(file_name(name, corruption), caption, told, figure, shown))
    return plots


def cost_plots(costs: pd.DataFrame) -> list[Plot]:
    """Mean minutes of pretraining and fine-tuning by method, one beside the other."""
    rows = costs[costs[list(COSTS)].notna().any(axis=1)]
    if rows.empty:
        return []

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        minutes = (rows.set_index("method")[list(COSTS)] / 60).set_axis(["pretraining", "fine-tuning"], axis=1)
        minutes.rename(index=plain).plot.barh(ax=axes, stacked=True, width=0.7, color=COLOURS[:2], legend=False)
        axes.invert_yaxis()
        axes.set_ylabel("")

    caption = (
        "Cost of pretraining and fine-tuning: mean wall-clock time over a method's finished runs of all settings, on "
        f"the machines of the table. {seeds_note(rows['runs'], 'run')}"
    )
    words = _told([("seconds of fine-tuning", rows.assign(label=rows["method"]))], "finetune_seconds", 0)
    figure = sheet([("mean minutes of a run", rows, draw)], 1, [0.4 + 0.2 * len(rows)])
    return [Plot("costs", caption, words, figure, rows)]
