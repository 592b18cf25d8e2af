"""The demo: the grid `quick`, job after job, and a report. It shows that all works, not which method is best."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.outputs import refuse_kept
from vd4rl_pomdp.sweeps.found import FoundRuns, runs_below
from vd4rl_pomdp.sweeps.grid_file import load_grid
from vd4rl_pomdp.sweeps.plan import Job, JobPlanner

GRID = "quick"
PRESETS = {"cpu": False, "smoke": True}
"""Whether a preset is the grid's testing subset."""


def demo_jobs(out: Path, preset: str = "cpu") -> list[Job]:
    """The jobs of the demo, in order; UserError for an unknown preset."""
    if preset not in PRESETS:
        raise UserError(f"unknown preset {preset!r}: choose one of {', '.join(PRESETS)}")
    runs = out / "runs"
    cells = load_grid(GRID, testing=PRESETS[preset]).cells()
    return JobPlanner(runs, out / "data", FoundRuns([]), FoundRuns(runs_below(runs))).plan(cells)


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
    print("\n".join(conclusion(jobs)))
    print(f"demo finished in {(time.monotonic() - started) / 60:.1f} minutes")


def demo_commands(jobs: list[Job], workers: int) -> Iterator[tuple[str, ...]]:
    """Words of every job's command line."""
    for job in jobs:
        yield (*job.words, *(() if job.section == "pretrain" else ("--workers", str(workers))))


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


def _mean_and_error(returns: list[float]) -> str:
    error = f" ± {np.std(returns, ddof=1) / math.sqrt(len(returns)):.0f}" if len(returns) > 1 else ""
    return f"{np.mean(returns):.0f}{error} (n = {len(returns)})"
