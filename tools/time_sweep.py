"""What a sweep costs beside its jobs: the same 24 smoke runs by hand, one job at a time, and two at a time.

    python tools/time_sweep.py --out results/sweeps

By hand: every command of the plan in a process of its own, one after the other, as a shell does it. On a machine that
does nothing else, or the numbers say little. `order` says what ran first: caches are warm for what runs later.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro
from disturb_sweep import GRID

from vd4rl_pomdp.runs.provenance import git_commit, machine, versions
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.plan import DATA, plan_jobs


@dataclass(frozen=True)
class TimeCommand:
    """Time a sweep."""

    out: Path = Path("results/sweeps")
    """Folder of the report."""


def by_hand(out: Path, grid: Path) -> None:
    """Run all commands one after the other."""
    for job in plan_jobs(load_grid(str(grid)).cells(), out, out / DATA)[0]:
        _run(["-m", "vd4rl_pomdp", *job.words])


def sweep(jobs: int) -> Callable[[Path, Path], None]:
    """Run a sweep with some jobs at a time."""
    return lambda out, grid: _run(
        ["-m", "vd4rl_pomdp", "sweep", "run", str(grid), "--out", str(out), "--jobs", str(jobs)]
    )


def _run(words: list[str]) -> None:
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def main(command: TimeCommand) -> None:
    """Time all three and write the report."""
    seconds, busy = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        grid = Path(folder) / "grid.toml"
        grid.write_text(GRID, encoding="utf-8")
        for name, run in {"one_at_a_time": sweep(1), "by_hand": by_hand, "two_at_a_time": sweep(2)}.items():
            began = time.monotonic()
            run(Path(folder) / name, grid)
            seconds[name] = round(time.monotonic() - began, 1)
            made = SweepFolder(Path(folder) / name)
            jobs = [job for plan in made.plans() for job in plan.jobs] if name != "by_hand" else []
            attempts = made.attempts(jobs).values()
            busy[name] = round(sum(row["seconds"] for rows in attempts for row in rows), 1)
            print(name, seconds[name], busy[name], flush=True)
    result = {
        "seconds": seconds,
        "seconds_of_jobs": {name: value for name, value in busy.items() if value},
        "scheduling_over_by_hand": round(seconds["one_at_a_time"] / seconds["by_hand"] - 1, 4),
        "two_over_one": round(seconds["two_at_a_time"] / seconds["one_at_a_time"], 3),
        "order": list(seconds),
        "commit": git_commit(),
        "versions": versions(),
        "machine": machine(),
    }
    command.out.mkdir(parents=True, exist_ok=True)
    (command.out / "timed.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main(tyro.cli(TimeCommand))
