"""The navigation report: the paper's tables from raw rows, each number beside the paper's, and what they say.

OUT/report.md     tables, verdicts, figures, and the command of every condition
OUT/runs.jsonl, episodes.csv, trajectories/     a results folder; `navigation report OUT` makes everything again from it
OUT/rows.csv      every number of every run
OUT/tables.csv    every number: mean, interval, seeds, the paper's number
OUT/figures/      accuracy.png, accuracy_raw.png (beside the paper's numbers), trajectories.png, observations.png
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from vd4rl_pomdp.core.options import words_of
from vd4rl_pomdp.core.text import code, code_block, markdown, write_text
from vd4rl_pomdp.envs.mazes import HARD, MAZES
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.runs.results import RUNS, Result
from vd4rl_pomdp.studies.navigation import figures
from vd4rl_pomdp.studies.navigation.claims import verdict_lines
from vd4rl_pomdp.studies.navigation.measures import refitted_error
from vd4rl_pomdp.studies.navigation.methods import UNTRAINED
from vd4rl_pomdp.studies.navigation.runs import (
    NavigationRun,
    comparable,
    find_navigation,
    flags_of,
    load_runs,
    progress,
    save_runs,
)
from vd4rl_pomdp.studies.navigation.sets import PRESETS
from vd4rl_pomdp.studies.navigation.tables import Table, make_tables, table_sections, write_tables

Samples = Callable[[], Mapping[str, np.ndarray]]
"""Draws sample observations: (n, 3, H, W) uint8 by name."""


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
        return _write(runs, unfinished, out, drawn)


def _write(
    runs: list[NavigationRun], unfinished: list[Result], out: Path, samples: Mapping[str, np.ndarray] | None
) -> Path:
    save_runs(runs, out)
    (out / "figures").mkdir(exist_ok=True)
    pictures = _draw(runs, out / "figures")
    if samples is not None:
        figures.sample_observations(samples, out / "figures" / "observations.png")
        pictures.append("observations.png")
    tables = make_tables(runs)
    write_tables(tables, out / "tables.csv")
    page = out / "report.md"
    write_text(page, "\n".join(_page(runs, unfinished, tables, pictures)) + "\n")
    return page


def _draw(runs: list[NavigationRun], folder: Path) -> list[str]:
    """Names of the figures that could be drawn."""
    state, names = refitted_error("state"), ["accuracy.png"]
    figures.accuracy_bars(runs, state, folder / "accuracy.png")
    if any(state.raw() in run.values for run in runs):
        figures.accuracy_bars(runs, state.raw(), folder / "accuracy_raw.png")
        names.append("accuracy_raw.png")
    return names + (["trajectories.png"] if figures.trajectories(runs, folder / "trajectories.png") else [])


_CAPTIONS = {
    "accuracy.png": ("Accuracy of every objective", "Bars: held-out trajectories, probe refitted on frozen states."),
    "accuracy_raw.png": ("The same in raw units", "The paper's marks are training averages."),
    "trajectories.png": (
        "True and estimated trajectories",
        "From the first row on, where little was seen: errors count later ones.",
    ),
    "observations.png": ("Sample observations", ""),
}


def _page(runs: list[NavigationRun], unfinished: list[Result], tables: list[Table], pictures: list[str]) -> list[str]:
    preset, seeds = runs[0].preset, sorted({run.seed for run in runs})
    bars = [name for name in pictures if name.startswith("accuracy")]
    lines = ["# Navigation: what the objectives know of the state", ""]
    lines += [
        f"Runs: {len(runs)}. Preset: {code(preset)}. Seeds: {', '.join(map(str, seeds))}. {_budget(runs)}",
        "",
        *_unlike(runs),
        *_variants(runs),
        *_images(runs),
        *(f"Unfinished, in no table: {code(str(result.path))} {progress(result)}.  " for result in unfinished),
        *([""] if unfinished else []),
        *_UNITS,
        "",
        "A cell of a table reads: **mean over seeds** [95% t interval] n=seeds (the paper's number).",
        'Missing: "n=1 of 3" where other cells of the maze have three seeds,',
        '"no run" where other cells of the maze, and other mazes of the row, have one.',
        "",
        *(line for name in bars for line in _figure(name)),
        *verdict_lines(runs),
        *(line for name in pictures if name not in bars for line in _figure(name)),
    ]
    return [*lines, *table_sections(tables), *_commands(runs)]


_UNITS = (
    "Errors are given in two units: percent of a standard deviation, and the simulator's own units x 100. The paper's",
    "percentages are most likely the latter, so its numbers stand beside those alone.",
)


def _figure(name: str) -> list[str]:
    title, caption = _CAPTIONS[name]
    return [f"![{title}](figures/{name})", "", *([caption, ""] if caption else [])]


def _variants(runs: list[NavigationRun]) -> list[str]:
    """What the mazes are that are not made like the paper's."""
    mazes = {run.condition.maze for run in runs}
    found = []
    if any(MAZES[maze].style is HARD for maze in mazes):
        found += [
            "`hard_` mazes are variants of the paper's. Three wider curtains hide the mass 36% of the time (its own:",
            "some 22%), every action is noisy (not a tenth of them zero and a tenth random), and the first person has",
            "another camera, a black sky and other kinematics. The paper's numbers are of its own mazes.",
            "",
        ]
    if "compass_first_person" in mazes:
        found += ["`compass_first_person` is `first_person` under a sky that is coloured by azimuth.", ""]
    return found


def _images(runs: list[NavigationRun]) -> list[str]:
    """What was added to the pictures of runs with exogenous noise, maze by maze."""
    noisy = [run for run in runs if run.condition.exogenous]
    told = [
        f"{markdown(' and '.join(dict.fromkeys(run.result.record['config']['exogenous'] for run in members)))} in "
        f"{code(maze)}"
        for maze, members in _by_maze(noisy).items()
    ]
    return [f"Exogenous noise adds {', '.join(told)}.", ""] if told else []


def _budget(runs: list[NavigationRun]) -> str:
    """What the runs cost, and where."""
    trained = [run for run in runs if run.condition.method != UNTRAINED] or runs
    steps = " or ".join(f"{count:,}" for count in sorted({int(run.facts["steps"]) for run in trained}))
    minutes = sorted(round(float(run.facts["seconds"]) / 60) for run in trained)
    took = " to ".join(dict.fromkeys(map(str, (minutes[0], minutes[-1]))))
    machines = markdown("; ".join(sorted({run.facts["machine"] or "not recorded" for run in runs})))
    samples = " or ".join(f"{count:,}" for count in sorted({_samples(run) for run in runs} - {0})) or "unknown"
    return (
        f"Budget: {steps} gradient steps on {samples} samples, "
        f"{took} minute{'s' * (took != '1')} a run ({machines}). "
        "The paper's: 200,000 steps on 500,000 samples."
    )


def _samples(run: NavigationRun) -> int:
    """Rows of its set; 0 if nothing tells how that was made."""
    made = run.collection
    return made["trajectories"] * made["trajectory_rows"] if made else 0


def _unlike(runs: list[NavigationRun]) -> list[str]:
    """What runs on one maze differ in beside what tells them apart: a sentence a setting."""
    lines = []
    for maze, members in _by_maze(runs).items():
        settings = comparable(members)
        for name in dict.fromkeys(name for one in settings for name in one):
            where: dict[str, dict[str, None]] = {}
            for run, one in zip(members, settings, strict=True):
                if name in one and not _is_without(run, name):
                    value = one[name]
                    where.setdefault(value[:8] if name == "set" else value, {})[code(run.condition.short)] = None
            if len(where) > 1:
                usual = max(where, key=lambda value: len(where[value]))
                others = "; ".join(f"{value} in {', '.join(who)}" for value, who in where.items() if value != usual)
                lines.append(f"Not alike in {code(maze)}: {name} is {usual}, but {others}.  ")
    return [*lines, ""] if lines else []


def _is_without(run: NavigationRun, setting: str) -> bool:
    """Whether a run does not do what a setting is about."""
    if setting == "steps":
        return run.condition.method == UNTRAINED
    return not getattr(run.condition, setting, True)


def _by_maze(runs: list[NavigationRun]) -> dict[str, list[NavigationRun]]:
    return {
        maze: [run for run in runs if run.condition.maze == maze] for maze in {r.condition.maze: None for r in runs}
    }


def _commands(runs: list[NavigationRun]) -> list[str]:
    """The command of every run behind the tables."""
    lines = [
        "## Commands",
        "",
        "Each line computes one run, and says on which maze and in how many seconds (wall-clock); `navigation collect`",
        "makes its data. Folders are as they were told: sets of two mazes may have lain under one name, on different",
        "machines. The grids `navigation` (the paper's own mazes) and `first_person` print the lines of all cells:",
        "`vd4rl-pomdp sweep run GRID --out runs --dry-run`.",
    ]
    commands = [line for members in _by_maze(runs).values() for line in sorted(set(map(_collect, members))) if line]
    for run in runs:
        commands.append(f"{run.facts['command']}  # {run.condition.maze}, {float(run.facts['seconds']):.0f} s")
    return [*lines, "", *code_block(commands, "bash")]


def _collect(run: NavigationRun) -> str:
    """The command that makes its set, with what differs from the preset; "" if nothing tells how that was made."""
    maze, made, usual = run.condition.maze, run.collection, PRESETS[run.preset]
    if not made:
        return ""
    words = ["vd4rl-pomdp", "navigation", "collect", "--preset", run.preset, "--maze", maze]
    words += words_of({n: value for n, value in made.items() if n != "maze" and value != getattr(usual, n)})
    return shlex.join([*words, "--out", flags_of(run.facts["command"]).get("data", f"data/{maze}")])
