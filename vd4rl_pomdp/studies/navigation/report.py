"""The navigation report: the paper's tables from raw rows, each number beside the paper's, and what they say.

OUT/report.md     tables, verdicts, figures, and the command of every condition
OUT/runs.jsonl, episodes.csv, trajectories/     a results folder; `navigation report OUT` makes everything again from it
OUT/rows.csv      every number of every run
OUT/tables.csv    every number: mean, interval, seeds, the paper's number
OUT/figures/      accuracy.png, accuracy_raw.png (beside the paper's numbers), trajectories.png, observations.png
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd

from vd4rl_pomdp.core.text import code, code_block, markdown, write_text
from vd4rl_pomdp.envs.mazes import HARD, MAZES
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.results import RUNS, Result
from vd4rl_pomdp.studies.navigation import figures
from vd4rl_pomdp.studies.navigation.claims import verdict_lines
from vd4rl_pomdp.studies.navigation.measures import UNTRAINED, refitted_error
from vd4rl_pomdp.studies.navigation.runs import NavigationRun, find_navigation, frame_of, load_runs, save_runs
from vd4rl_pomdp.studies.navigation.tables import make_tables, table_sections, write_tables

Samples = Callable[[], Mapping[str, np.ndarray]]
"""Draws sample observations: (n, 3, H, W) uint8 by name."""
_CAPTIONS = {
    "accuracy.png": ("Accuracy of every objective", "Bars: held-out trajectories, probe refitted on frozen states."),
    "accuracy_raw.png": ("The same in raw units", "The paper's marks are training averages."),
    "trajectories.png": (
        "True and estimated trajectories",
        "From the first row on, where little was seen: errors count later ones.",
    ),
    "observations.png": ("Sample observations", "What a model is shown along a drive through each maze."),
}
_HARD = """\
`hard_` mazes are variants of the paper's. Three wider curtains hide the mass 36% of the time (its own:
some 22%), every action is noisy (not a tenth of them zero and a tenth random), and the first person has
another camera, a black sky and other kinematics. The paper's numbers are of its own mazes.
"""
_READING = """\
Errors are given in two units: percent of a standard deviation, and the simulator's own units x 100. The paper's
percentages are most likely the latter, so its numbers stand beside those alone.

A cell of a table reads: **mean over seeds** [95% t interval] n=seeds (the paper's number).
Missing: "n=1 of 3" where other cells of the maze have three seeds,
"no run" where other cells of the maze, and other mazes of the row, have one.
"""
_COMMANDS = """\
## Commands

Each line computes one run, and says on which maze and in how many seconds (wall-clock); `navigation collect` makes
its data, as `collection` in runs.jsonl says. Folders are as they were told: sets of two mazes may have lain under one
name, on different machines. The grids `navigation` (the paper's own mazes) and `first_person` print the lines of all
cells: `vd4rl-pomdp sweep run GRID --out runs --dry-run`.
"""


def write_report(sources: Sequence[Path], out: Path, samples: Samples | None = None) -> Path:
    """Write the report of all runs in `sources` to `out`; returns the page.

    Args:
        sources: run folders, results folders, or folders that contain some.
        out: where to.
        samples: draws the sample observations, which needs OpenGL; None leaves them out.
    """
    refuse_foreign(out, "navigation report", RUNS)
    found = find_navigation(sources, out)
    runs, unfinished = load_runs(found), [result for result in found if not result.finished]
    drawn = samples() if samples is not None else None  # before anything is written: there may be no OpenGL
    with owned(out):
        save_runs(runs, out)
        (out / "figures").mkdir(exist_ok=True)
        frame = frame_of(runs)
        pictures = _draw(runs, frame, drawn, out / "figures")
        cells = make_tables(frame)
        write_tables(cells, out / "tables.csv")
        lines = [*_head(runs, unfinished), *verdict_lines(frame), *pictures, *table_sections(cells), *_commands(runs)]
        write_text(out / "report.md", "\n".join(lines) + "\n")
    return out / "report.md"


def _draw(
    runs: list[NavigationRun], frame: pd.DataFrame, samples: Mapping[str, np.ndarray] | None, folder: Path
) -> Iterator[str]:
    """Draw what can be drawn; lines of the page that show it."""
    state = refitted_error("state")
    drawn = {
        "accuracy.png": lambda path: figures.accuracy_bars(frame, state, path),
        "accuracy_raw.png": lambda path: figures.accuracy_bars(frame, state.raw(), path),
        "trajectories.png": lambda path: figures.trajectories(runs, path),
        "observations.png": lambda path: samples and figures.observations(samples, path),
    }
    for name, draw in drawn.items():
        if draw(folder / name):
            title, caption = _CAPTIONS[name]
            yield from (f"![{title}](figures/{name})", "", caption, "")


def _head(runs: list[NavigationRun], unfinished: list[Result]) -> list[str]:
    """What the runs are, what they cost, what they differ in, and how the tables read."""
    mazes, seeds = {run.condition.maze for run in runs}, sorted({run.seed for run in runs})
    told = {run.condition.maze: run.result.record["config"]["exogenous"] for run in runs if run.condition.exogenous}
    images = [f"{markdown(name)} in {code(maze)}" for maze, name in told.items()]
    lines = [
        "# Navigation: what the objectives know of the state",
        "",
        f"Runs: {len(runs)}. Preset: {code(runs[0].preset)}. Seeds: {', '.join(map(str, seeds))}. {_budget(runs)}",
        "",
        *_unlike(runs),
        *([_HARD] if any(MAZES[maze].style is HARD for maze in mazes) else []),
        *([f"Exogenous noise adds {', '.join(images)}.", ""] if images else []),
    ]
    for result in unfinished:
        steps = result.record["config"].get("steps", "?")
        lines += [f"Unfinished, in no table: {code(str(result.path))} at {result.step} of {steps} steps.", ""]
    return [*lines, _READING]


def _budget(runs: list[NavigationRun]) -> str:
    """What the runs cost, and where."""
    trained = [run for run in runs if run.condition.method != UNTRAINED] or runs
    timings = [run.result.files["timing"] for run in trained]
    minutes = sorted(round(float(timing["seconds"]) / 60) for timing in timings)
    took = " to ".join(dict.fromkeys(map(str, (minutes[0], minutes[-1]))))
    sets = [run.result.record.get("collection") or {} for run in runs]
    samples = {made["trajectories"] * made["trajectory_rows"] for made in sets if made}
    machines = markdown("; ".join(sorted({run.result.machine or "not recorded" for run in runs})))
    return (
        f"Budget: {_either(int(timing['steps']) for timing in timings)} gradient steps on {_either(samples)} samples, "
        f"{took} minute{'s' * (took != '1')} a run ({machines}). "
        "The paper's: 200,000 steps on 500,000 samples."
    )


def _either(counts: Iterator[int] | set[int]) -> str:
    return " or ".join(f"{count:,}" for count in sorted(set(counts))) or "unknown"


def _unlike(runs: list[NavigationRun]) -> list[str]:
    """What runs on one maze differ in beside what tells them apart: a sentence a setting."""
    lines = []
    for maze, members in groupby(runs, key=lambda run: run.condition.maze):
        mine = list(members)
        settings = pd.DataFrame([run.settings for run in mine], index=[code(run.condition.short) for run in mine])
        for name in settings:
            is_without = np.array([not getattr(run.condition, name, True) for run in mine])  # such as self_prediction
            values = settings[name][~is_without].dropna().str[: 8 if name == "set" else None]
            found = list(values.value_counts().index)
            where = [f"{one} in {', '.join(values.index[values == one].unique())}" for one in found[1:]]
            if where:
                lines.append(f"Not alike in {code(maze)}: {name} is {found[0]}, but {'; '.join(where)}.  ")
    return [*lines, ""] if lines else []


def _commands(runs: list[NavigationRun]) -> list[str]:
    """The command of every run behind the tables."""
    commands = [
        f"{run.command}  # {run.condition.maze}, {float(run.result.files['timing']['seconds']):.0f} s" for run in runs
    ]
    return [_COMMANDS, *code_block(commands, "bash")]
