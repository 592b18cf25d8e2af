"""Evaluate means of the policies that the ladder kept: is it the training that moves a return, or the last weights?

    OMP_NUM_THREADS=1 python tools/ladder_average.py --work DIR    # from the folder that the ladder was started in

At every second rung the weights of the rungs in the last half of the updates so far are averaged, and the mean policy
plays the rung's episodes. Adds to results/ladder/averaged.csv what it lacks, an episode a row.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from vd4rl_pomdp.runs.files import write_csv

TABLE = Path(__file__).parents[1] / "results" / "ladder" / "averaged.csv"
COLUMNS = ("run", "step", "rungs", "episode", "return")
_PROGRAM = str(Path(sys.executable).parent / "vd4rl-pomdp")


def main() -> None:
    """Evaluate what the table lacks, and keep each mean at once."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--work", type=Path, required=True, help="folder of runs and snapshots")
    work = parser.parse_args().work
    rows = list(csv.DictReader(TABLE.open(newline=""))) if TABLE.exists() else []
    known = {(row["run"], int(row["step"])) for row in rows}
    for timing in sorted((work / "runs").rglob("finetune-*/timing.json")):
        name = timing.parent.relative_to(work / "runs").as_posix()
        kept = {int(file.stem): file for file in (work / "snapshots" / name).glob("*.safetensors")}
        for step in sorted(kept)[3::2] if "random" not in name else []:
            if (name, step) in known:
                continue
            files = [kept[rung] for rung in sorted(kept) if step / 2 < rung <= step]
            print(name, step, len(files), file=sys.stderr)
            for episode in episodes_of(timing.parent, files, work / "averaged"):
                rows.append(dict(zip(COLUMNS, (name, step, len(files), *episode), strict=True)))
            rows.sort(key=lambda row: (row["run"], int(row["step"]), int(row["episode"])))
            write_csv(TABLE, COLUMNS, rows)


def episodes_of(run: Path, policies: list[Path], scratch: Path) -> list[tuple[int, float]]:
    """Number and return of a run's episodes, played by the mean of policies."""
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.copytree(run, scratch, ignore=shutil.ignore_patterns("checkpoints"))
    tensors = [load_file(file) for file in policies]
    mean = {
        name: torch.stack([each[name].double() for each in tensors]).mean(0).to(last.dtype)
        for name, last in tensors[-1].items()
    }
    with safe_open(policies[-1], "pt") as file:
        save_file(mean, scratch / "policy" / "model.safetensors", metadata=file.metadata())
    config = json.loads((run / "config.json").read_text())["config"]
    labels = json.loads((run / "labels.json").read_text())
    under = ["--corruption", labels["corruption"], "--episodes", str(config["eval_episodes"]), "--workers", "1"]
    told = subprocess.run([_PROGRAM, "evaluate", str(scratch), *under, "--json"], stdout=subprocess.PIPE, check=True)
    found = json.loads(told.stdout)["under"][labels["corruption"]]["episodes"]
    return [(each["episode"], round(each["return"], 4)) for each in found]


if __name__ == "__main__":
    main()
