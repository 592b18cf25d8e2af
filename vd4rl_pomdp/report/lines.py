"""Figures of lines: learning curves, performance profiles, and the losses of pretraining."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from vd4rl_pomdp.report.figures import Plot, file_name, panels, remark, room_for, seeds_note, span, style
from vd4rl_pomdp.report.load import CONDITION, LoadedRun
from vd4rl_pomdp.report.overall import THRESHOLDS
from vd4rl_pomdp.report.tables import by_label, grouped, label
from vd4rl_pomdp.runs.files import Row

_COLUMNS = 3
"""Panels in a row."""
_POINTS = 200
"""Points of a loss curve, at most."""


def curve_plots(curves: list[Row], summary: list[Row], looks: dict[str, int]) -> list[Plot]:
    """Score against updates, one figure a corruption, one panel a task and quality, one line a method."""
    plots = []
    for (corruption,), members in grouped(curves, ("corruption",)):
        places = grouped(members, ("task", "quality"))
        notes = [_missing(summary, (*place, corruption)) for place, _ in places]
        shown, axes = _sheet(places, looks, room_for(notes))
        for panel, (_, rows), note in zip(axes, places, notes, strict=True):
            _curves(panel, rows, looks)
            remark(panel, note)
        plots.append(
            Plot(
                file_name("curves", corruption),
                f"Learning curves under {corruption}: mean over the seeds that have got there, bands from the lowest "
                f"to the highest seed, unfinished runs among them. {seeds_note(members)}",
                "; ".join(_curve_words(rows) for _, rows in places),
                shown,
                members,
            )
        )
    return plots


def _missing(summary: list[Row], place: tuple[str, ...]) -> list[str]:
    """What is not there of a setting, by method."""
    return [f"{label(row)}: {row['missing']}" for row in summary if row["missing"] and _place(row) == place]


def _sheet(places: Sequence[tuple[tuple, list[Row]]], looks: dict[str, int], room: float = 0.0) -> tuple:
    return panels([" ".join(place) for place, _ in places], looks, _COLUMNS, room=room)


def _place(row: Row) -> tuple[str, ...]:
    return row["task"], row["quality"], row["corruption"]


def _curves(axes: Axes, rows: list[Row], looks: dict[str, int]) -> None:
    for name, mine in by_label(rows):
        look = style(looks[name])
        steps = [row["step"] for row in mine]
        axes.plot(steps, [row["score"] for row in mine], lw=1.3, markersize=4, **look)
        low, high = ([row[end] for row in mine] for end in ("low", "high"))
        axes.fill_between(steps, low, high, color=look["color"], alpha=0.08, lw=0)
    axes.set_xlim(left=0)
    lowest, highest = span(row[end] for row in rows for end in ("low", "high"))
    axes.set_ylim(1.05 * lowest, 1.05 * highest)
    axes.set_xlabel("gradient updates", fontsize=8)
    axes.set_ylabel("score", fontsize=8)


def _curve_words(rows: list[Row]) -> str:
    ends = [f"{name} {mine[-1]['score']:.1f} after {mine[-1]['step']:,} updates" for name, mine in by_label(rows)]
    return f"{rows[0]['task']} {rows[0]['quality']}: {', '.join(ends)}"


def profile_plots(profiles: list[Row], aggregate: list[Row], looks: dict[str, int]) -> list[Plot]:
    """Share of runs above a score, one panel a corruption, one line a method."""
    if not profiles:
        return []
    corruptions = grouped(profiles, ("corruption",))
    notes = [_partial(aggregate, corruption) for (corruption,), _ in corruptions]
    titles = [corruption for (corruption,), _ in corruptions]
    figure, axes = panels(titles, looks, 2, height=2.6, room=room_for(notes))
    for panel, (_, rows), note in zip(axes, corruptions, notes, strict=True):
        for (name,), mine in grouped(rows, ("method",)):
            _profile(panel, mine, looks[name])
        remark(panel, note)
        panel.set(xlim=(rows[0]["threshold"], rows[-1]["threshold"]), ylim=(0, 1.02))
        panel.set_xlabel("score", fontsize=8)
        panel.set_ylabel("share of runs above it", fontsize=8)
    caption = (
        "Performance profiles: share of the runs of all tasks and seeds whose final score is above a threshold, with "
        f"pointwise 95% bands. {seeds_note(aggregate)}"
    )
    words = "; ".join(
        f"{row['corruption']}: {row['method']} {row['share']:.2f} above {row['threshold']:g}"
        for row in profiles[THRESHOLDS // 2 :: THRESHOLDS]
    )
    return [Plot("profiles", caption, words, figure, profiles)]


def _partial(aggregate: list[Row], corruption: str) -> list[str]:
    """Methods that have not been run on all tasks of a corruption, and on how many."""
    mine = [row for row in aggregate if row["corruption"] == corruption and row["tasks"] < row["of_tasks"]]
    return [f"{label(row)}: {row['tasks']} of {row['of_tasks']} tasks" for row in mine]


def _profile(axes: Axes, rows: list[Row], number: int) -> None:
    look = style(number)
    scores = [row["threshold"] for row in rows]
    axes.step(
        scores, [row["share"] for row in rows], where="post", lw=1.3, markersize=4, markevery=(number % 12, 12), **look
    )
    if rows[0]["low"] is not None:
        low, high = ([row[end] for row in rows] for end in ("low", "high"))
        axes.fill_between(scores, low, high, step="post", color=look["color"], alpha=0.12, lw=0)


def loss_rows(runs: list[LoadedRun]) -> list[Row]:
    """Mean action loss over the finished pretraining runs of every condition, at most _POINTS of the steps of all."""
    told = [run.named | {"losses": dict(run.result.losses)} for run in runs if run.finished]
    return [
        dict(zip(CONDITION, group, strict=True))
        | {"step": step, "action_loss": float(np.mean([row["losses"][step] for row in members]))}
        | {"seeds": len(members)}
        for group, members in grouped(told, CONDITION)
        for step in _thinned(sorted(set.intersection(*(set(row["losses"]) for row in members))))
    ]


def _thinned(steps: list[int]) -> list[int]:
    """At most _POINTS of some steps, the first and the last among them."""
    places = np.linspace(0, len(steps) - 1, min(len(steps), _POINTS)).round().astype(int)
    return [steps[place] for place in places]


def loss_plots(losses: list[Row], looks: dict[str, int]) -> list[Plot]:
    """Action loss of pretraining against steps, one figure a corruption, one line a method."""
    plots = []
    for (corruption,), members in grouped(losses, ("corruption",)):
        places = grouped(members, ("task", "quality"))
        figure, axes = _sheet(places, looks)
        for panel, (_, rows) in zip(axes, places, strict=True):
            for name, mine in by_label(rows):
                look = style(looks[name]) | {"marker": None}
                panel.plot([r["step"] for r in mine], [r["action_loss"] for r in mine], lw=1.3, **look)
            panel.set_xlabel("gradient steps", fontsize=8)
            panel.set_ylabel("action loss", fontsize=8)
        words = "; ".join(
            f"{' '.join(place)}: {name} ends at {mine[-1]['action_loss']:.3f}"
            for place, rows in places
            for name, mine in by_label(rows)
        )
        caption = (
            f"Action loss of pretraining under {corruption or 'any corruption'}, mean over finished runs. "
            f"{seeds_note(members)}"
        )
        plots.append(Plot(file_name("losses", corruption), caption, words, figure, members))
    return plots
