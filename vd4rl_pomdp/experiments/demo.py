"""The demo: the grids `quick` and `quick_navigation`, job after job, a report and a film.

It shows that all works, not which method is best.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.experiments.navigation.film import write_film
from vd4rl_pomdp.experiments.navigation.runs import load_runs
from vd4rl_pomdp.mazes import get_maze
from vd4rl_pomdp.navigation.measures import refitted_error
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.outputs import refuse_kept
from vd4rl_pomdp.sweeps.found import FoundRuns, runs_below
from vd4rl_pomdp.sweeps.grid_file import load_grid
from vd4rl_pomdp.sweeps.plan import Job, JobPlanner

GRIDS = {"runs": "quick", "navigation": "quick_navigation"}
"""What is carried out, by the folder that it goes to."""
FILM = "navigation.gif"
_WITHOUT_WORKERS = ("pretrain", "navigation_train")
PRESETS = {"cpu": False, "smoke": True}
"""Whether a preset is the grid's testing subset."""


def demo_jobs(out: Path, preset: str = "cpu") -> list[Job]:
    """The jobs of the demo, in order; UserError for an unknown preset."""
    if preset not in PRESETS:
        raise UserError(f"unknown preset {preset!r}: choose one of {', '.join(PRESETS)}")
    jobs = []
    for folder, grid in GRIDS.items():
        runs, cells = out / folder, load_grid(grid, testing=PRESETS[preset]).cells()
        jobs += JobPlanner(runs, out / "data", FoundRuns([]), FoundRuns(runs_below(runs))).plan(cells)
    return jobs


def demo(out: Path, workers: int, preset: str, run: Callable[[list[str]], None]) -> None:
    """Run every command of the demo, printing each so that it can be run by hand.

    Args:
        out: folder of data, runs and report.
        workers: processes, 0 for every core.
        preset: how long the stages take, one of PRESETS; UserError for another.
        run: what carries out one command line.
    """
    refuse_kept(out)
    started = time.monotonic()
    jobs = demo_jobs(out, preset)
    report = ("report", str(out / "runs"), "--out", str(out / "report"))
    for words in (*demo_commands(jobs, workers), report):
        print(f"\n$ vd4rl-pomdp {' '.join(words)}", file=sys.stderr)
        run(list(words))
    print("\n".join([*conclusion(jobs), *show_navigation(jobs, out / FILM)]))
    print(f"demo finished in {(time.monotonic() - started) / 60:.1f} minutes")


def demo_commands(jobs: list[Job], workers: int) -> Iterator[tuple[str, ...]]:
    """Words of every job's command line."""
    for job in jobs:
        yield (*job.words, *(() if job.section in _WITHOUT_WORKERS else ("--workers", str(workers))))


def conclusion(jobs: list[Job]) -> Iterator[str]:
    """What the returns of the demo's methods say, and how sure it is: lines of text."""
    policies = [(dict(job.settings), job.folder) for job in jobs if job.section == "finetune"]
    corruption = policies[0][0]["corruption"]
    yield f"Returns under {corruption}, and where nothing is hidden (mean ± standard error over episodes):"
    for settings, folder in policies:
        rows = read_episodes(folder / "episodes.csv")
        last = max(row["step"] for row in rows)
        shown = (_mean_and_error([r["return"] for r in rows if (r["step"], r["evaluated_under"]) == (last, under)])
                 for under in (corruption, "none"))  # fmt: skip
        yield f"  {settings['method']:<8}" + ", ".join(shown)
    yield "One seed each: another may end elsewhere. What several seeds say of 100 episodes is in results/control."


def show_navigation(jobs: list[Job], film: Path) -> Iterator[str]:
    """Write the film, and say how far each method misses the mass while a curtain hides it: lines of text."""
    runs = load_runs([job.folder for job in jobs if job.section == "navigation_train"])
    trajectories = {run.condition.method: run.trajectory for run in runs if run.trajectory is not None}
    write_film(trajectories, get_maze(runs[0].condition.maze), film)
    yield "Error of the position while a curtain hides the mass, in % of a standard deviation (held out, one seed):"
    for run in runs:
        error = run.values.get(refitted_error("position", rows="hidden"))
        yield f"  {run.condition.method:<12}{'no hidden step' if error is None else f'{error:.0f}'}"
    yield f"The mass, and where each takes it to be: {film}"


def _mean_and_error(returns: list[float]) -> str:
    error = f" ± {np.std(returns, ddof=1) / math.sqrt(len(returns)):.0f}" if len(returns) > 1 else ""
    return f"{np.mean(returns):.0f}{error} (n = {len(returns)})"
