"""The demo: the grids `quick` and `quick_navigation` as one sweep, with a report and a video.

It shows that everything works, not which method is best.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from vd4rl_pomdp.cli.hub import play
from vd4rl_pomdp.cli.parsing import command
from vd4rl_pomdp.cli.report import report
from vd4rl_pomdp.cli.sweeps import carry_out
from vd4rl_pomdp.core.errors import refuse_no_folder, refuse_unknown
from vd4rl_pomdp.envs.mazes import get_maze
from vd4rl_pomdp.report.stats import mean_and_error
from vd4rl_pomdp.runs import EPISODES_FILE, PROBE_FILE
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.runs.outputs import refuse_kept
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.options import LocalOptions

if TYPE_CHECKING:
    from vd4rl_pomdp.sweeps.plan import Job

GRIDS = {"runs": "quick"} | ({"navigation": "quick_navigation"} if find_spec("gymnasium_robotics") else {})
"""Grid by output folder; mazes only if their extra is installed."""
FILM = "navigation.gif"
PAIR = tuple(f"walker_walk/medium_expert/patch+zero_frames/{method}" for method in ("mik+a", "acro"))
"""Shipped agents: the main comparison of results/protocol.md."""
DUEL = "agents.webp"
PRESETS = {"cpu": False, "smoke": True}
"""By preset, whether the grid's testing subset runs and one episode is played instead of ten."""
MOST_AT_ONCE = 4
"""Maximum concurrent jobs; more would not finish sooner."""


def demo_jobs(out: Path, preset: str = "cpu") -> list[Job]:
    """The demo's jobs, in order; UserError for an unknown preset."""
    from vd4rl_pomdp.sweeps.plan import plan_jobs

    refuse_unknown("preset", preset, PRESETS)
    jobs = []
    for folder, grid in GRIDS.items():
        runs, cells = out / folder, load_grid(grid, testing=PRESETS[preset]).cells()
        jobs += plan_jobs(cells, runs, out / "data")[0]
    return jobs


@command
def demo(out: Path = Path("runs/demo"), jobs: int = 0, preset: str = "cpu") -> None:
    """Play two trained agents, then run every stage on small datasets, in minutes: a table, a report, videos.

    Args:
        out: Folder of the demo's data and runs; re-run the same command to resume.
        jobs: Concurrent jobs; 0: as many as the GPUs take, or one per core up to 4.
        preset: cpu: minutes; smoke: only tests that every stage runs.
    """
    from vd4rl_pomdp.runs.workers import count_workers
    from vd4rl_pomdp.sweeps.driver import visible_gpus
    from vd4rl_pomdp.sweeps.folder import SweepFolder

    started = time.monotonic()
    at_once = 0 if visible_gpus() else min(count_workers(0), MOST_AT_ONCE)  # 0: one per GPU
    options = LocalOptions(jobs=jobs or at_once)
    options.check()
    refuse_no_folder(out)
    refuse_kept(out)
    planned, folder = demo_jobs(out, preset), SweepFolder(out)
    play([*PAIR, "--episodes", "1" if PRESETS[preset] else "10", "--film", str(out / DUEL)], "vd4rl-pomdp agents play")
    print("One training seed each. All seeds: results/protocol. Now the same from the start, small:", flush=True)
    words = ["report", str(out / "runs"), "--out", str(out / "report")]
    for line in (*(job.words for job in planned if not job.finished), words):  # to repeat them by hand
        print(f"$ vd4rl-pomdp {shlex.join(line)}", file=sys.stderr)
    print(f"Progress: vd4rl-pomdp sweep status {out}; output: {folder.path / 'logs'}", file=sys.stderr)
    carry_out([folder.keep_plan("demo", planned)], folder, "local", options)
    report(words[1:], "vd4rl-pomdp report")
    print("\n".join(conclusion(planned)))
    if "navigation" in GRIDS:
        print("\n".join(show_navigation(planned, out / FILM)))
    else:
        print("The mazes are skipped: they need the extra `navigation`.")
    print(f"demo finished in {(time.monotonic() - started) / 60:.1f} minutes")


def conclusion(jobs: list[Job]) -> Iterator[str]:
    """Summary lines: probe errors and returns of the demo's methods, with standard errors."""
    from vd4rl_pomdp.report.load import PROBES

    policies = [(job.settings, job.folder) for job in jobs if job.section == "finetune"]
    corruption = policies[0][0]["corruption"]
    yield f"Under {corruption}, errors of linear probes for pose and velocity (in % of a"
    yield "standard deviation; 60 to 80 for an uninformative encoder), and returns"
    yield "(mean ± standard error over episodes):"
    for settings, folder in policies:
        rows = read_episodes(folder / EPISODES_FILE)
        last = max(row["step"] for row in rows)
        returns = [row["return"] for row in rows if row["step"] == last]
        probe = read_json(folder / PROBE_FILE)
        known = ", ".join(f"{probe[name]:.0f}" for name in PROBES)
        yield f"  {settings['method']:<8}{known:<10}{mean_and_error(returns)} (n = {len(returns)})"
    yield "One seed each: between seeds probe errors hardly vary, but returns do."
    yield "Three seeds on 100 episodes: results/earlier."


def show_navigation(jobs: list[Job], film: Path) -> Iterator[str]:
    """Write the video; yield lines with each method's position error while a curtain hides the mass."""
    from vd4rl_pomdp.studies.navigation import runs as mazes
    from vd4rl_pomdp.studies.navigation.figures import write_film

    runs = mazes.load_runs(mazes.find_navigation([job.folder for job in jobs if job.section == "navigation_train"]))
    trajectories = {run.condition.method: run.trajectory for run in runs if run.trajectory is not None}
    write_film(trajectories, get_maze(runs[0].condition.maze), film)
    yield "Held-out position error behind curtains, % of a standard deviation (one seed):"
    for run in runs:
        error = run.values.get(mazes.refitted_error("position", rows="hidden"))
        yield f"  {run.condition.method:<12}{'no hidden step' if error is None else f'{error:.0f}'}"
    yield f"Film of the mass and of each method's estimate: {film}"
