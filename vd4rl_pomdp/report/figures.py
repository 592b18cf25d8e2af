"""The figures of a report, one panel a task and quality: each shows a table of `report.tables`."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.load import ACTION_ERRORS, COSTS, PROBES, REFERENCES, SETTING, labels
from vd4rl_pomdp.runs.files import replacing_file

mpl.rcParams["svg.hashsalt"] = "vd4rl-pomdp"
mpl.rcParams["pdf.fonttype"] = 42
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette, which colour-blind readers can tell apart."""
DASHES, MARKERS, HATCHES = ("-", "--", ":", "-."), "osD^", ("", "////", "....", "xxxx")
"""As many as there are rounds through the colours before looks repeat."""
LOOKS = (
    *("mik+a", "mik", "acro", "ah+a", "fj+a", "supervised+a", "random", "ah", "fj", "supervised", "state"),
    *("curl", "driml", "homer", "one_step_inverse", "no_history", "bc", "drq_bc"),
)
"""The package's methods in the order of their looks, which are the same in every report: the first differ in colour."""
QUALITIES = ("expert", "medium_expert", "medium")
"""Those of the paper's figures, which come first."""
FORMATS: dict[str, dict[str, Any]] = {"png": {"dpi": 150}, "pdf": {"metadata": {"CreationDate": None}}}
"""Files of a figure, beside the SVG in the page."""
WIDTH = 10.0
"""Of a figure, in inches."""
NAME_WIDTH = 34
"""Characters of a method's name in a figure before it is wrapped."""
MANY = 300
"""Dots of a figure, above which they are one picture within it."""
PUBLISHED = {"bc": (":", "BC"), "drq_bc": ("--", "DrQ+BC")}
"""Published methods that are drawn as lines: their dashes and their names."""
Draw = Callable[[Axes, pd.DataFrame], None]


@dataclass(frozen=True)
class Plot:
    """A figure with all that is told of it."""

    name: str
    """Of its files."""
    caption: str
    words: str
    """What it shows, for those who do not see it."""
    figure: Figure
    rows: pd.DataFrame
    """What it shows, as its CSV file holds it."""


def looks_of(names: Iterable[str]) -> dict[str, int]:
    """Numbers of looks by label: the package's methods have their own, others those that follow."""
    others = sorted(set(names) - set(LOOKS), key=lambda name: (name.partition(",")[0] in REFERENCES, name))
    return {name: number for number, name in enumerate([*LOOKS, *others])}


def style(number: int) -> dict[str, Any]:
    """Colour, dashes and marker of the method of this number."""
    turn = number // len(COLOURS)
    return {
        "color": COLOURS[number % len(COLOURS)],
        "linestyle": DASHES[turn % len(DASHES)],
        "marker": MARKERS[turn % len(MARKERS)],
        "markersize": 4,
    }


def sheet(panels: Sequence[tuple[str, pd.DataFrame, Draw]], columns: int = 3, heights: Sequence[float] = ()) -> Figure:
    """A figure with a panel for each title, row by row, and below them the legend of what they name.

    Args:
        panels: title, rows and what draws them.
        columns: panels in a row, at most.
        heights: of each panel, in inches.
    """
    columns = min(columns, len(panels))
    height = [max(part) for part in _parts(heights or [2.1] * len(panels), columns)]
    figure = Figure(figsize=(WIDTH if columns > 1 else 0.66 * WIDTH, sum(height) + 0.6 * len(height)))
    figure.set_layout_engine("constrained")
    grid = figure.subplots(len(height), columns, squeeze=False, height_ratios=height)
    for axes, (title, rows, draw) in zip(grid.flat, panels, strict=False):
        axes.set_title(plain(title, 96 // columns), fontsize=9)
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
    entries = {
        name: handle for axes in figure.axes for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if entries:
        longest = max(len(line) for name in entries for line in name.split("\n"))
        count = max(1, min(len(entries), int(figure.get_figwidth() / (0.55 + 0.08 * longest))))
        extra = 0.2 * sum(1 + name.count("\n") for name in entries) / count + 0.2
        figure.set_figheight(figure.get_figheight() + extra)
        order = sorted(entries)
        figure.legend(
            [entries[name] for name in order], order, loc="outside lower center", ncols=count, frameon=False, fontsize=8
        )
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # places are final: each of the files would find them again
    return figure


def _parts(values: Sequence[float], size: int) -> list[Sequence[float]]:
    return [values[i : i + size] for i in range(0, len(values), size)]


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
    summary: pd.DataFrame,
    runs: pd.DataFrame,
    data: dict[tuple[str, str], float],
    looks: dict[str, int],
    published: Sequence[dict[str, str]],
) -> list[Plot]:
    """Final scores: one figure a corruption, a panel for each task and quality, a bar for each method.

    Args:
        summary: scores of every condition.
        runs: table of runs, whose final scores are the dots.
        data: the data's return by task and quality, which stands beside their names.
        looks: numbers of all labels in `style`.
        published: scores by `env` and `dataset` that were reached on V-D4RL's own sets; drawn where nothing is hidden.
    """
    plots = []
    scored = summary[summary["score"].notna()]
    seeds = runs[runs["score"].notna()].assign(label=lambda table: labels(table))
    for corruption, rows, places in _figures(scored):
        lines = published if corruption == "none" else []

        def draw(axes: Axes, mine: pd.DataFrame, lines: Sequence[dict[str, str]] = lines) -> None:
            place = mine[list(SETTING)].iloc[0].tolist()
            here = seeds[(seeds[list(SETTING)] == place).all(axis=1)]
            _bars(axes, mine, here.groupby("label")["score"].agg(list).to_dict(), looks)
            for row in lines:
                if [row["env"], row["dataset"]] == place[:2]:
                    _published(axes, row)

        panels = [(_title(title, members, data), members, draw) for title, members in places]
        figure = sheet(panels, 2, [0.3 + 0.2 * max(len(members), 4) for _, members in places])
        dots = seeds[seeds["corruption"] == corruption].assign(kind="seed")
        shown = pd.concat([rows.assign(kind="mean"), dots])
        columns = ["kind", *SETTING, "label", "seed", "score", "low", "high", "seeds", "best_score", "missing"]
        caption = (
            f"Final scores under {corruption}. Bars: mean over seeds at the last evaluation; lines: 95% t intervals "
            "over seeds and episodes; dots: seeds; open diamonds: mean at the best evaluation, where the last is not "
            f"the best; ×2: two seeds are missing, unfinished or diverged. {seeds_note(rows['seeds'])}"
        )
        if lines:
            caption += " Lines: V-D4RL's published scores, on its own sets of these names, with nothing hidden."
        table = shown.reindex(columns=columns).rename(columns={"label": "method"}).astype({"seed": "Int64"})
        plots.append(Plot(file_name("scores", corruption), caption, _told(places, "score"), figure, table))
    return plots


def _title(title: str, rows: pd.DataFrame, data: dict[tuple[str, str], float]) -> str:
    known = data.get((rows["task"].iloc[0], rows["quality"].iloc[0]))
    return title if known is None else f"{title} (data return {known:.0f})"


def _bars(axes: Axes, rows: pd.DataFrame, seeds: dict[str, list[float]], looks: dict[str, int]) -> None:
    """Bars from top to bottom in the order of the rows, with intervals, seeds and best evaluations."""
    for place, row in enumerate(rows.to_dict("records")):
        look = looks[row["label"]]
        turn = HATCHES[look // len(COLOURS) % len(HATCHES)]
        colour = COLOURS[look % len(COLOURS)]
        axes.barh(place, row["score"], 0.75, color=colour, hatch=turn, edgecolor="white", linewidth=0, alpha=0.55)
        axes.hlines(place, row["low"], row["high"], color="black", lw=1.4, zorder=3)
        dots = seeds.get(row["label"], [])
        spread = np.linspace(-0.2, 0.2, len(dots)) if len(dots) > 1 else 0.0
        axes.scatter(dots, np.full(len(dots), place) + spread, 7, color=colour, ec="black", lw=0.4, zorder=4)
        if row["best_score"] > row["score"]:
            axes.scatter(row["best_score"], place, 16, marker="D", fc="none", ec="black", lw=0.7, zorder=4)
    names = [
        plain(f"{name} (×{absent})" if absent else name, NAME_WIDTH)
        for name, absent in zip(rows["label"], rows["absent"], strict=True)
    ]
    axes.set_yticks(range(len(rows)), names, fontsize=7)
    axes.set_ylim(max(len(rows), 4) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("score")
    if axes.dataLim.x0 >= 0:
        axes.set_xlim(left=0)


def _published(axes: Axes, row: dict[str, str]) -> None:
    """Published scores as lines, named at their upper end."""
    for name, (dashes, shown) in PUBLISHED.items():
        value = float(row[name])
        axes.axvline(value, color="black", lw=0.9, linestyle=dashes, zorder=1)
        axes.text(value, 1.0, shown, transform=axes.get_xaxis_transform(), fontsize=6, ha="right", va="bottom")


def curve_plots(curves: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Score against updates, one figure a corruption, one line a method."""

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        for name, mine in _by_label(rows):
            look = style(looks[name])
            axes.plot(mine["step"], mine["score"], lw=1.3, label=plain(name, NAME_WIDTH), **look)
            axes.fill_between(mine["step"], mine["low"], mine["high"], color=look["color"], alpha=0.08, lw=0)
        axes.set(xlabel="gradient updates", ylabel="score", xlim=(0, None))
        axes.set_ylim(1.05 * min(0.0, rows["low"].min()), 1.05 * max(rows["high"].max(), 0.0) or 1.0)

    plots = []
    for corruption, rows, places in _figures(curves):
        caption = (
            f"Learning curves under {corruption}: mean over the seeds that have got there, bands from the lowest "
            f"to the highest seed, unfinished runs among them. {seeds_note(rows['seeds'])}"
        )
        figure = sheet([(title, members, draw) for title, members in places])
        plots.append(Plot(file_name("curves", corruption), caption, _told(places, "score"), figure, rows))
    return plots


def profile_plots(profiles: pd.DataFrame, aggregate: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Share of runs above a score, one panel a corruption, one line a method."""
    if profiles.empty:
        return []

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        for name, mine in rows.groupby("method", sort=False):
            look = style(looks[str(name)]) | {"marker": None}
            axes.step(
                mine["threshold"], mine["share"], where="post", lw=1.3, label=plain(str(name), NAME_WIDTH), **look
            )
            band = mine["low"].astype(float), mine["high"].astype(float)
            axes.fill_between(mine["threshold"], *band, step="post", color=look["color"], alpha=0.12, lw=0)
        axes.set(xlabel="score", ylabel="share of runs above it", ylim=(0, 1.02))
        axes.set_xlim(rows["threshold"].min(), rows["threshold"].max())

    panels = [(str(corruption), members, draw) for corruption, members in profiles.groupby("corruption", sort=False)]
    lacking = aggregate[(aggregate["tasks"] < aggregate["of_tasks"]) & (aggregate["tasks"] > 0)]
    partial = zip(lacking["corruption"], labels(lacking), lacking["tasks"], lacking["of_tasks"], strict=True)
    caption = (
        "Performance profiles: share of the runs of all tasks and seeds whose final score is above a threshold, with "
        f"pointwise 95% bands. {seeds_note(aggregate['seeds'])} "
        + "; ".join(f"{name} under {corruption}: {tasks} of {of} tasks" for corruption, name, tasks, of in partial)
    ).strip()
    middle = profiles.groupby(["corruption", "method"], sort=False).nth(50)
    words = "; ".join(
        f"{row['corruption']}: {row['method']} {row['share']:.2f} above {row['threshold']:g}"
        for row in middle.to_dict("records")
    )
    return [Plot("profiles", caption, words, sheet(panels, 2), profiles)]


def dot_plots(runs: pd.DataFrame, looks: dict[str, int]) -> dict[str, list[Plot]]:
    """Return against what probes read from representations, and against how actions err: a dot a run."""
    return {
        "probes": _dots(
            runs,
            looks,
            "probes",
            dict(zip(PROBES, ("pose", "velocity"), strict=True)),
            "error, %",
            "the error of a linear probe of pose and of velocity, in percent of a standard deviation",
        ),
        "errors": _dots(
            runs,
            looks,
            "errors",
            dict(zip(ACTION_ERRORS, ("actions on the data", "actions in closed loop"), strict=True)),
            "mean squared error",
            "the mean squared difference of its actions from the data's actor's, on the data and in closed loop",
        ),
    }


def _dots(
    runs: pd.DataFrame, looks: dict[str, int], name: str, measures: dict[str, str], axis: str, words: str
) -> list[Plot]:
    """One figure a corruption, two panels a setting.

    Args:
        runs: table of runs.
        looks: numbers of all labels in `style`.
        name: of the files.
        measures: titles of the panels, by the measures' columns.
        axis: what the measures are, in short.
        words: the same at length.
    """

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
        caption = (
            f"Final return under {corruption} against {words}; further left is better. One dot a run, n = {len(rows)} "
            "runs."
        )
        shown = rows[[*SETTING, "label", "seed", *measures, "return"]].rename(columns={"label": "method"})
        best = rows.sort_values("return", ascending=False).head(20).to_dict("records")
        told = "; ".join(
            f"{row['task']} {row['quality']}, {row['label']}, seed {row['seed']}: return {row['return']:.0f}, "
            + ", ".join(f"{title} {row[column]:.3g}" for column, title in measures.items() if not np.isnan(row[column]))
            for row in best
        )
        figure = sheet(panels, 4 if len(places) > 1 else 2)
        plots.append(
            Plot(file_name(name, corruption), caption, f"The runs of the highest returns: {told}.", figure, shown)
        )
    return plots


def cost_plots(costs: pd.DataFrame) -> list[Plot]:
    """Mean minutes of pretraining and fine-tuning by method, one beside the other."""
    rows = costs[costs[list(COSTS)].notna().any(axis=1)]
    if rows.empty:
        return []

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        left = np.zeros(len(rows))
        for cost, stage, colour in zip(COSTS, ("pretraining", "fine-tuning"), COLOURS, strict=False):
            minutes = rows[cost].fillna(0).to_numpy() / 60
            axes.barh(np.arange(len(rows)), minutes, 0.7, left=left, color=colour, label=stage)
            left = left + minutes
        axes.set_yticks(range(len(rows)), [plain(name, 2 * NAME_WIDTH) for name in rows["method"]])
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)

    caption = (
        "Cost of pretraining and fine-tuning: mean wall-clock time over a method's finished runs of all settings, on "
        f"the machines of the table. {seeds_note(rows['runs'], 'run')}"
    )
    words = "; ".join(
        f"{row['method']} {' and '.join(stats.number(row[cost], 0) for cost in COSTS)} seconds"
        for row in rows.to_dict("records")
    )
    figure = sheet([("mean minutes of a run", rows, draw)], 1, [0.4 + 0.2 * len(rows)])
    return [Plot("costs", caption, words, figure, rows)]


def loss_plots(losses: pd.DataFrame, looks: dict[str, int]) -> list[Plot]:
    """Action loss of pretraining against steps, one figure a corruption, one line a method."""

    def draw(axes: Axes, rows: pd.DataFrame) -> None:
        for name, mine in _by_label(rows):
            look = style(looks[name]) | {"marker": None}
            axes.plot(mine["step"], mine["action_loss"], lw=1.3, label=plain(name, NAME_WIDTH), **look)
        axes.set(xlabel="gradient steps", ylabel="action loss")

    plots = []
    for corruption, rows, places in _figures(losses):
        caption = (
            f"Action loss of pretraining under {corruption or 'any corruption'}, mean over finished runs. "
            f"{seeds_note(rows['seeds'])}"
        )
        figure = sheet([(title, members, draw) for title, members in places])
        plots.append(Plot(file_name("losses", corruption), caption, _told(places, "action_loss", 3), figure, rows))
    return plots


def seeds_note(counts: pd.Series, noun: str = "seed") -> str:
    """n of what a figure or table shows, and a warning where it is small."""
    known = counts[counts > 0]
    if known.empty:
        return "No finished run."
    low, high = int(known.min()), int(known.max())
    text = f"n = {low}{f' to {high}' if high > low else ''} {noun}{'s' * (high > 1)}"
    few = f" (warning: fewer than {stats.FEW_SEEDS})" if low < stats.FEW_SEEDS else ""
    return f"{text}{few}."


def file_name(*words: str) -> str:
    """A name for files that says what is in them, whatever a corruption is called, and differs where the words do."""
    parts = []
    for word in filter(None, words):
        plain_word = re.sub(r"[^A-Za-z0-9+._-]+", "-", word).strip("-.")
        parts.append(word if plain_word == word else f"{plain_word}-{crc32(word.encode(errors='replace')):08x}")
    return "_".join(parts)


def to_svg(figure: Figure) -> str:
    """The figure as an <svg> element, the same bytes every time."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def save_plot(folder: Path, plot: Plot) -> None:
    """Write a figure's files into a folder that exists: what it shows as CSV, and itself in all FORMATS."""
    write_table(folder / f"{plot.name}.csv", plot.rows.drop(columns="label", errors="ignore"))
    for kind, options in FORMATS.items():
        with replacing_file(folder / f"{plot.name}.{kind}") as fresh:
            plot.figure.savefig(fresh, format=kind, **options)


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a table as CSV, so that a reader sees it whole or not at all; what is not known is empty."""
    counts = ("step", "best_step", "seed", "seeds", "episodes", "runs")
    with replacing_file(path) as fresh:
        table.astype({name: "Int64" for name in counts if name in table}).to_csv(
            fresh, index=False, lineterminator="\n"
        )
