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
from pathlib import Path

import numpy as np
import torch
from script import run_script

from finetune.features import FrozenEncoder
from vd4rl_pomdp.core.reading import read_bytes, read_tensors, safetensors_metadata
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.data.folder import PROVENANCE
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs import CONFIG_FILE, TIMING_FILE
from vd4rl_pomdp.runs.files import Row, read_json, write_csv

RESULTS = Path(__file__).parents[1] / "results" / "ladder"
COLUMNS = ("run", "step", "trained_on", "held_out")
SEED = 10_000
"""Collection seed of the held-out episodes: no training set has it."""
EPISODES = 20
"""Held-out episodes, and episodes of a run's own set beside them, evenly spaced."""


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


@torch.no_grad()
def cloning_losses(run: Path, policies: Mapping[int, Path], data: Path | None) -> list[float]:
    """Mean squared differences of the actions of a run's policies from a set's, over decisions and dimensions.

    The set is seen under the run's corruption, in a draw that it did not learn from, and unshifted, as it is played.

    Args:
        run: its folder, with the encoder.
        policies: files by update.
        data: the set; None: the run's own.
    """
    config = _record(run)["config"]
    encoder, corruption = _encoder(run / "encoder")
    dataset = open_dataset(data or config["data"])
    frozen = FrozenEncoder(encoder, dataset, corruption, 0, config["precision"], config["seed"])
    loaded = [_policy(run, file) for file in policies.values()]
    squares: list[list[np.ndarray]] = [[] for _ in loaded]
    view = frozen.view(config["views"])
    for number in np.unique(np.linspace(0, dataset.num_episodes - 1, EPISODES).astype(int)).tolist():
        states, actions = frozen.episode(number, view)[:-1], dataset.action[dataset.rows_of(number)][1:]
        for policy, found in zip(loaded, squares, strict=True):
            found.append((policy(states) - actions).square().mean(1).numpy())
    return [float(np.concatenate(found).mean()) for found in squares]


def _encoder(folder: Path) -> tuple[Encoder, CorruptionConfig]:
    """An encoder, and what hid its pixels, from a folder that may be older than a memory's own options."""
    record = read_json(folder / CONFIG_FILE)
    told = record["encoder"]
    if "gru_layers" in told:
        layers = told.pop("gru_layers")
        told["memory_options"] = {"gru_layers": layers} if told["history"] == "gru" else {}
    encoder = Encoder(EncoderConfig(**told))
    encoder.load_state_dict(read_tensors(folder / "model.safetensors"))
    return encoder.eval(), CorruptionConfig.fill(record["pretrain"]["corruption"])


def _policy(run: Path, file: Path) -> Policy:
    policy = Policy(**read_json(run / "policy" / CONFIG_FILE))
    policy.load_state_dict(read_tensors(file))
    return policy.eval()


def _record(run: Path) -> Row:
    return read_json(run / CONFIG_FILE)


if __name__ == "__main__":
    run_script(main, Config)
