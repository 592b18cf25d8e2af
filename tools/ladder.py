"""Run results/ladder's grid, and keep every policy version and curve that its page needs.

    OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE python tools/ladder.py --work DIR [--jobs 1] [--only ...]
    python tools/ladder.py --work DIR --rows    # adds finished runs to results/ladder, at any time

Runs `vd4rl-pomdp sweep run results/ladder/grid.toml`, skipping runs with finished rows in results/ladder. A fine-tuning
overwrites its policy at each evaluation, so every version is copied to DIR/snapshots: the cloning loss on held-out
episodes is measured for each rung (`ladder_policies.py`). Re-run the same command to resume.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import time
from pathlib import Path

from vd4rl_pomdp.core.reading import safetensors_metadata
from vd4rl_pomdp.runs.files import write_bytes, write_csv

RESULTS = Path(__file__).parent.parent / "results" / "ladder"
CURVES = ("q", "critic_loss", "actor_loss", "bc_loss")
PROGRAM = str(Path(sys.executable).parent / "vd4rl-pomdp")


def keep_policies(runs: Path, snapshots: Path) -> None:
    """Copy each new policy version to a file named by its update."""
    for weights in runs.rglob("policy/model.safetensors"):
        content = weights.read_bytes()  # read once, as a new version may replace the file at any time
        step = safetensors_metadata(content)["step"]
        kept = snapshots / weights.parent.parent.relative_to(runs) / f"{step}.safetensors"
        if not kept.exists():
            write_bytes(kept, content)


def keep_rows(runs: Path) -> int:
    """Add finished runs to results/ladder, and their losses and critic values to its curves.csv."""
    code = subprocess.run([PROGRAM, "results", "add", str(runs), "--out", str(RESULTS)]).returncode
    path = RESULTS / "curves.csv"
    rows: list[dict[str, str]] = list(csv.DictReader(path.open(newline=""))) if path.exists() else []
    known = {row["run"] for row in rows}  # also of runs in other work folders, which `sweep run --done` skips here
    for metrics in runs.rglob("finetune-*/metrics.jsonl"):
        name = metrics.parent.relative_to(runs).as_posix()
        if name not in known and (metrics.parent / "timing.json").exists():
            rows += [{"run": name} | row for row in curve_of(metrics)]
    write_csv(path, ["run", "step", *CURVES], sorted(rows, key=lambda row: (Path(row["run"]), int(row["step"]))))
    return code


def curve_of(metrics: Path) -> list[dict[str, str]]:
    """Rows of curves.csv from a run's metrics.jsonl, each a mean over the updates since the previous row."""
    rows = [row for row in map(json.loads, metrics.read_text().splitlines()) if "q" in row]
    return [{"step": row["step"]} | {name: f"{row[name]:.5g}" for name in CURVES} for row in rows]


def main() -> int:
    """Run the sweep, or with --rows add finished runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--work", type=Path, required=True, help="folder of runs, sets and snapshots")
    parser.add_argument("--jobs", default="1")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--rows", action="store_true")
    args = parser.parse_args()
    if args.rows:
        return keep_rows(args.work / "runs")
    command = [PROGRAM, "sweep", "run", str(RESULTS / "grid.toml")]
    command += ["--out", str(args.work / "runs"), "--data", str(args.work / "data"), "--jobs", args.jobs]
    command += ["--done", str(RESULTS)] if (RESULTS / "runs.jsonl").exists() else []
    command += ["--only", *args.only] if args.only else []
    sweep = subprocess.Popen(command)
    while True:
        ended = sweep.poll() is not None
        keep_policies(args.work / "runs", args.work / "snapshots")  # once more after the end, for the last run
        if ended:
            return sweep.returncode
        time.sleep(20)


if __name__ == "__main__":
    sys.exit(main())
