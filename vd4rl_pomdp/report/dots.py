"""Returns against what linear probes read from representations, and what runs cost."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes

from vd4rl_pomdp.report.figures import COLOURS, Plot, file_name, panels, seeds_note, span, style
from vd4rl_pomdp.report.load import PROBES, SETTING
from vd4rl_pomdp.report.measures import COSTS
from vd4rl_pomdp.report.tables import by_label, grouped, label
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.text import plain

_NAMES = dict(zip(PROBES, ("pose", "velocity"), strict=True))
_MANY = 300
"""Dots of a figure, above which they are one picture within it, and its words are of the best runs."""
_TOLD = 20
"""Runs that the words of a panel tell of, at most."""
_COLUMNS = (*SETTING, "method", "seed", *PROBES, "return")


def probe_plots(runs: list[Row], looks: dict[str, int]) -> list[Plot]:
    """Return against the probes' errors, one figure a corruption, two panels a setting, one dot a run."""
    probed = [row for row in runs if row["return"] is not None and any(row[probe] is not None for probe in PROBES)]
    plots = []
    for (corruption,), members in grouped(probed, ("corruption",)):
        places = grouped(members, ("task", "quality"))
        titles = [f"{' '.join(place)}, {measured}" for place, _ in places for measured in _NAMES.values()]
        figure, axes = panels(titles, _of(looks, members), 4 if len(places) > 1 else 2)
        for number, (_, rows) in enumerate(places):
            for panel, probe in zip(axes[2 * number :], PROBES, strict=False):
                _dots(panel, rows, probe, looks, rasterized=len(members) > _MANY)
        plots.append(
            Plot(
                file_name("probes", corruption),
                f"Final return under {corruption} against the error of a linear probe of pose and of velocity, in "
                f"percent of a standard deviation; further left is better. One dot a run, n = {len(members)} runs.",
                f"Return against probe errors. {'; '.join(_words(rows) for _, rows in places)}.",
                figure,
                [{name: row[name] for name in _COLUMNS} | {"method": label(row)} for row in members],
            )
        )
    return plots


def _of(looks: dict[str, int], rows: list[Row]) -> dict[str, int]:
    """The looks of those methods that rows are of."""
    here = set(map(label, rows))
    return {name: look for name, look in looks.items() if name in here}


def _dots(axes: Axes, rows: list[Row], probe: str, looks: dict[str, int], rasterized: bool) -> None:
    known = [row for row in rows if row[probe] is not None]
    for method, mine in by_label(known):
        look = {name: value for name, value in style(looks[method]).items() if name != "linestyle"}
        errors, returns = [row[probe] for row in mine], [row["return"] for row in mine]
        axes.scatter(errors, returns, 26, ec="white", lw=0.5, zorder=-1 if rasterized else 3, **look)
    axes.set_rasterization_zorder(0)
    for set_limits, name in ((axes.set_xlim, probe), (axes.set_ylim, "return")):
        low, high = span(row[name] for row in known)
        set_limits(low - 0.04 * (high - low), low + 1.06 * (high - low))
    axes.set_xlabel("error, %", fontsize=8)
    axes.set_ylabel("return", fontsize=8)


def _words(rows: list[Row]) -> str:
    ordered = sorted(rows, key=lambda row: -row["return"])
    more = f"; and {len(rows) - _TOLD} runs with lower returns" if len(rows) > _TOLD else ""
    return f"{rows[0]['task']} {rows[0]['quality']}: {'; '.join(map(_run_words, ordered[:_TOLD]))}{more}"


def _run_words(row: Row) -> str:
    errors = (f"{name} {row[probe]:.1f}%" for probe, name in _NAMES.items() if row[probe] is not None)
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
