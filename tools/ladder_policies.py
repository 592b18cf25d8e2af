"""Evaluate the policies kept by `ladder.py`: cloning losses, or returns of weight averages.

    python tools/ladder_policies.py cloning --work DIR     # from the folder that the ladder was started in
    OMP_NUM_THREADS=1 python tools/ladder_policies.py averages --work DIR

`cloning` adds missing rows to results/ladder/cloning.csv, one per finished run and rung: losses on episodes of the
run's own dataset and on held-out ones, which are collected once into DIR/held_out. `averages` adds to averaged.csv: at
every second rung, the weights of the rungs in the last half of training so far are averaged, and the average policy
plays the rung's episodes.
"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from ladder import PROGRAM, RESULTS
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from script import run_script

from finetune.features import FrozenEncoder
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.data.folder import PROVENANCE
from vd4rl_pomdp.nn.encoder_folder import load_encoder
from vd4rl_pomdp.nn.policy import load_policy
from vd4rl_pomdp.runs import CONFIG_FILE, LABELS_FILE, TIMING_FILE
from vd4rl_pomdp.runs.files import read_json, write_csv

SEED = 10_000
"""Collection seed of the held-out episodes, used by no training set."""
EPISODES = 20
"""Held-out episodes, and as many evenly spaced episodes of a run's own dataset."""


@dataclass(frozen=True)
class Config:
    """Add the missing rows to a table of results/ladder."""

    what: tyro.conf.Positional[Literal["cloning", "averages"]]
    work: Path
    """Folder of runs, datasets and snapshots; held-out episodes are collected there."""
    out: Path | None = None
    """The table; default: the one in results/ladder."""


def main(config: Config) -> None:
    """Evaluate run by run, saving after each."""
    measure, file, columns, order = TABLES[config.what]
    out = config.out or RESULTS / file
    rows: list[dict[str, Any]] = list(csv.DictReader(out.open(newline=""))) if out.exists() else []
    known = {(row["run"], int(row["step"])) for row in rows}
    runs = config.work / "runs"
    for run in sorted(path.parent for path in runs.rglob(f"finetune-*/{TIMING_FILE}")):
        name = run.relative_to(runs).as_posix()
        snapshots = {int(file.stem): file for file in (config.work / "snapshots" / name).glob("*.safetensors")}
        lacking = [step for step in sorted(snapshots) if (name, step) not in known]
        if lacking:
            print(name, file=sys.stderr)
            found = measure(run, snapshots, lacking, config.work)
            rows += [dict(zip(columns, (name, *row), strict=True)) for row in found]
            rows.sort(key=lambda row: (row["run"], *(int(row[column]) for column in order)))
            write_csv(out, columns, rows)


def cloning(run: Path, snapshots: Mapping[int, Path], lacking: list[int], work: Path) -> list[tuple[Any, ...]]:
    """Update, loss on the run's own dataset and loss on held-out episodes, for a run's policies."""
    made = read_json(run / CONFIG_FILE)["collection"]
    held_out = work / "held_out" / made["task"] / made["quality"]
    if not (held_out / PROVENANCE).exists():
        collect(CollectConfig(made["task"], made["quality"], held_out, EPISODES, SEED, episodes_per_shard=10))
    losses = [cloning_losses(run, [snapshots[step] for step in lacking], data) for data in (None, held_out)]
    return [
        (step, f"{trained_on:.6f}", f"{other:.6f}") for step, trained_on, other in zip(lacking, *losses, strict=True)
    ]


@torch.no_grad()
def cloning_losses(run: Path, files: list[Path], data: Path | None) -> list[float]:
    """Mean squared differences between policy actions and dataset actions, over decisions and dimensions.

    Observations have the run's corruption, drawn anew, and no shift, as in evaluation.

    Args:
        run: its folder, with the encoder.
        files: weights of the policies.
        data: the dataset; None: the run's own.
    """
    config = read_json(run / CONFIG_FILE)["config"]
    encoder, card = load_encoder(run / "encoder")
    dataset, policy = open_dataset(data or config["data"]), load_policy(run / "policy")
    corruption = CorruptionConfig.fill(card.corruption)
    frozen = FrozenEncoder(encoder, dataset, corruption, 0, config["precision"], config["seed"])
    view = frozen.view(config["views"])
    numbers = np.unique(np.linspace(0, dataset.num_episodes - 1, EPISODES).astype(int)).tolist()
    states = torch.cat([frozen.episode(number, view)[:-1] for number in numbers])
    actions = torch.cat([dataset.action[dataset.rows_of(number)][1:] for number in numbers])
    losses = []
    for file in files:
        policy.load_state_dict(load_file(file))
        losses.append(float((policy(states) - actions).square().mean()))
    return losses


def averages(run: Path, snapshots: Mapping[int, Path], lacking: list[int], work: Path) -> list[tuple[Any, ...]]:
    """Update, number of averaged rungs, episode and return of a run's average policies, if its encoder is trained."""
    found: list[tuple[Any, ...]] = []
    labels, config = read_json(run / LABELS_FILE), read_json(run / CONFIG_FILE)["config"]
    for step in sorted(snapshots)[3::2] if labels["method"] != "random" else []:
        if step in lacking:
            files = [snapshots[rung] for rung in sorted(snapshots) if step / 2 < rung <= step]
            scratch = work / "averaged"
            shutil.rmtree(scratch, ignore_errors=True)
            shutil.copytree(run, scratch, ignore=shutil.ignore_patterns("checkpoints"))
            tensors = [load_file(file) for file in files]
            mean = {
                name: torch.stack([each[name].double() for each in tensors]).mean(0).to(last.dtype)
                for name, last in tensors[-1].items()
            }
            with safe_open(files[-1], "pt") as file:
                save_file(mean, scratch / "policy" / "model.safetensors", metadata=file.metadata())
            under = ["--corruption", labels["corruption"], "--episodes", str(config["eval_episodes"])]
            words = [PROGRAM, "evaluate", str(scratch), *under, "--workers", "1", "--json"]
            result = json.loads(subprocess.run(words, stdout=subprocess.PIPE, check=True).stdout)
            for each in result["under"][labels["corruption"]]["episodes"]:
                found.append((step, len(files), each["episode"], round(each["return"], 4)))
    return found


TABLES = {
    "cloning": (cloning, "cloning.csv", ("run", "step", "trained_on", "held_out"), ("step",)),
    "averages": (averages, "averaged.csv", ("run", "step", "rungs", "episode", "return"), ("step", "episode")),
}
"""By table: function, file, columns, and sort keys of a run's rows."""


if __name__ == "__main__":
    run_script(main, Config)
