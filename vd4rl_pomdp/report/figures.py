"""Figures as bytes that an HTML page can carry: curves as SVG, pictures as PNG, an episode as an animated WebP."""

from __future__ import annotations

import io
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from vd4rl_pomdp.report.tables import label
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.text import plain

mpl.rcParams["svg.hashsalt"] = "vd4rl-pomdp"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette, which colour-blind readers can tell apart."""
LEGEND_WIDTH = 34
"""Characters in a line of a legend."""
LEGEND_LINE = 0.17
"""Its height in inches, spacing included: a figure grows with its legend."""
STRIP_FRAMES = 8
"""Frames in a film strip, at most."""
Film = dict[str, np.ndarray]


def curve_figure(rows: list[dict[str, Any]], methods: list[str], summary: list[dict[str, Any]]) -> str:
    """Score against updates, one line a method, a band from the lowest to the highest seed.

    The legend has every method of the setting's `summary`, and says of which seeds are missing.
    """
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    notes = {label(row): row["missing"] for row in summary if row["missing"]}
    for method in dict.fromkeys(map(label, rows)):
        mine = [row for row in rows if label(row) == method]
        style = _style(methods.index(method))
        steps = [row["step"] for row in mine]
        name = _noted(method, notes.pop(method, ""))
        axes.plot(steps, [row["score"] for row in mine], marker="o", label=name, markersize=4, **style)
        axes.fill_between(
            steps, [r["low"] for r in mine], [r["high"] for r in mine], color=style["color"], alpha=0.15, lw=0
        )
    _list_absent(axes, methods, notes)
    axes.set(xlabel="gradient updates", ylabel="score (return / 10)")
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.05 * max(row["high"] for row in rows) or 1)
    return _svg(figure, axes)


def profile_figure(rows: list[dict[str, Any]], methods: list[str], notes: dict[str, str]) -> str:
    """Share of runs above a score, one line a method; the legend has those of `notes`, too, and the note."""
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        style = _style(methods.index(method))
        name = _noted(method, notes.pop(method, ""))
        axes.step([r["threshold"] for r in mine], [r["share"] for r in mine], where="post", label=name, **style)
    _list_absent(axes, methods, notes)
    axes.set(xlabel="score", ylabel="share of runs above it", xlim=(0, None), ylim=(0, 1.02))
    return _svg(figure, axes)


def _list_absent(axes: Any, methods: list[str], notes: dict[str, str]) -> None:
    """Give methods that no line shows their entry in the legend, faint."""
    for method, note in notes.items():
        axes.add_line(Line2D([], [], label=_noted(method, note), **_style(methods.index(method)), alpha=0.25))


def _noted(method: str, note: str) -> str:
    """A legend's entry: plain text, whatever a method is called."""
    return plain(f"{method} ({note})" if note else method, LEGEND_WIDTH)


def _style(number: int) -> dict[str, Any]:
    """Colour and dashes of the line of this number: more lines than colours stay distinct."""
    dashes = ("-", "--", ":")[number // len(COLOURS) % 3]
    return {"color": COLOURS[number % len(COLOURS)], "linestyle": dashes}


def loss_figure(series: list[tuple[str, list[tuple[int, float]]]], methods: list[str]) -> str:
    """Pretraining action loss against steps, one line a run; those of a method look as in the other figures."""
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    methods = list(dict.fromkeys([*methods, *(name for name, _ in series)]))
    for number, (name, losses) in enumerate(series):
        steps, values = zip(*losses, strict=True)
        first = name not in (other for other, _ in series[:number])
        entry = plain(name, LEGEND_WIDTH) if first else None
        axes.plot(steps, values, lw=1.2, label=entry, **_style(methods.index(name)))
    axes.set(xlabel="gradient steps", ylabel="action loss")
    return _svg(figure, axes)


PROBES = {"probe_pose": "pose", "probe_velocity": "velocity"}
"""What probes measure, as a figure names it."""
MARKERS = "osD^vP"


def probe_figure(rows: list[Row], methods: list[str]) -> tuple[str, str]:
    """Return against the probes' errors, pose at the left and velocity at the right, one dot a run.

    Returns:
        The figure, and in words what it shows.
    """
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for method in dict.fromkeys(map(label, rows)):
        number = methods.index(method)
        style = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number // len(COLOURS) % len(MARKERS)]}
        mine = [row for row in rows if label(row) == method]
        for axes, probe in zip(panels, PROBES, strict=True):
            known = [row for row in mine if row[probe] is not None]
            errors, returns = [row[probe] for row in known], [row["return"] for row in known]
            axes.scatter(errors, returns, 36, label=plain(method, LEGEND_WIDTH), ec="white", lw=0.6, zorder=3, **style)
    for axes, name in zip(panels, PROBES.values(), strict=True):
        axes.set(xlabel=f"{name} error, %")
        axes.set_xlim(*_with_room(axes.get_xlim()[1]))
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set(ylabel="return", ylim=_with_room(panels[0].get_ylim()[1]))
    return _svg(figure, panels[1]), "; ".join(map(_probe_words, rows))


def _with_room(highest: float) -> tuple[float, float]:
    """Limits of an axis that begins at 0, with room for whole dots at both ends."""
    return -0.04 * highest, 1.04 * highest


def _probe_words(row: Row) -> str:
    errors = (f"{name} {row[probe]:.1f}%" for probe, name in PROBES.items() if row[probe] is not None)
    return f"{label(row)}, seed {row['seed']}: return {row['return']:.0f}, {', '.join(errors)}"


def _svg(figure: Figure, axes: Any) -> str:
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    legend = axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    lines = sum(1 + text.get_text().count("\n") for text in legend.get_texts())
    figure.set_figheight(max(figure.get_figheight(), 0.4 + LEGEND_LINE * lines))
    return to_svg(figure)


def to_svg(figure: Figure) -> str:
    """The figure as an <svg> element, the same bytes every time."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def strip(film: Film) -> bytes:
    """PNG film strip: clean frames above, the frames of the corrupted stacks (oldest to newest) below."""
    chosen = np.unique(np.linspace(0, len(film["clean"]) - 1, STRIP_FRAMES).astype(int))
    stacks = film["corrupted"][chosen].reshape(len(chosen), -1, 3, *film["corrupted"].shape[-2:])
    rows = [film["clean"][chosen], *stacks.swapaxes(0, 1)]
    return _png(np.concatenate([np.concatenate(list(_spaced(row)), axis=1) for row in rows], axis=0))


def _spaced(images: np.ndarray) -> Any:
    """(N, 3, H, W) -> images (H + 2, W + 2, 3) with a white border."""
    for image in images:
        yield np.pad(image.transpose(1, 2, 0), ((1, 1), (1, 1), (0, 0)), constant_values=255)


def movie(film: Film, scale: int = 2) -> bytes:
    """Animated WebP of an episode: clean at the left, the newest corrupted frame at the right."""
    newest = film["corrupted"][:, -3:]
    pairs = np.concatenate([film["clean"], newest], axis=3).transpose(0, 2, 3, 1)
    size = (pairs.shape[2] * scale, pairs.shape[1] * scale)
    frames = [Image.fromarray(pair).resize(size, Image.Resampling.NEAREST) for pair in pairs]
    buffer = io.BytesIO()
    frames[0].save(buffer, "WEBP", save_all=True, append_images=frames[1:], duration=80, loop=0, quality=60)
    return buffer.getvalue()


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
