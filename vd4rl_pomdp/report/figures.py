"""What all figures of a report share: the look of a method, panels with one legend below, and files."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.runs.files import Row, replacing_file, write_csv

mpl.rcParams["svg.hashsalt"] = "vd4rl-pomdp"
mpl.rcParams["pdf.fonttype"] = 42
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette, which colour-blind readers can tell apart."""
MARKERS = "osD^vPX*<"
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
"""As the numbers of colours, markers and dashes have no common divisor, the first 252 methods differ in their looks."""
FORMATS: dict[str, dict[str, Any]] = {"png": {"dpi": 150}, "pdf": {"metadata": {"CreationDate": None}}}
"""Files of a figure, beside the SVG in the page."""
WIDTH = 10.0
"""Of a figure with several columns of panels, in inches."""
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP, _TITLE = 0.55, 0.1, 0.42, 0.5, 0.45, 0.42
_ENTRY, _LETTER, _LINE = 0.55, 0.075, 0.2
"""A legend's entry without its text, one letter of it, and a line, in inches."""
_TITLE_LETTER, REMARK_LINE = 0.075, 0.11
"""A letter of a panel's title, and a line of a remark below it, in inches."""
REMARK_WIDTH, _NOTES = 64, 4
"""Characters of a remark, and lines of them in a panel, of which the rest is in the caption's table."""
NAME_WIDTH = 34
"""Characters of a method's name in a figure before it is wrapped."""


@dataclass(frozen=True)
class Plot:
    """A figure with all that is told of it."""

    name: str
    """Of its files."""
    caption: str
    words: str
    """What it shows, for those who do not see it."""
    figure: Figure
    rows: list[Row]
    """What it shows, as its CSV file holds it."""


def style(number: int) -> dict[str, Any]:
    """Colour, dashes and marker of the method of this number."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "linestyle": DASHES[number % len(DASHES)],
        "marker": MARKERS[number % len(MARKERS)],
    }


def panels(
    titles: Sequence[str], looks: Mapping[str, int], columns: int, height: float = 2.1, room: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each title, row by row, and below them the legend of all methods.

    Args:
        titles: of the panels; none is drawn where one is empty.
        looks: entries of the legend, and their numbers in `style`; without any there is no legend.
        columns: panels in a row.
        height: of a panel, in inches.
        room: more space below each row of panels, in inches.
    """
    columns = min(columns, len(titles))
    rows = ceil(len(titles) / columns)
    width = WIDTH if columns > 1 else 0.66 * WIDTH
    legend, entries = _legend(looks, width)
    below = _BOTTOM + room
    full = _TOP + rows * height + (rows - 1) * (_TITLE + below) + below + legend
    figure = Figure(figsize=(width, full))
    wide = (width - _LEFT - _RIGHT - (columns - 1) * (_GAP + 0.1)) / columns
    axes = []
    for number, title in enumerate(titles):
        row, column = divmod(number, columns)
        left, top = _LEFT + column * (wide + _GAP + 0.1), _TOP + row * (height + _TITLE + below)
        if title:
            place = (left / width, 1 - (top + height) / full, wide / width, height / full)
            axes.append(_panel(figure, place, plain(title, int(wide / _TITLE_LETTER))))
    if looks:
        figure.legend(**entries, loc="lower center", frameon=False, fontsize=8)
    return figure, axes


def _legend(looks: Mapping[str, int], width: float) -> tuple[float, dict[str, Any]]:
    """Height of a legend in inches, and what matplotlib is told of it."""
    if not looks:
        return 0.0, {}
    names = [plain(name, NAME_WIDTH) for name in looks]
    longest = max(len(line) for name in names for line in name.split("\n"))
    columns = max(1, min(len(names), int(width / (_ENTRY + _LETTER * longest))))
    lines = [1 + name.count("\n") for name in names]
    tallest = max(map(sum, np.array_split(lines, columns)))  # matplotlib fills column by column, as evenly
    handles = [
        Line2D([], [], markersize=5, label=name, **style(look))
        for name, look in zip(names, looks.values(), strict=True)
    ]
    return 0.15 + _LINE * tallest, {"handles": handles, "ncols": columns, "handlelength": 3}


def _panel(figure: Figure, place: tuple[float, float, float, float], title: str) -> Axes:
    axes = figure.add_axes(place)
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.locator_params(nbins=5)
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def remark(axes: Axes, notes: Sequence[str]) -> None:
    """Say below a panel what it does not show; `panels` was given the room."""
    text = "\n".join(plain(note, REMARK_WIDTH).partition("\n")[0] for note in shortened(notes))
    axes.annotate(
        text, (0, 0), (0, -30), "axes fraction", "offset points", va="top", fontsize=6.5, color="#444", linespacing=1.1
    )


def shortened(notes: Sequence[str]) -> list[str]:
    """The first of some notes, and how many more there are."""
    return [*notes[:_NOTES], *([f"and {len(notes) - _NOTES} more"] if len(notes) > _NOTES else [])]


def room_for(notes: Iterable[Sequence[str]]) -> float:
    """Inches below each row of panels that the longest of their remarks takes."""
    return REMARK_LINE * max((len(shortened(part)) for part in notes), default=0)


def seeds_note(rows: Sequence[Row], name: str = "seeds", noun: str = "seed") -> str:
    """n of what a figure or table shows, and a warning where it is small."""
    counts = [row[name] for row in rows if row[name]]
    if not counts:
        return "No finished run."
    low, high = min(counts), max(counts)
    text = f"n = {low}{f' to {high}' if high > low else ''} {noun}{'s' * (high > 1)}"
    few = f" (warning: fewer than {stats.FEW_SEEDS})" if low < stats.FEW_SEEDS else ""
    return f"{text}{few}."


def span(values: Iterable[float]) -> tuple[float, float]:
    """Lowest and highest of some values and zero; 0 and 1 where all are zero."""
    known = [0.0, *values]
    low, high = min(known), max(known)
    return (low, high) if high > low else (0.0, 1.0)


def file_name(*words: str) -> str:
    """A name for files that says what is in them, whatever a corruption is called, and differs where the words do."""
    return "_".join(map(_plain_word, filter(None, words)))


def _plain_word(word: str) -> str:
    plain_word = re.sub(r"[^A-Za-z0-9+._-]+", "-", word).strip("-.")
    return plain_word if plain_word == word else f"{plain_word}-{crc32(word.encode(errors='replace')):08x}"


def to_svg(figure: Figure) -> str:
    """The figure as an <svg> element, the same bytes every time."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def save_plot(folder: Path, plot: Plot) -> None:
    """Write a figure's files into a folder that exists: what it shows as CSV, and itself in all FORMATS."""
    write_csv(folder / f"{plot.name}.csv", list(plot.rows[0]), plot.rows)
    for kind, options in FORMATS.items():
        with replacing_file(folder / f"{plot.name}.{kind}") as fresh:
            plot.figure.savefig(fresh, format=kind, **options)


def grid_of(rows: Sequence[Row], order: Callable[[str], Any]) -> tuple[list[tuple[str, str]], int]:
    """Places of panels, row by row, one column a task and one row a quality, and the number of columns.

    Args:
        rows: with `task` and `quality`.
        order: of the qualities.

    Returns:
        Task and quality of every place, and the number of tasks.
    """
    tasks = sorted({str(row["task"]) for row in rows})
    qualities = sorted({str(row["quality"]) for row in rows}, key=order)
    return [(task, quality) for quality in qualities for task in tasks], len(tasks)
