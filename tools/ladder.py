"""Carry out results/ladder's grid, and keep what its page needs besides a run's last policy.

    OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE python tools/ladder.py --work DIR [--jobs 1] [--only ...]
    python tools/ladder.py --work DIR --rows    # adds what is finished to results/ladder, at any time

Runs `vd4rl-pomdp sweep run results/ladder/grid.toml`, taking finished rows from results/ladder. A fine-tuning
overwrites its policy at each evaluation; every version is copied to DIR/snapshots, since the cloning loss on held-out
episodes is measured for each rung. Re-run the same command to resume.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path(__file__).parent.parent / "results" / "ladder"
CURVES = ("q", "critic_loss", "actor_loss", "bc_loss")
CURVE_EVERY = 2000
"""Updates between two rows of curves.csv, each a mean over the updates of a row of metrics."""
_PROGRAM = str(Path(sys.executable).parent / "vd4rl-pomdp")


def keep_policies(runs: Path, snapshots: Path) -> None:
    """Copy each policy that is not kept yet, under the update of the evaluation that it plays."""
    for weights in runs.rglob("policy/model.safetensors"):
        run = weights.parent.parent
        rows = (run / "metrics.jsonl").read_text().splitlines() if (run / "metrics.jsonl").exists() else []
        steps = [json.loads(row)["step"] for row in rows[-1:]]
        target = snapshots / run.relative_to(runs) / f"{steps[0] if steps else 0}.safetensors"
        newest = max((path.stat().st_mtime for path in target.parent.glob("*.safetensors")), default=0.0)
        if weights.stat().st_mtime > newest:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(weights, target)


def keep_rows(runs: Path) -> int:
    """Add finished runs to results/ladder, and the curves of their losses and critic values to its curves.csv."""
    code = subprocess.run([_PROGRAM, "results", "add", str(runs), "--out", str(RESULTS)]).returncode
    with (RESULTS / "curves.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, ["run", "step", *CURVES], extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        for metrics in sorted(runs.rglob("finetune-*/metrics.jsonl")):
            if (metrics.parent / "timing.json").exists():
                rows = [json.loads(line) for line in metrics.read_text().splitlines()]
                name = metrics.parent.relative_to(runs).as_posix()
                table.writerows({"run": name} | row for row in rows if "q" in row and row["step"] % CURVE_EVERY == 0)
    return code


def main() -> int:
    """Run the sweep to its end, or keep what it has."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--work", type=Path, required=True, help="folder of runs, sets and snapshots")
    parser.add_argument("--jobs", default="1")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--rows", action="store_true")
    args = parser.parse_args()
    if args.rows:
        return keep_rows(args.work / "runs")
    command = [_PROGRAM, "sweep", "run", str(RESULTS / "grid.toml")]
    command += ["--out", str(args.work / "runs"), "--data", str(args.work / "data"), "--jobs", args.jobs]
    command += ["--done", str(RESULTS)] if (RESULTS / "runs.jsonl").exists() else []
    command += ["--only", *args.only] if args.only else []
    sweep = subprocess.Popen(command)
    while sweep.poll() is None:
        time.sleep(20)
        keep_policies(args.work / "runs", args.work / "snapshots")
    return sweep.returncode


if __name__ == "__main__":
    sys.exit(main())
