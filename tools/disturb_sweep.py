"""24 smoke runs, once undisturbed and once while everything goes wrong: are the result rows the same?

    python tools/disturb_sweep.py --out results/sweeps [--seed 0]

In the second sweep 20 random jobs are ended by SIGKILL, the driver twice, one checkpoint is truncated, and the disk is
full for a while. The moments are random, spread over the time that the first sweep took. Both lie on a disk in memory,
which needs the right to mount one: of root, or of `unshare -rm`, under which the script starts itself anew otherwise.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from vd4rl_pomdp.runs.provenance import git_commit, machine, versions
from vd4rl_pomdp.sweeps.folder import SweepFolder

GRID = """
title = "24 smoke runs"
seed = [0, 1]
preset = "smoke"

[collect]
task = "walker_walk"
quality = "expert_noisy"
episodes = 2

[pretrain]
method = ["mik+a", "mik", "acro", "curl", "random", "supervised+a"]
corruption = ["patch", "patch+zero_frames"]
steps = 60
checkpoint_every = 5

[finetune]
updates = 120
eval_every = 60
checkpoint_every = 10
"""
KILLS, DRIVER_KILLS = 20, 2
DISK_MIB = 2000
FULL_S = 20.0
COMPARED = ("episodes.csv", "metrics.jsonl", "probe.json", "model.safetensors")
"""Files of a run that are its result."""


@dataclass(frozen=True)
class DisturbCommand:
    """Disturb a sweep, and compare its rows with those of one that was left alone."""

    out: Path = Path("results/sweeps")
    """Folder of the report."""
    seed: int = 0
    """Seed of what is disturbed when."""
    jobs: int = 2
    """Jobs at a time."""


class Sweep:
    """A driver and its jobs in a folder."""

    def __init__(self, out: Path, grid: Path, jobs: int) -> None:
        self.out = out
        self._command = [sys.executable, "-m", "vd4rl_pomdp", "sweep", "run", str(grid), "--out", str(out)]
        self._command += ["--jobs", str(jobs)]
        self.start()

    def start(self) -> None:
        """Start the driver."""
        self.driver = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    @property
    def jobs(self) -> list[int]:
        """Process ids of the driver's jobs."""
        children = Path(f"/proc/{self.driver.pid}/task/{self.driver.pid}/children")
        try:
            return [int(word) for word in children.read_text().split()]
        except OSError:
            return []

    def require_driver(self) -> None:
        """Raise RuntimeError if the driver has ended: nothing is left to disturb."""
        if self.driver.poll() is not None:
            raise RuntimeError(f"the driver ended with {self.driver.returncode} before it was disturbed")


def kill_a_job(sweep: Sweep, draw: random.Random) -> str:
    """End a random job at once."""
    while not (jobs := sweep.jobs):
        sweep.require_driver()
        time.sleep(0.05)
    os.kill(draw.choice(jobs), signal.SIGKILL)
    return "a job killed"


def kill_the_driver(sweep: Sweep, draw: random.Random) -> str:
    """End the driver at once, and start another."""
    sweep.driver.kill()
    sweep.driver.wait()
    sweep.start()
    return "the driver killed"


def truncate_a_checkpoint(sweep: Sweep, draw: random.Random) -> str:
    """Kill all jobs when one has two checkpoints, and cut its newest in half."""
    while True:
        for path in sweep.out.rglob("checkpoints/*.pt"):
            run, step = path.parents[1], path.stem
            if step.isdecimal() and len(_steps(run)) > 1 and int(step) == max(_steps(run)):
                for job in sweep.jobs:
                    os.kill(job, signal.SIGKILL)
                if not (run / "timing.json").exists() and path.exists():
                    os.truncate(path, path.stat().st_size // 2)
                    return f"the checkpoint of step {step} truncated"
        sweep.require_driver()
        time.sleep(0.02)


def _steps(run: Path) -> list[int]:
    return [int(path.stem) for path in (run / "checkpoints").iterdir() if path.stem.isdecimal()]


def fill_the_disk(sweep: Sweep, draw: random.Random) -> str:
    """Leave no byte of the disk free for a while."""
    ballast = sweep.out.parent / "ballast"
    until = time.monotonic() + FULL_S
    with ballast.open("wb", buffering=0) as file:
        while time.monotonic() < until:
            try:
                file.write(bytes(2**20))
            except OSError:
                time.sleep(0.01)
    ballast.unlink()
    return f"the disk full for {FULL_S:.0f} s"


def disturb(sweep: Sweep, seconds: float, draw: random.Random) -> Iterator[str]:
    """Do everything that goes wrong, at random moments within some seconds."""
    events = [kill_a_job] * KILLS + [kill_the_driver] * DRIVER_KILLS + [truncate_a_checkpoint, fill_the_disk]
    draw.shuffle(events)
    began = time.monotonic()
    for moment, event in zip(sorted(draw.uniform(0, seconds) for _ in events), events, strict=True):
        time.sleep(max(0.0, began + moment - time.monotonic()))
        yield event(sweep, draw)


def rows(out: Path) -> dict[str, str]:
    """Hashes of the files that are the result, by name below a sweep's folder."""
    found = (path for name in COMPARED for path in out.rglob(name) if "checkpoints" not in path.parts)
    return {path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def main(command: DisturbCommand) -> None:
    """Run both sweeps, compare, and write the report; exit code 1 if the rows differ."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", folder], check=True)
        try:
            result = compare(Path(folder), command)
        finally:
            subprocess.run(["umount", "-l", folder], check=True)
    command.out.mkdir(parents=True, exist_ok=True)
    (command.out / "disturbed.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({name: value for name, value in result.items() if name != "events"}, indent=1))
    sys.exit(0 if result["same"] else 1)


def compare(folder: Path, command: DisturbCommand) -> dict[str, Any]:
    """Both sweeps, in a folder that is a disk of its own."""
    grid, draw = folder / "grid.toml", random.Random(command.seed)
    grid.write_text(GRID, encoding="utf-8")
    began = time.monotonic()
    alone = Sweep(folder / "alone", grid, command.jobs)
    code = alone.driver.wait()
    seconds = time.monotonic() - began
    print(f"undisturbed: {seconds:.0f} s, exit code {code}", flush=True)
    expected = rows(folder / "alone")
    shutil.rmtree(folder / "alone")
    began, events = time.monotonic(), []
    sweep = Sweep(folder / "disturbed", grid, command.jobs)
    for event in disturb(sweep, seconds, draw):
        events.append(f"{time.monotonic() - began:.1f} s: {event}")
        print(events[-1], flush=True)
    codes = [code, sweep.driver.wait()]
    found = rows(folder / "disturbed")
    made = SweepFolder(folder / "disturbed")
    jobs = [job for plan in made.plans() for job in plan.jobs]
    attempts = [row for tried in made.attempts(jobs).values() for row in tried]
    return {
        "same": expected == found and bool(expected) and codes == [0, 0],
        "files_compared": len(expected),
        "files_that_differ": sorted(name for name in expected | found if expected.get(name) != found.get(name)),
        "runs": len({name.rpartition("/")[0] for name in expected if name.endswith("episodes.csv")}),
        "exit_codes": codes,
        "seconds_undisturbed": round(seconds, 1),
        "seconds_disturbed": round(time.monotonic() - began, 1),
        "attempts_by_end": dict(Counter(row["cause"] for row in attempts)),
        "events": events,
        "seed": command.seed,
        "jobs": command.jobs,
        "commit": git_commit(),
        "versions": versions(),
        "machine": machine(),
    }


if __name__ == "__main__":
    if os.geteuid() != 0:
        os.execvp("unshare", ["unshare", "-rm", sys.executable, *sys.argv])
    main(tyro.cli(DisturbCommand))
