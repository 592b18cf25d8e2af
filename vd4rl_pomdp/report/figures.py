"""How figures look, what they are called, and their files; `report.plots` draws those of a report."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any
from zlib import crc32

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.load import REFERENCES
from vd4rl_pomdp.runs.files import replacing_file

mpl.rcParams["svg.hashsalt"] = "vd4rl-pomdp"  # ids in an SVG are random otherwise, and no two pages are alike
mpl.rcParams["pdf.fonttype"] = 42  # TrueType: publishers refuse Type 3
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette, which colour-blind readers can tell apart."""
DASHES, MARKERS, HATCHES = ("-", "--", ":", "-."), "osD^", ("", "////", "....", "xxxx")
"""As many as there are rounds through the colours before looks repeat."""
LOOKS = (
    *("mik+a", "mik", "acro", "ah+a", "fj+a", "supervised+a", "random", "ah", "fj", "supervised", "state"),
    *("curl", "driml", "homer", "one_step_inverse", "no_history", "bc", "drq_bc", "acdf", "smwm"),
    *("supervised_picture", "integrator"),
)
"""The package's methods in the order of their looks, which are the same in every report: the first differ in colour."""
DPI = 150
FORMATS: dict[str, dict[str, Any]] = {"png": {"dpi": DPI}, "pdf": {"metadata": {"CreationDate": None}}}
"""Files of a figure, beside the SVG in the page."""
WIDTH = 10.0
"""Of a figure, in inches."""
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
    sizes = list(heights) or [2.1] * len(panels)
    height = [max(sizes[i : i + columns]) for i in range(0, len(panels), columns)]
    size = WIDTH if columns > 1 else 0.66 * WIDTH, sum(height) + 0.6 * len(height)
    figure = Figure(figsize=size, dpi=DPI)  # laid out as saved: hinted text has another width at another resolution
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
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        entries |= {name: handle for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    if entries:
        names = sorted(entries)
        figure.set_figheight(figure.get_figheight() + 0.24 * ceil(len(names) / 4) + 0.2)
        figure.legend(
            [entries[name] for name in names], names, loc="outside lower center", ncols=4, frameon=False, fontsize=8
        )
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # places are final: each of the files would find them again
    return figure


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
        whole = table.astype({name: "Int64" for name in counts if name in table})
        whole.to_csv(fresh, index=False, lineterminator="\n")
