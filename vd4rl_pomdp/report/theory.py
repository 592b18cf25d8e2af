"""Results of the theory study on exact finite worlds: report section, its own page and terminal tables."""

from __future__ import annotations

from itertools import groupby
from math import cos, hypot, pi, sin
from pathlib import Path
from typing import Any

from jinja2 import UndefinedError
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.text import write_text
from vd4rl_pomdp.report.figures import COLOURS, to_svg
from vd4rl_pomdp.report.render import render
from vd4rl_pomdp.runs.files import Row, files_below, read_json, write_json

Study = dict[str, Any]
FILE = "theory.json"
COLUMNS = {"correct": "correct classifier", "complete": "complete state", "discards": "discards noise"}
LABEL: dict[str, Any] = {"fontsize": 7, "ha": "center", "va": "center", "zorder": 3}


def write_theory(study: Study, out: Path) -> Path:
    """Write the study as a page and as JSON into an existing folder; returns the page."""
    write_json(out / FILE, study)
    write_text(out / "index.html", render("theory.html", theory=section(study)))
    return out / "index.html"


def load_section(paths: list[Path]) -> str | None:
    """Section about the study that `write_theory` left at or below some paths; None without one."""
    files = sorted({file.resolve(): file for path in paths for file in files_below(path, FILE)}.values())
    if len(files) > 1:
        raise UserError(f"{files[0]} and {files[1]}: two studies of the theory; report one of them")
    for file in files:
        study = read_json(file)
        try:
            return section(study)
        except (LookupError, TypeError, ValueError, AttributeError, UndefinedError) as error:
            what, again = f"{type(error).__name__}: {error}", f"vd4rl-pomdp theory --out {file.parent}"
            raise UserError(f"{file}: is not a complete study ({what}); write it again: {again}") from error
    return None


def section(study: Study) -> str:
    """The HTML section about a study."""
    shown = {"study": study, "columns": COLUMNS, "table": table_rows(study), "facts": list(by_title(study).items())}
    shown |= {"diagram": to_svg(diagram_figure(study)), "entropies": to_svg(entropy_figure(study["comparisons"]))}
    return render("theory_section.html", theory=shown)


def by_title(study: Study) -> dict[str, list[Row]]:
    """The rows of each fact, one per world."""
    return {title: list(rows) for title, rows in groupby(study["facts"], key=lambda fact: fact["title"])}


def table_rows(study: Study) -> list[Row]:
    """Table 1 by method: in each column the paper's printed entry, then one per world.

    Entries are in parentheses where the method's assumptions fail, so that the paper makes no claim.
    """
    rows = []
    for worlds in zip(*study["tables"].values(), strict=True):
        method = worlds[0]["method"]
        printed = study["printed"][method.removesuffix(" literal")]
        entries: dict[str, list[str]] = {}
        for column in COLUMNS:
            mark, *marks = ("yes" if row[column] else "no" for row in (printed, *worlds))
            claimed = (row["decodes_past"] and row["decodes_end"] for row in worlds)
            entries[column] = [mark, *(m if holds else f"({m})" for m, holds in zip(marks, claimed, strict=True))]
        rows.append({"method": method, "entries": entries})
    return rows


def print_theory(study: Study) -> None:
    """Print the study's main tables on the terminal."""
    console, facts = Console(), by_title(study)
    appendix = study["counterexample"]["appendix"]
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("method", *COLUMNS.values()):
        table.add_column(title, no_wrap=True)
    for row in table_rows(study):
        table.add_row(row["method"], *(f"{printed} | {' '.join(found)}" for printed, *found in row["entries"].values()))
    for line in (
        "Counted over all sequences of finite worlds; nothing is sampled or trained.",
        f"The paper's counterexample has {appendix['examples']} inverse examples for k = 1..10, diameter "
        f"{appendix['diameter']}, m = {appendix['m_with_actions']}.",
        "",
        "Table 1: the paper | " + ", ".join(study["tables"]),
        "(yes), (no): what the method sees does not decode that world's states, so that the paper claims nothing.",
        table,
        f"\nWhere the paper and enumeration differ: {len(facts)} facts",
    ):
        console.print(line, markup=False, highlight=False)
    for number, (title, rows) in enumerate(facts.items(), 1):
        table = Table(box=None, padding=(0, 1, 0, 0), show_header=False, title_justify="left", title_style="bold")
        table.title = Text(f"\n{number}. {title}")
        table.add_column(no_wrap=True)
        table.add_column()
        table.add_row("   printed", Text(rows[0]["printed"]))
        for row in rows:
            text = f"{row['quantity']}: printed {row['claimed']}, computed {row['computed']}"
            table.add_row(f"   {row['world']}", Text(text))
        console.print(table)


def diagram_figure(study: Study) -> Figure:
    """The counterexample, one panel per objective. States merged by a coarsest partition share a colour.

    Arrows are transitions, labelled by their action.
    """
    figure = Figure(figsize=(9.6, 7.2), layout="constrained")
    # States reached by +1 are on the outer ring, clockwise by s^A, and the others inside, beside their successors:
    # (x, +1) leads to (x-1, -1) and back, so these two share an angle and no two arrows cross.
    rings = [(1.2, x) if last > 0 else (0.5, x + 1) for x, last in study["states"]]
    positions = [(radius * sin(angle * pi / 2), radius * cos(angle * pi / 2)) for radius, angle in rings]
    for axes, diagram in zip(figure.subplots(2, 3).flat, study["diagrams"], strict=True):
        for start, action, end in study["transitions"]:
            colour, bend = "#222222" if action > 0 else "#999999", -0.18
            style = {"arrowstyle": "-|>", "color": colour, "shrinkA": 12, "shrinkB": 12}
            style["connectionstyle"] = f"arc3,rad={bend}"
            axes.annotate("", positions[end], positions[start], arrowprops=style, zorder=1)
            (x0, y0), (x1, y1) = positions[start], positions[end]
            dx, dy = x1 - x0, y1 - y0
            out = bend / 2 - 0.13 / hypot(dx, dy)  # the label is at mid-curve
            axes.text((x0 + x1) / 2 + out * dy, (y0 + y1) / 2 - out * dx, f"{action:+d}", color=colour, **LABEL)
        for (x, y), (at, last), group in zip(positions, study["states"], diagram["classes"], strict=True):
            axes.scatter([x], [y], s=480, color=COLOURS[group % len(COLOURS)], zorder=2)
            axes.text(x, y, f"{at},{last:+d}", color="white", ha="center", va="center", fontsize=8, zorder=3)
        classes = len(set(diagram["classes"]))
        axes.set_title(f"{diagram['title']}\n{diagram['blocks']} codes; classes of states: {classes}", fontsize=10)
        axes.set(xlim=(-1.45, 1.45), ylim=(-1.45, 1.45), aspect="equal")
        axes.axis("off")
    return figure


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
        target = {r["k"]: r["multi_step_entropy"] for r in mine if r["method"] == "mik+a"}
        axes.plot([*target], [*target.values()], "k_", ms=18, label="P(a | s_t, s_t+k)")
        axes.set(title=world, xlabel="k", xticks=[*target])
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("H(a_t | seen), nats")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=9)
    return figure
