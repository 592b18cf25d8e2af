"""Returns against what probes read from representations and how actions err, and what runs cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes

from vd4rl_pomdp.core.text import plain
from vd4rl_pomdp.report.figures import COLOURS, Plot, file_name, panels, seeds_note, span, style
from vd4rl_pomdp.report.load import PROBES, SETTING
from vd4rl_pomdp.report.measures import ACTION_ERRORS, COSTS
from vd4rl_pomdp.report.tables import by_label, grouped, label
from vd4rl_pomdp.runs.files import Row

_MANY = 300
"""Dots of a figure, above which they are one picture within it, and its words are of the best runs."""
_TOLD = 20
"""Runs that the words of a panel tell of, at most."""


@dataclass(frozen=True)
class Against:
    """What returns are drawn against: two measures of a run, a panel each."""

    name: str
    errors: str
    """What they are, in two words."""
    panels: Mapping[str, str]
    """Titles of the panels, by the measures' columns in the table of runs."""
    axis: str
    caption: str
    words: str
    """How a value is told."""


PROBED = Against(
    "probes",
    "probe errors",
    dict(zip(PROBES, ("pose", "velocity"), strict=True)),
    "error, %",
    "the error of a linear probe of pose and of velocity, in percent of a standard deviation",
    "{:.1f}%",
)
ACTED = Against(
    "errors",
    "action errors",
    dict(zip(ACTION_ERRORS, ("actions on the data", "actions in closed loop"), strict=True)),
    "mean squared error",
    "the mean squared difference between its actions and those of the data's actor, on the data and in closed loop",
    "{:.3f}",
)


def return_plots(runs: list[Row], looks: dict[str, int], against: Against) -> list[Plot]:
    """Return against two measures, one figure a corruption, two panels a setting, one dot a run."""
    measured = [
        row for row in runs if row["return"] is not None and any(row[name] is not None for name in against.panels)
    ]
    plots = []
    for (corruption,), members in grouped(measured, ("corruption",)):
        places = grouped(members, ("task", "quality"))
        titles = [f"{' '.join(place)}, {title}" for place, _ in places for title in against.panels.values()]
        figure, axes = panels(titles, _of(looks, members), 4 if len(places) > 1 else 2)
        for number, (_, rows) in enumerate(places):
            for panel, column in zip(axes[2 * number :], against.panels, strict=False):
                _dots(panel, rows, column, looks, rasterized=len(members) > _MANY)
                panel.set_xlabel(against.axis, fontsize=8)
        columns = (*SETTING, "method", "seed", *against.panels, "return")
        plots.append(
            Plot(
                file_name(against.name, corruption),
                f"Final return under {corruption} against {against.caption}; further left is better. "
                f"One dot a run, n = {len(members)} runs.",
                f"Return against {against.errors}. {'; '.join(_words(rows, against) for _, rows in places)}.",
                figure,
                [{name: row[name] for name in columns} | {"method": label(row)} for row in members],
            )
        )
    return plots


def _of(looks: dict[str, int], rows: list[Row]) -> dict[str, int]:
    """The looks of those methods that rows are of."""
    here = set(map(label, rows))
    return {name: look for name, look in looks.items() if name in here}


def _dots(axes: Axes, rows: list[Row], column: str, looks: dict[str, int], rasterized: bool) -> None:
    known = [row for row in rows if row[column] is not None]
    for method, mine in by_label(known):
        look = {name: value for name, value in style(looks[method]).items() if name != "linestyle"}
        errors, returns = [row[column] for row in mine], [row["return"] for row in mine]
        axes.scatter(errors, returns, 26, ec="white", lw=0.5, zorder=-1 if rasterized else 3, **look)
    axes.set_rasterization_zorder(0)
    for set_limits, name in ((axes.set_xlim, column), (axes.set_ylim, "return")):
        low, high = span(row[name] for row in known)
        set_limits(low - 0.04 * (high - low), low + 1.06 * (high - low))
    axes.set_ylabel("return", fontsize=8)


def _words(rows: list[Row], against: Against) -> str:
    ordered = sorted(rows, key=lambda row: -row["return"])
    more = f"; and {len(rows) - _TOLD} runs with lower returns" if len(rows) > _TOLD else ""
    told = "; ".join(_run_words(row, against) for row in ordered[:_TOLD])
    return f"{rows[0]['task']} {rows[0]['quality']}: {told}{more}"


def _run_words(row: Row, against: Against) -> str:
    known = {title: row[column] for column, title in against.panels.items() if row[column] is not None}
    errors = (f"{title} {against.words.format(value)}" for title, value in known.items())
    return f"{label(row)}, seed {row['seed']}: return {row['return']:.0f}, {', '.join(errors)}"


def cost_plots(costs: list[Row]) -> list[Plot]:
    """Mean minutes of pretraining and fine-tuning by method, one above the other."""
    rows = [row for row in costs if any(row[name] is not None for name in COSTS)]
    if not rows:
        return []
    figure, (axes,) = panels(["mean minutes of a run"], {}, 1, height=0.35 + 0.24 * len(rows), room=0.1)
    below = [0.0] * len(rows)
    for name, colour, hatch in zip(COSTS, COLOURS, ("", "////"), strict=False):
        minutes = [(row[name] or 0.0) / 60 for row in rows]
        look: dict[str, Any] = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0}
        axes.barh(range(len(rows)), minutes, 0.7, left=below, label=_STAGES[name], **look)
        below = [a + b for a, b in zip(below, minutes, strict=True)]
    axes.set_yticks(range(len(rows)), [plain(row["method"]) for row in rows], fontsize=8)
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    left = min(0.5, 0.02 + 0.0115 * max(len(row["method"]) for row in rows))
    place = axes.get_position()
    axes.set_position((left, place.y0, place.x1 - left, place.height))
    figure.legend(frameon=False, fontsize=8, loc="lower right", ncols=2)
    words = "; ".join(f"{row['method']} {_seconds(row)} seconds" for row in rows)
    caption = (
        "Cost of pretraining and fine-tuning: mean wall-clock time over a method's finished runs of all settings, on "
        f"the machines of the table. {seeds_note(rows, 'runs', 'run')}"
    )
    return [Plot("costs", caption, words, figure, rows)]


_STAGES = dict(zip(COSTS, ("pretraining", "fine-tuning"), strict=True))


def _seconds(row: Row) -> str:
    return " and ".join("an unknown number of" if row[name] is None else f"{row[name]:.0f}" for name in COSTS)
