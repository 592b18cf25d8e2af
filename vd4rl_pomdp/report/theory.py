"""The page and the terminal tables about exact finite worlds."""

from __future__ import annotations

import io
import json
from importlib.resources import files
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from vd4rl_pomdp.report.figures import COLOURS

Row = dict[str, Any]
COLUMNS = ("correct", "complete", "discards")
MARKS = {True: "yes", False: "no"}


def write_theory(study: Row, out: Path) -> Path:
    """Write the study as a page and as JSON into a folder; returns the page."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "theory.json").write_text(json.dumps(study, indent=1))
    template = files("vd4rl_pomdp.report").joinpath("theory.html").read_text()
    style = files("vd4rl_pomdp.report").joinpath("page.html").read_text()
    style = style[style.index("<style>") : style.index("</style>") + len("</style>")]
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    page = environment.from_string(template).render(
        study=study,
        style=style,
        table=table_rows(study),
        columns=COLUMNS,
        mark=MARKS,
        diagram=_svg(diagram_figure(study["diagrams"])),
        entropies=_svg(entropy_figure(study["comparisons"])),
    )
    (out / "index.html").write_text(page)
    return out / "index.html"


def table_rows(study: Row) -> list[Row]:
    """Table 1 with one entry a method: what is printed, and each world's computed row."""
    methods = [row["method"] for row in next(iter(study["tables"].values()))]
    return [
        {
            "method": method,
            "printed": study["printed"][method.removesuffix(" literal")],
            "worlds": {w: next(r for r in rows if r["method"] == method) for w, rows in study["tables"].items()},
        }
        for method in methods
    ]


def print_theory(study: Row, console: Console | None = None) -> None:
    """The study's main tables on the terminal."""
    console = console or Console()
    appendix = study["counterexample"]["appendix"]
    console.print(
        f"Forward-Jump counterexample: {appendix['examples']} inverse examples for k = 1..10; first action uniform at "
        f"k = {_list(appendix['uniform_k'])}; diameter {appendix['diameter']}, m = {appendix['m_with_actions']}"
    )
    for sentence in study["counterexample_differences"]:
        console.print(f"  - {sentence}", markup=False)
    console.print(_terminal_table(study))
    console.print(f"{len(study['disagreements'])} disagreements (* the world meets the method's assumptions):")
    for row in study["disagreements"]:
        star = "*" if row["assumptions_hold"] else " "
        text = f"{star} {row['world']}, {row['method']}: {row['difference']} ({row['detail']})"
        console.print(text, markup=False, highlight=False)


def _terminal_table(study: Row) -> Table:
    worlds = list(study["tables"])
    table = Table(
        title="Table 1: printed, then computed on " + ", ".join(worlds) + "; ( ) if its assumptions fail there"
    )
    table.add_column("method")
    for column in ("Bayes-optimal correct?", "complete state?", "discards noise?"):
        table.add_column(column)
    for entry in table_rows(study):
        table.add_row(entry["method"], *(_cell(entry, column) for column in COLUMNS))
    return table


def _cell(entry: Row, column: str) -> str:
    shown = [
        MARKS[row[column]] if row["decodes_past"] and row["decodes_end"] else f"({MARKS[row[column]]})"
        for row in entry["worlds"].values()
    ]
    return f"{MARKS[entry['printed'][column]]} | {' '.join(shown)}"


def diagram_figure(diagrams: list[Row]) -> Figure:
    """The counterexample's states, one panel an objective: one colour for states that a coarsest partition merges.

    Lines join states that the objective must tell apart; thin ones where it must for some histories only.
    """
    figure = Figure(figsize=(9.6, 7.0), layout="constrained")
    for axes, diagram in zip(figure.subplots(2, 3).flat, diagrams, strict=True):
        _draw(axes, diagram)
    return figure


def _draw(axes: Axes, diagram: Row) -> None:
    places = [_place(x, b) for x, b in diagram["states"]]
    for one, other, share in diagram["forced"]:
        (x0, y0), (x1, y1) = places[one], places[other]
        axes.plot(
            [x0, x1], [y0, y1], color="#8a8a8a", lw=1.6 if share == 1 else 0.6, ls="-" if share == 1 else ":", zorder=1
        )
    for (x, y), state, group in zip(places, diagram["states"], diagram["classes"], strict=True):
        axes.scatter([x], [y], s=620, color=COLOURS[group % len(COLOURS)], zorder=2)
        axes.text(x, y, f"{state[0]},{state[1]:+d}", color="white", ha="center", va="center", fontsize=9, zorder=3)
    axes.set_title(
        f"{diagram['title']}\nstates in {len(set(diagram['classes']))} classes, {diagram['blocks']} codes", fontsize=10
    )
    axes.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal")
    axes.axis("off")


def _place(position: int, last: int) -> tuple[float, float]:
    """States sit on two rings: s^A is the angle, s^B the ring."""
    radius, angle = (1.05 if last > 0 else 0.52), pi / 2 - position * pi / 2 + (0.28 if last > 0 else -0.28)
    return radius * cos(angle), radius * sin(angle)


def entropy_figure(rows: list[Row]) -> Figure:
    """H(a_t | what the objective sees) against k on every world, without noise, under the uniform policy."""
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    for axes, world in zip(figure.subplots(1, len(worlds), sharey=True), worlds, strict=True):
        mine = [r for r in rows if r["world"] == world and not r["noise"] and not r["state_dependent"]]
        for number, method in enumerate(("ah", "fj", "fj+a", "mik", "mik+a", "mik+a literal")):
            line = [r for r in mine if r["method"] == method]
            k = [r["k"] + (number - 2.5) * 0.03 for r in line]
            axes.plot(k, [r["entropy"] for r in line], "o-", color=COLOURS[number], label=method, ms=4, lw=1.2)
        target = [r for r in mine if r["method"] == "mik+a"]
        axes.plot(
            [r["k"] for r in target], [r["multi_step_entropy"] for r in target], "k_", ms=18, label="P(a | s_t, s_t+k)"
        )
        axes.set(title=world, xlabel="k", xticks=[r["k"] for r in target])
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("H(a_t | seen), nats")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=9)
    return figure


def _svg(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _list(ks: list[int]) -> str:
    return ", ".join(map(str, ks))
