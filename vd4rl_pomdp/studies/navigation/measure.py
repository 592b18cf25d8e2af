"""Measure a trained objective: state errors by split and probe, action losses, and one trajectory to draw.

`results.json` keeps one row for each `Measure`: its fields and its value.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.runs.device import autocast
from vd4rl_pomdp.runs.files import replacing_file
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.measures import RAW_PREFIX, UNTRAINED, Measure, measure_rows
from vd4rl_pomdp.studies.navigation.probe import COMPONENTS, ErrorSums, StateProbe, refit
from vd4rl_pomdp.studies.navigation.probed import ProbedObjective

TRAJECTORY_ROWS = 200
"""Rows of the held-out trajectory whose estimated states are kept for a figure."""


@torch.no_grad()
def evaluate(probed: ProbedObjective) -> tuple[dict[str, float], dict[str, float]]:
    """Action losses, and errors of the probe as trained, on held-out windows."""
    sums: dict[str, float] = defaultdict(float)
    errors, count = ErrorSums(), 0
    probed.objective.eval()
    for number in probed.data.spread(probed.config.evaluation_windows, held_out=True):
        with autocast(probed.device, probed.config.precision):
            _, logs, states = probed.measured(probed.data.windows(number), 1.0)
        errors.add(*states, probed.config.burn_in)
        count += len(number)
        for name, value in logs.items():
            sums[name] += float(value) * len(number)
    return {name: value / count for name, value in sums.items()}, errors.both(probed.data.states.std)


@torch.no_grad()
def encode(probed: ProbedObjective, number: Tensor, length: int | None = None) -> tuple[Tensor, Tensor]:
    """Frozen states (B, T, D) float32 of windows, and their rows (B, T)."""
    window = probed.data.windows(number, length)
    with autocast(probed.device, probed.config.precision):
        return probed.encoder.encode(window).float(), probed.data.dataset.rows(window.key)


def refitted_errors(probed: ProbedObjective) -> tuple[StateProbe, dict[str, dict[str, float]]]:
    """A probe fitted on frozen states of training windows, and its errors by split."""
    config, states = probed.config, probed.data.states
    probed.objective.eval()
    parts = [encode(probed, number) for number in probed.data.spread(config.refit_windows, held_out=False)]
    features, rows = (torch.cat([part[i][:, config.burn_in :].flatten(0, 1) for part in parts]) for i in (0, 1))
    probe = refit(features, states.values[rows], config.refit_steps, config.seed)
    found = {}
    for split, held_out in (("training", False), ("held_out", True)):
        errors = ErrorSums()
        for number in probed.data.spread(config.evaluation_windows, held_out):
            past, at = encode(probed, number)
            errors.add(probe(past), states.values[at], states.hidden[at], config.burn_in)
        found[split] = errors.both(states.std)
    return probe, found


def measure(probed: ProbedObjective, log: Path) -> tuple[StateProbe, list[dict[str, Any]]]:
    """The probe refitted on frozen states, and all rows that `results.json` keeps; `log` is the run's metrics.jsonl."""
    probe, refitted = refitted_errors(probed)
    values: dict[Measure, float] = {}
    for split, errors in refitted.items():
        values |= _errors(split, "refit", errors)
    if probed.config.method == UNTRAINED:  # its online probe and its action head were never trained
        return probe, measure_rows(values)
    losses, online = evaluate(probed)
    averages = _training_averages(log, probed.config)
    values |= _errors("held_out", "online", online) | _errors("training", "online", averages)
    if "action_loss" in losses:
        values |= _losses("training", averages) | _losses("held_out", losses)
    return probe, measure_rows(values)


def _errors(split: str, probe: str, logs: dict[str, float]) -> dict[Measure, float]:
    """Errors among the numbers that are logged: those that `ErrorSums.both` names."""
    values = {}
    for name, value in logs.items():
        error = name.removesuffix("_hidden")
        if error.removeprefix(RAW_PREFIX) in COMPONENTS:
            rows = "hidden" if name.endswith("_hidden") else "all"
            values[Measure(f"{error}_error", split, probe, rows)] = value
    return values


def _losses(split: str, logs: dict[str, float]) -> dict[Measure, float]:
    """Action losses in nats x 100, as in the paper's table: k = 0 stands for the mean over all pairs."""
    by_k = {0: logs["action_loss"]} | {int(n[6:]): v for n, v in logs.items() if n.startswith("loss_k")}
    return {Measure("action_loss", split, "", k=k): 100 * value for k, value in by_k.items()}


def _training_averages(path: Path, config: NavigationConfig) -> dict[str, float]:
    """Means over the last `average_last` steps: of the rows that are logged in them, each as often as it has steps."""
    before: float = max(0, config.steps - config.average_last)
    sums: dict[str, float] = defaultdict(float)
    counts: dict[str, float] = defaultdict(float)
    for row in read_metrics(path):
        if row["step"] > before:
            for name, value in row.items():
                sums[name] += value * (row["step"] - before)
                counts[name] += row["step"] - before
            before = row["step"]
    return {name: total / counts[name] for name, total in sums.items()}


def write_trajectory(path: Path, probed: ProbedObjective, probe: StateProbe) -> None:
    """True and estimated states of the first held-out trajectory, read as one stream."""
    dataset, states = probed.data.dataset, probed.data.states
    start = int(dataset.episode_start[probed.data.first_held_out])
    length = min(TRAJECTORY_ROWS, int((dataset.episode_end - dataset.episode_start).min()))
    past, rows = encode(probed, torch.tensor([_window_at(dataset, start, length)]), length)
    estimate = (probe(past)[0].detach() * states.std + states.mean).cpu()
    truth = (states.values[rows[0]] * states.std + states.mean).cpu()
    with replacing_file(path) as fresh, fresh.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = ("x", "y", "vx", "vy")
        writer.writerow(["t", *names, *(f"estimated_{name}" for name in names), "hidden"])
        for t, hidden in enumerate(states.hidden[rows[0]].tolist()):
            numbers = [*truth[t].tolist(), *estimate[t].tolist()]
            writer.writerow([t, *(f"{number:.5f}" for number in numbers), int(hidden)])


def _window_at(dataset: Dataset, row: int, length: int) -> int:
    """Number of the window of `length` rows that begins at a row."""
    episode = int(dataset.episode[row])
    return int(dataset.windows_per_episode(length)[:episode].sum()) + int(dataset.t[row])
