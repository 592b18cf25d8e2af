"""Freeze the results of smoke runs, to check bit by bit on one machine that a refactor changes nothing.

    python tools/frozen.py WORK              # compares with tools/frozen.json; exit code 1 if anything differs
    python tools/frozen.py WORK --write      # freezes the results of this code

WORK is a folder for datasets and runs; datasets are reused by later calls. Each run is hashed by its losses, weights,
probes and episodes: names and values, independent of file names. Only commands are called, not the packages' functions,
so the same script works before and after code moves. Bits depend on the processor: freeze and compare on the same one.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import shutil
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported: sums depend on the number of threads

from safetensors.numpy import load_file

from vd4rl_pomdp.cli import main

FROZEN = Path(__file__).with_name("frozen.json")
METHODS = (
    *("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a", "acro", "one_step_inverse", "curl", "driml", "homer"),
    *("random", "supervised", "supervised+a", "bc", "drq_bc", "state"),
)
INVERSE = {
    "literal_future": ["--literal-future"],
    "future_frames": ["--future-frames", "newest"],
    "future_rows": ["--n", "3"],
    "bins": ["--action-target", "bins"],
    "mse": ["--action-target", "mse"],
    "mse_l2": ["--action-target", "mse_l2"],
    "self_prediction": ["--self-prediction", "1", "--l2-states", "0.1"],
    "no_k": ["--no-k-embedding"],
    "short_memory": ["--m", "2", "--gru-layers", "2"],
    "no_corruption": ["--corruption", "none"],
    "patch": ["--corruption", "patch", "--patch-size", "20", "--patch-count", "2"],
    "zero_frames": ["--corruption", "zero_frames"],
    "emission": ["--corruption-mode", "emission"],
    "bf16": ["--precision", "bf16"],
    "drq": ["--frame-encoder", "drq"],
    "nature_half": ["--frame-encoder", "nature_half"],
    "no_shift": ["--shift", "0"],
}
"""Options of `mik+a`."""
PRETRAINED = {
    **{method: ["--method", method] for method in METHODS},
    **{f"mik+a {name}": ["--method", "mik+a", *words] for name, words in INVERSE.items()},
    "fj short": ["--method", "fj", "--m", "2"],
    "fj+a short": ["--method", "fj+a", "--m", "3"],
    "acro gru": ["--method", "acro", "--history", "gru"],
    "acro shared": ["--method", "acro", "--shift-shared"],
    "random gru": ["--method", "random", "--history", "gru"],
    "mik seed 1": ["--method", "mik", "--seed", "1"],
}
FINETUNED = {
    **{method: (method, []) for method in METHODS},
    **{f"mik+a {a}": ("mik+a", ["--algorithm", a]) for a in ("drqv2_bc", "iql", "bc")},
    "mik+a exact": ("mik+a", ["--views", "0", "--history-window", "4"]),
    "acro exact": ("acro", ["--views", "0"]),
    "mik+a two views": ("mik+a", ["--views", "2", "--update-precision", "bf16"]),
    "mik+a frame": ("mik+a", ["--readout", "frame"]),
    "mik+a both": ("mik+a", ["--readout", "frame+state"]),
    "mik+a window": ("mik+a", ["--history-window", "4"]),
    "mik+a random histories": ("mik+a", ["--random-histories", "0.5"]),
    "mik+a emission": ("mik+a emission", []),
    "mik+a patch": ("mik+a patch", []),
    "mik+a n_step 1": ("mik+a", ["--n-step", "1", "--alpha", "5", "--seed", "2"]),
}
MAZES = ("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a", "random", "supervised", "supervised+a")


def call(*words: object) -> None:
    """Run a command; an error ends everything."""
    main([str(word) for word in words])


def fingerprint(run: Path) -> dict[str, str]:
    """Short hashes of a run's results."""
    parts: dict[str, list[object]] = {"losses": [], "weights": [], "probes": [], "episodes": []}
    parts["losses"] = [sorted(json.loads(line).items()) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for part in ("encoder", "policy"):
        for path in sorted((run / part).glob("*.safetensors")):
            for name, tensor in sorted(load_file(path).items()):
                bits = hashlib.sha256(tensor.tobytes()).hexdigest()
                parts["weights"].append([part, name, str(tensor.dtype), tensor.shape, bits])
    if (run / "probe.json").exists():
        parts["probes"] += sorted(json.loads((run / "probe.json").read_text()).items())
    if (run / "results.json").exists():  # of navigation
        names = ("measure", "split", "probe", "rows", "k", "value")
        rows = json.loads((run / "results.json").read_text())["rows"]
        parts["probes"] += [[row[name] for name in names] for row in rows]
    if (run / "episodes.csv").exists():
        names = ("step", "episode_seed", "evaluated_under", "return", "length")
        with (run / "episodes.csv").open(newline="") as file:
            parts["episodes"] = [[row[name] for name in names] for row in csv.DictReader(file)]
    return {name: hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16] for name, value in parts.items() if value}


def collect(work: Path) -> None:
    """Collect the two datasets, unless they exist."""
    if not (work / "walker_walk/expert_noisy").exists():
        out = work / "walker_walk/expert_noisy"
        call("data", "collect", "--task", "walker_walk", "--quality", "expert_noisy", "--episodes", 3, "--out", out)
    if not (work / "maze").exists():
        words = ["--maze", "three_curtains", "--preset", "smoke", "--trajectories", 12, "--out", work / "maze"]
        call("navigation", "collect", *words)


def runs(work: Path) -> dict[str, dict[str, str]]:
    """Repeat all runs and hash them."""
    shutil.rmtree(work / "runs", ignore_errors=True)
    found, data = {}, work / "walker_walk/expert_noisy"
    common = ["--preset", "smoke", "--data", data, "--device", "cpu"]
    for name, words in PRETRAINED.items():
        out = work / "runs/pretrain" / name
        words = words if "--corruption" in words else ["--corruption", "patch+zero_frames", *words]
        call("pretrain", *common, *words, "--out", out)
        found[f"pretrain {name}"] = fingerprint(out)
    for name, (encoder, words) in FINETUNED.items():
        out, folder = work / "runs/finetune" / name, work / "runs/pretrain" / encoder / "encoder"
        call("finetune", *common, "--encoder", folder, *words, "--workers", 1, "--out", out)
        found[f"finetune {name}"] = fingerprint(out)
    for method in MAZES:
        out = work / "runs/maze" / method
        call("navigation", "train", "--preset", "smoke", "--data", work / "maze", "--method", method, "--out", out)
        found[f"maze {method}"] = fingerprint(out)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder of sets and runs")
    parser.add_argument("--write", action="store_true", help="freeze what this code computes")
    args = parser.parse_args()
    collect(args.work)
    now = runs(args.work)
    if args.write:
        FROZEN.write_text(json.dumps(now, indent=1) + "\n")
    then = json.loads(FROZEN.read_text())
    both = {run: (then.get(run, {}), now.get(run, {})) for run in {**then, **now}}
    other = [f"{run}: {part}" for run, (a, b) in both.items() for part in {**a, **b} if a.get(part) != b.get(part)]
    print("\n".join(other) or f"all {len(now)} runs as frozen")
    sys.exit(bool(other))
