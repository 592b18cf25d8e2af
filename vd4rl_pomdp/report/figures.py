"""A report's figures: one panel per task and quality, drawn from the tables of `report.tables`."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report import stats, tables
from vd4rl_pomdp.report.load import ACTION_ERRORS, CONDITION, PROBES, REFERENCES, SETTING, Run, labels
from vd4rl_pomdp.runs.files import replacing_file

mpl.rcParams["svg.hashsalt"] = "vd4rl-pomdp"  # else SVG ids are random, and no two pages are equal
mpl.rcParams["pdf.fonttype"] = 42  # TrueType, as publishers reject Type 3
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette for colour-blind readers."""
DASHES, MARKERS, HATCHES = ("-", "--", ":", "-."), "osD^", ("", "////", "....", "xxxx")
"""Dashes, markers and hatches of successive rounds through the colours, before styles repeat."""
LOOKS = (
    *("mik+a", "mik", "acro", "ah+a", "fj+a", "supervised+a", "random", "ah", "fj", "supervised", "state"),
    *("curl", "driml", "homer", "one_step_inverse", "no_history", "bc", "drq_bc", "acdf", "smwm"),
    *("supervised_picture", "integrator"),
)
"""The package's methods in fixed style order, so that a method looks the same in every report. The first ones differ in
colour."""
DPI = 150
FORMATS: dict[str, dict[str, Any]] = {"png": {"dpi": DPI}, "pdf": {"metadata": {"CreationDate": None}}}
"""File formats of a figure, in addition to the SVG in the page."""
WIDTH, HEIGHT = 10.0, 2.1  # width of a figure and default height of a panel, in inches
Draw = Callable[[Axes, pd.DataFrame], None]
QUALITIES = ("expert", "medium_expert", "medium")  # qualities in the paper's figures, which come first
NAME_WIDTH = 28  # characters after which a method's name is wrapped
MANY = 100  # number of dots above which a panel's dots are rasterised


class Plot(NamedTuple):
    """A figure, its data as in its CSV file, and the base name of its files."""

    name: str
    caption: str
    figure: Figure
    rows: pd.DataFrame


def looks_of(names: Iterable[str]) -> dict[str, int]:
    """Style number by label: fixed for the package's methods, then others in order."""
    others = sorted(set(names) - set(LOOKS), key=lambda name: (name.partition(",")[0] in REFERENCES, name))
    return {name: number for number, name in enumerate([*LOOKS, *others])}


def style(number: int) -> dict[str, Any]:
    """Line and marker style of a number."""
    turn = number // len(COLOURS)
    line = {"linestyle": DASHES[turn % len(DASHES)], "marker": MARKERS[turn % len(MARKERS)], "markersize": 4}
    return {"color": COLOURS[number % len(COLOURS)]} | line


def sheet(panels: Sequence[tuple[str, pd.DataFrame, Draw]], columns: int = 3, heights: Sequence[float] = ()) -> Figure:
    """A figure with one panel per entry (title, rows, and what draws them), and a shared legend below.

    At most `columns` panels are in a row; `heights` of panels are in inches.
    """
    columns = min(columns, len(panels))
    sizes = list(heights) or [HEIGHT] * len(panels)
    height = [max(sizes[i : i + columns]) for i in range(0, len(panels), columns)]
    size = WIDTH if columns > 1 else 0.66 * WIDTH, sum(height) + 0.6 * len(height)
    figure = Figure(figsize=size, dpi=DPI)  # lay out at the saved resolution, as hinted text changes width with it
    figure.set_layout_engine("constrained")
    grid = figure.subplots(len(height), columns, squeeze=False, height_ratios=height)
    for axes, (title, rows, draw) in zip(grid.flat, panels, strict=False):
        axes.set_title(plain(title, 112 // columns), fontsize=9)
        axes.tick_params(labelsize=8)
        axes.locator_params(nbins=5)
        axes.grid(alpha=0.25)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        draw(axes, rows)
        axes.xaxis.label.set_size(8)
        axes.yaxis.label.set_size(8)
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        entries |= {name: handle for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    if entries:
        names, form = sorted(entries), {"ncols": 4, "frameon": False, "fontsize": 8}
        figure.set_figheight(figure.get_figheight() + 0.24 * ceil(len(names) / 4) + 0.2)
        figure.legend([entries[name] for name in names], names, loc="outside lower center", **form)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # freeze the layout instead of recomputing it for each file
    return figure


def seeds_note(counts: pd.Series, noun: str = "seed") -> str:
    """n of a figure or table, with a warning if it is small."""
    known = counts[counts > 0]
    if known.empty:
        return "No finished run."
    low, high = int(known.min()), int(known.max())
    text = f"n = {low}{f' to {high}' if high > low else ''} {noun}{'s' * (high > 1)}"
    few = f" (warning: fewer than {stats.FEW_SEEDS})" if low < stats.FEW_SEEDS else ""
    return f"{text}{few}."


def file_name(*words: str) -> str:
    """A readable file name from any words; a checksum keeps names with special characters distinct."""
    parts = []
    for word in filter(None, words):
        plain_word = re.sub(r"[^A-Za-z0-9+._-]+", "-", word).strip("-.")
        parts.append(word if plain_word == word else f"{plain_word}-{crc32(word.encode(errors='replace')):08x}")
    return "_".join(parts)


def to_svg(figure: Figure) -> str:
    """The figure as an <svg> element, byte-identical every time."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def save_plot(folder: Path, plot: Plot) -> None:
    """Write a figure's data as CSV and the figure in all FORMATS, into an existing folder."""
    write_table(folder / f"{plot.name}.csv", plot.rows.drop(columns="label", errors="ignore"))
    for kind, options in FORMATS.items():
        with replacing_file(folder / f"{plot.name}.{kind}") as fresh:
            plot.figure.savefig(fresh, format=kind, **options)


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a table as CSV, atomically. Unknown values are empty."""
    counts = ("step", "best_step", "seed", "seeds", "episodes", "runs")
    with replacing_file(path) as fresh:
        whole = table.astype({name: "Int64" for name in counts if name in table})
        whole.to_csv(fresh, index=False, lineterminator="\n")


def draw_plots(runs: list[Run], made: dict[str, pd.DataFrame]) -> dict[str, list[Plot]]:
    """All figures, by section."""
    finished = [run for run in runs if run.finished and run.result.losses]
    losses = tables.losses([(run.named, run.result.losses) for run in finished])
    looks = looks_of(name for table in (made["summary"], made["curves"], losses) for name in labels(table))
    return {
        "scores": bar_plots(made["summary"], made["runs"], made["gates"], looks),
        "profiles": profile_plots(made["profiles"], made["aggregate"], looks),
        "lead": lead_plots(made["lead"]),
        "curves": curve_plots(made["curves"], looks),
        **{name: dot_plots(made["runs"], looks, name) for name in DOTS},
        "losses": loss_plots(losses, looks),
    }


def _plots(
    table: pd.DataFrame,
    name: str,
    caption: str,
    draw: Draw,
    columns: int = 3,
    panel: Sequence[str] = ("task", "quality"),
    count: str = "seeds",
    height: Callable[[pd.DataFrame], float] = lambda rows: HEIGHT,
) -> list[Plot]:
    """One figure per corruption, one panel per value of the columns `panel`; `count` is the column with its n."""
    rank = table["quality"].map({name: place for place, name in enumerate(QUALITIES)}).fillna(len(QUALITIES))
    ordered = table.assign(rank=rank, label=labels(table)).sort_values(["rank", "quality", "task"], kind="stable")
    plots = []
    for corruption in table["corruption"].unique():
        rows = ordered[ordered["corruption"] == corruption].drop(columns="rank")
        panels = [(" ".join(place), members, draw) for place, members in rows.groupby(list(panel), sort=False)]
        figure = sheet(panels, columns, [height(members) for _, members, _ in panels])
        text = f"{caption.format(corruption or 'any corruption')} {seeds_note(rows[count], count.removesuffix('s'))}"
        plots.append(Plot(file_name(name, corruption), text, figure, rows))
    return plots


def bar_plots(summary: pd.DataFrame, runs: pd.DataFrame, gates: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Final scores: one bar per method, one dot per run, and the data's score in the title."""
    data = {
        tuple(row[name] for name in SETTING): row["data_return"] / TASKS[row["task"]].score_divisor
        for row in gates.to_dict("records")
        if pd.notna(row["data_return"]) and row["task"] in TASKS
    }
    seeds = runs[runs["score"].notna()].assign(label=labels, kind="seed")
    dots = seeds.groupby([*SETTING, "label"])["score"].agg(list)

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
            names.append(plain(row["label"] + (f" ({row['absent']} missing)" if row["absent"] else ""), NAME_WIDTH))
        axes.set_yticks(range(len(rows)), names, fontsize=7)
        axes.set_ylim(max(len(rows), 4) - 0.4, -0.6)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("score")
        if (score := data.get(tuple(row[name] for name in SETTING))) is not None:
            axes.set_title(f"{axes.get_title()} (data score {score:.1f})", fontsize=9)
        if axes.dataLim.x0 >= 0:
            axes.set_xlim(left=0)

    caption = (
        "Final scores under {}. Bars: mean over seeds at the last evaluation; lines: 95% t intervals over seeds and "
        "episodes; dots: seeds; open diamonds: mean at the best evaluation, where the last is not the best; missing: "
        "seeds without a finished run. Methods without any are not drawn."
    )
    scored = summary[summary["score"].notna()].assign(kind="mean")
    plots = _plots(scored, "scores", caption, draw, 2, height=lambda rows: 0.3 + 0.2 * max(len(rows), 4))
    columns = ["kind", *SETTING, "label", "seed", "score", "low", "high", "seeds", "best_score", "missing"]
    for number, plot in enumerate(plots):
        both = pd.concat([plot.rows, seeds[seeds["corruption"] == plot.rows["corruption"].iloc[0]]])
        plots[number] = plot._replace(rows=both.reindex(columns=columns).rename(columns={"label": "method"}))
    return plots


def _by_label(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    return ((str(name), mine) for name, mine in rows.groupby("label", sort=False))


def _lines(axes: Axes, rows: pd.DataFrame, looks: dict[str, int], x: str, y: str, **more: Any) -> None:
    """Draw a line per label, with a band if the rows have one."""
    for name, mine in _by_label(rows):
        look = style(looks[name]) | more
        draw, fill = (axes.step, {"step": more["where"]}) if "where" in more else (axes.plot, {})
        draw(mine[x], mine[y], lw=1.3, label=plain(name, NAME_WIDTH), **look)
        if "low" in mine:
            band = mine["low"].astype(float), mine["high"].astype(float)
            axes.fill_between(mine[x], *band, color=look["color"], alpha=0.1, lw=0, **fill)


def curve_plots(curves: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Score over updates, one line per method; none where each was evaluated once."""
    several = curves.groupby(list(CONDITION))["step"].transform("nunique") > 1
    curves = curves[several.groupby([curves[name] for name in SETTING]).transform("any")]

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        _lines(axes, rows, looks, "step", "score")
        axes.set(xlabel="gradient updates", ylabel="score", xlim=(0, None))
        axes.set_ylim(1.05 * min(0.0, rows["low"].min()), 1.05 * max(rows["high"].max(), 0.0) or 1.0)

    caption = "Learning curves under {}: mean over the seeds evaluated there, bands from the lowest to the highest "
    caption += "seed, including unfinished runs."
    return _plots(curves, "curves", caption, draw)


def loss_plots(losses: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Action loss over pretraining steps, one line per method."""

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        _lines(axes, rows, looks, "step", "action_loss", marker=None)
        axes.set(xlabel="gradient steps", ylabel="action loss")

    return _plots(losses, "losses", "Action loss of pretraining under {}, mean over finished runs.", draw)


def profile_plots(profiles: pd.DataFrame, aggregate: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Fraction of runs above a score: one panel per corruption, one line per method."""
    if profiles.empty:
        return []

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        _lines(axes, rows, looks, "threshold", "share", marker=None, where="post")
        axes.set(xlabel="score", ylabel="share of runs above the score", ylim=(0, 1.02))
        axes.set_xlim(rows["threshold"].min(), rows["threshold"].max())

    shown = profiles.assign(label=profiles["method"])
    for (name, tasks, all_tasks), part in profiles.groupby(["method", "tasks", "of_tasks"]):
        if tasks < all_tasks:
            marked = f"{name} ({tasks} of {all_tasks} tasks)"
            shown.loc[part.index, "label"], looks = marked, looks | {marked: looks[str(name)]}
    caption = (
        "Performance profiles: share of the runs of all tasks and seeds whose final score is above a threshold, with "
        f"pointwise 95% bands. {seeds_note(aggregate['seeds'])}"
    )
    panels = [(str(corruption), members, draw) for corruption, members in shown.groupby("corruption", sort=False)]
    return [Plot("profiles", caption, sheet(panels, 2), shown)]


def lead_plots(leads: pd.DataFrame) -> list[Plot]:
    """Differences over the pretraining budget, one line per difference."""
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
            for where, top, seeds in zip(place, middle + reach[1], mine["seeds"], strict=True):
                axes.annotate(str(seeds), (where, top), (0, 4), textcoords="offset points", ha="center", fontsize=7)
        axes.axhline(0, color="black", lw=0.8)
        axes.set_xscale("log")
        ticks = dict(zip(seen, rows["steps"].map("{:,}".format) + "\nx " + rows["stacks"].astype(str), strict=True))
        axes.set_xticks(list(ticks), list(ticks.values()))
        axes.minorticks_off()
        axes.set_xlim(min(ticks) / 1.5, 1.5 * max(ticks))
        axes.set(xlabel="pretraining: steps x stacks in a batch", ylabel="lead, % of the data's return")

    caption = (
        "Lead by pretraining budget under {}: difference of mean returns, each in % of the mean return of "
        "its own data, with the number of seeds, and 95% t intervals over seeds and episodes if both sides have two."
    )
    return _plots(leads, "lead", caption, draw, 2)


DOTS = {
    "probes": (
        dict(zip(PROBES, ("pose", "velocity"), strict=True)),
        "probe error, % of s.d.",
        "the error of a linear probe of pose and of velocity, in percent of a standard deviation",
    ),
    "errors": (
        dict(zip(ACTION_ERRORS, ("on the data", "in closed loop"), strict=True)),
        "action error (MSE)",
        "the mean squared difference of its actions from the data's actor's, on the data and in closed loop",
    ),
}
"""Scatter plots of returns by file name: panel titles by measure, the axis label, and a longer description."""


def dot_plots(runs: pd.DataFrame, looks: dict[str, int], name: str) -> list[Plot]:
    """Return over probe errors or action errors: one dot per run, two panels per setting."""
    measures, axis, description = DOTS[name]

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        for label, mine in _by_label(rows.dropna(subset="error")):
            look = style(looks[label])
            marks = {"marker": look["marker"], "ec": "white", "lw": 0.5, "rasterized": len(rows) > MANY}
            axes.scatter(mine["error"], mine["return"], 26, look["color"], label=plain(label, NAME_WIDTH), **marks)
        axes.set(xlabel=axis, ylabel="return")
        axes.update_datalim([(0, 0)])
        axes.autoscale_view()

    known = runs[runs["return"].notna() & runs[list(measures)].notna().any(axis=1)]
    known = known.assign(runs=known.groupby("corruption")["corruption"].transform("size"))
    shown = known.rename(columns=measures).melt(
        [*CONDITION, "seed", "return", "runs"], [*measures.values()], "error of", "error"
    )
    caption = f"Final return under {{}} against {description}; further left is better. One dot per run."
    return _plots(shown, name, caption, draw, 4, ("task", "quality", "error of"), "runs")
