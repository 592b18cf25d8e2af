"""The paper's figures of returns: one for each corruption, a panel for each task and quality, a bar for each method."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report.figures import COLOURS, Plot, file_name, grid_of, panels, seeds_note
from vd4rl_pomdp.report.load import SETTING
from vd4rl_pomdp.report.tables import by_label, grouped, label
from vd4rl_pomdp.runs.files import Row

PAPER_QUALITIES = ("expert", "medium_expert")
"""Those of the paper's figures, which come first; its appendix adds medium."""
_HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "----")
_NAME_WIDTH = 22
_LEGEND = (
    "Methods in the order of their names. Bars: mean over seeds at the last evaluation; lines: 95% t intervals over "
    "seeds and episodes; dots: seeds; open diamonds: mean at the best evaluation, where the last is not the best; a "
    "cross with a number: so many seeds are missing, unfinished or diverged."
)
_PUBLISHED = {"bc": (":", "BC"), "drq_bc": ("--", "DrQ+BC")}
"""Published methods that are drawn as lines: their dashes and their names."""
_WIDEST = 4
"""Panels in a row, at most."""
_COLUMNS = ("kind", *SETTING, "method", "seed", "score", "low", "high", "seeds", "best_score", "missing")


def bar_plots(
    summary: list[Row],
    runs: list[Row],
    gates: list[Row],
    looks: dict[str, int],
    published: list[dict[str, str]],
) -> list[Plot]:
    """One figure a corruption.

    Args:
        summary: scores of every condition.
        runs: table of runs, whose final scores are the dots.
        gates: table of gates, of which each panel names the data's return.
        looks: numbers of all methods of the report in `style`.
        published: scores by `env` and `dataset` that were reached on V-D4RL's own sets; drawn where the
            corruption is none.
    """
    plots = []
    data = {(row["task"], row["quality"]): row["data_return"] for row in gates if row["data_return"] is not None}
    for (corruption,), members in grouped(summary, ("corruption",)):
        mine = [row for row in runs if row["corruption"] == corruption and row["score"] is not None]
        lines = published if corruption == "none" else []
        plots.append(_plot(corruption, members, mine, data, looks, lines))
    return plots


def _plot(
    corruption: str,
    summary: list[Row],
    runs: list[Row],
    data: dict[tuple[str, str], float],
    looks: dict[str, int],
    published: list[dict[str, str]],
) -> Plot:
    places, tasks = grid_of(summary, _quality_order)
    columns = min(tasks, _WIDEST)
    by_place = {key: members for key, members in grouped(summary, ("task", "quality"))}
    seeds = {key: members for key, members in grouped(runs, ("task", "quality"))}
    names = {label(row) for row in summary}
    looks = {name: look for name, look in looks.items() if name in names}
    longest = max(len(line) for name in names for line in plain(name, _NAME_WIDTH).split("\n"))
    titles = [_title(*place, data.get(place)) if place in by_place else "" for place in places]
    figure, axes = panels(titles, {}, columns, room=max(0.0, 0.06 * longest - 0.25))
    shown = [place for place in places if place in by_place]
    for panel, place in zip(axes, shown, strict=True):
        _bars(panel, by_place[place], seeds.get(place, []), looks)
        for row in published:
            if (row["env"], row["dataset"]) == place:
                _lines(panel, row)
    for panel in axes if "" in titles else axes[::columns]:
        panel.set_ylabel("score", fontsize=8)
    of_seeds = [{k: row[k] for k in (*SETTING, "seed", "score")} | {"method": label(row)} for row in runs]
    rows = [*map(_row, summary), *({"kind": "seed"} | row for row in of_seeds)]
    return Plot(
        file_name("scores", corruption),
        f"Final scores under {corruption}. {_LEGEND} {seeds_note(summary)}{_published_note(published)}",
        "; ".join(map(_words, summary)),
        figure,
        [dict.fromkeys(_COLUMNS) | row for row in rows],
    )


def _title(task: str, quality: str, data_return: float | None) -> str:
    return f"{task} {quality}" + ("" if data_return is None else f" (data return {data_return:.0f})")


def _row(row: Row) -> Row:
    return {"kind": "mean", "method": label(row)} | {k: row[k] for k in _COLUMNS if k in row and k != "method"}


def _quality_order(quality: str) -> tuple[int, str]:
    return (PAPER_QUALITIES.index(quality) if quality in PAPER_QUALITIES else len(PAPER_QUALITIES), quality)


def _bars(axes: Axes, summary: list[Row], runs: list[Row], looks: dict[str, int]) -> None:
    """A panel's bars, at the same place for each method in all panels, and coloured by the numbers of their looks."""
    places = {name: place for place, name in enumerate(looks)}
    scored = [row | {"place": places[label(row)]} for row in summary if row["score"] is not None]
    _draw(axes, scored, [looks[label(row)] for row in scored])
    seeds = dict(by_label(runs))
    _dots(axes, seeds, places, looks)
    _crosses(axes, summary, seeds, places)
    axes.set_xticks(range(len(looks)), [plain(name, _NAME_WIDTH) for name in looks], rotation=90, fontsize=7)
    axes.set_xlim(-0.6, len(looks) - 0.4)
    if axes.dataLim.y0 >= 0:
        axes.set_ylim(bottom=0)
    axes.grid(axis="x", visible=False)


def _draw(axes: Axes, rows: list[Row], looks: list[int]) -> None:
    """Bars with their intervals and best evaluations."""
    places = [row["place"] for row in rows]
    hatches = [_HATCHES[look // len(COLOURS) % len(_HATCHES)] for look in looks]
    colours = [COLOURS[look % len(COLOURS)] for look in looks]
    bar: dict[str, Any] = {"color": colours, "hatch": hatches, "edgecolor": "white", "linewidth": 0, "alpha": 0.55}
    axes.bar(places, [row["score"] for row in rows], 0.8, **bar)
    known = [row for row in rows if row["low"] is not None]
    middles, lows, highs = ([row[name] for row in known] for name in ("place", "low", "high"))
    axes.vlines(middles, lows, highs, color="black", lw=1.4, zorder=3)
    better = [row for row in rows if row["best_score"] > row["score"]]
    middles, scores = ([row[name] for row in better] for name in ("place", "best_score"))
    axes.scatter(middles, scores, 16, marker="D", fc="none", ec="black", lw=0.7, zorder=4)


def _dots(axes: Axes, seeds: dict[str, list[Row]], places: dict[str, int], looks: dict[str, int]) -> None:
    """One dot a seed, side by side."""
    x, y, colours = [], [], []
    for name, members in seeds.items():
        spread = np.linspace(-0.25, 0.25, len(members)) if len(members) > 1 else np.zeros(1)
        x += (places[name] + spread).tolist()
        y += [row["score"] for row in sorted(members, key=lambda row: row["seed"])]
        colours += [COLOURS[looks[name] % len(COLOURS)]] * len(members)
    axes.scatter(x, y, 7, color=colours, ec="black", lw=0.4, zorder=4)


def _crosses(axes: Axes, summary: list[Row], seeds: dict[str, list[Row]], places: dict[str, int]) -> None:
    """How many seeds are missing, above all that is drawn of a method."""
    crossed: dict[str, Any] = {"ha": "center", "fontsize": 6.5, "weight": "bold", "textcoords": "offset points"}
    for row in summary:
        if row["absent"]:
            dots = [seed["score"] for seed in seeds.get(label(row), [])]
            drawn = [row["high"], row["best_score"], *dots]
            top = max([0.0, *(value for value in drawn if value is not None)])
            axes.annotate(f"×{row['absent']}", (places[label(row)], top), (0, 4), **crossed)


def _lines(axes: Axes, row: dict[str, str]) -> None:
    """Published scores as lines, named at their right end."""
    for name, (dashes, shown) in _PUBLISHED.items():
        value = float(row[name])
        axes.axhline(value, color="black", lw=0.9, linestyle=dashes, zorder=1)
        axes.text(1.0, value, shown, transform=axes.get_yaxis_transform(), fontsize=6, ha="right", va="bottom")


def _published_note(published: list[dict[str, str]]) -> str:
    return (
        " Lines: V-D4RL's published scores, on its own sets of these names, with nothing hidden." if published else ""
    )


def _words(row: Row) -> str:
    place = f"{row['task']} {row['quality']}: {label(row)}"
    if row["score"] is None:
        return f"{place} {row['missing']}"
    return f"{place} {row['score']:.1f} (n = {row['seeds']})"
