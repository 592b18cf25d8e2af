"""Measure the cloning loss of each policy that the ladder kept, on episodes it learned from and on held-out ones.

    python tools/ladder_cloning.py --work DIR    # from the folder that the ladder was started in

Adds to results/ladder/cloning.csv what it lacks, a row for every finished run and rung. The held-out episodes of a task
and quality are collected once into DIR/held_out.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from script import run_script

from finetune.features import FrozenEncoder
from finetune.path import EPISODES, DataPath
from vd4rl_pomdp.core.reading import read_bytes, read_tensors, safetensors_metadata
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.data.folder import PROVENANCE
from vd4rl_pomdp.nn.encoder_folder import load_encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs import CONFIG_FILE, TIMING_FILE
from vd4rl_pomdp.runs.files import Row, read_json, write_csv

RESULTS = Path(__file__).parents[1] / "results" / "ladder"
COLUMNS = ("run", "step", "trained_on", "held_out")
SEED = 10_000
"""Collection seed of the held-out episodes: no training set has it."""


@dataclass(frozen=True)
class Config:
    """Measure what results/ladder/cloning.csv lacks."""

    work: Path
    """Folder of runs, sets and snapshots; held-out episodes are collected there, too."""
    out: Path = RESULTS / "cloning.csv"
    """The table."""


def main(config: Config) -> None:
    """Measure run after run, and keep each."""
    rows = list(csv.DictReader(config.out.open(newline=""))) if config.out.exists() else []
    known = {(row["run"], int(row["step"])) for row in rows}
    runs = config.work / "runs"
    for run in sorted(path.parent for path in runs.rglob(f"finetune-*/{TIMING_FILE}")):
        name = run.relative_to(runs).as_posix()
        policies = {step: path for step, path in kept(config.work / "snapshots" / name) if (name, step) not in known}
        if policies:
            print(name, file=sys.stderr)
            losses = [cloning_losses(run, policies, data) for data in (None, held_out(run, config.work / "held_out"))]
            found = zip(policies, *losses, strict=True)
            rows += [dict(zip(COLUMNS, (name, step, f"{a:.6f}", f"{b:.6f}"), strict=True)) for step, a, b in found]
            rows.sort(key=lambda row: (row["run"], int(row["step"])))
            write_csv(config.out, COLUMNS, rows)


def kept(folder: Path) -> Iterator[tuple[int, Path]]:
    """Updates and files of a run's policies, in order."""
    files = {int(safetensors_metadata(read_bytes(path))["step"]): path for path in folder.glob("*.safetensors")}
    return iter(sorted(files.items()))


def held_out(run: Path, folder: Path) -> Path:
    """Episodes of the task and quality of a run's data, collected if they are not there."""
    made = _record(run)["collection"]
    place = folder / made["task"] / made["quality"]
    if not (place / PROVENANCE).exists():
        collect(CollectConfig(made["task"], made["quality"], place, EPISODES, SEED, episodes_per_shard=10))
    return place


def cloning_losses(run: Path, policies: Mapping[int, Path], data: Path | None) -> list[float]:
    """Losses of a run's policies under its corruption, drawn as in its first view, without random shifts.

    Args:
        run: its folder, with the encoder.
        policies: files by update.
        data: a set; None: the run's own, of which as many episodes are taken.
    """
    config = _record(run)["config"]
    encoder, card = load_encoder(run / "encoder")
    dataset, seed = open_dataset(data or config["data"]), config.get("view_seed")
    seed = config["seed"] if seed is None else seed
    frozen = FrozenEncoder(encoder, dataset, CorruptionConfig.fill(card.corruption), 0, config["precision"], seed)
    path = DataPath(dataset, None, cache(partial(frozen.episode, view=frozen.view(0))))
    shape = read_json(run / "policy" / CONFIG_FILE)
    losses = []
    for file in policies.values():
        policy = Policy(**shape)
        policy.load_state_dict(read_tensors(file))
        losses.append(path.cloning_loss(policy.eval()))
    return losses


def _record(run: Path) -> Row:
    return read_json(run / CONFIG_FILE)


if __name__ == "__main__":
    run_script(main, Config)
