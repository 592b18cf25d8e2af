"""Every measurement in turn, and what is promised of them."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from vd4rl_pomdp.bench.measures import (
    against_jax,
    collection,
    finetuning,
    maze_pictures,
    maze_training,
    memories,
    methods,
    pretraining,
    sampling,
    stacking,
    synthetic_set,
)
from vd4rl_pomdp.bench.processes import memory, sharing
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.files import flatten
from vd4rl_pomdp.runs.provenance import machine, versions

GOALS: dict[str, tuple[str, float]] = {
    "opening.open_seconds": ("<=", 1.0),
    "memory.peak_over_frames": ("<=", 1.25),
    "sampling.gather_speed_over_copy": (">=", 0.5),
    "sampling.corrupt_and_shift_over_gather": ("<=", 2.0),
    "pretraining.fp32_overhead_share": ("<=", 0.2),
    "pretraining.bf16_overhead_share": ("<=", 0.2),
    "pretraining.bf16_over_fp32": (">=", 1.4),
    "methods.k_30_over_k_15": ("<=", 1.25),
    "memories.transformer_step_over_gru": ("<=", 1.3),
    "memories.lru_step_over_gru": ("<=", 1.3),
    "memories.transformer_row_over_gru": ("<=", 1.5),
    "memories.lru_row_over_gru": ("<=", 1.5),
    "memories.integrator_step_over_gru": ("<=", 1.3),
    "memories.integrator_row_over_gru": ("<=", 1.5),
    "finetuning.fp32_cached_over_exact": (">=", 20.0),
    "finetuning.bf16_cached_over_exact": (">=", 20.0),
    "finetuning.history_bf16_cached_over_exact": (">=", 20.0),
    "finetuning.rebrac_over_td3_bc": ("<=", 1.5),
    "jax.units_256_fp32_jax_over_ours": (">=", 1.0),
    "jax.units_256_bf16_jax_over_ours": (">=", 1.0),
    "jax.units_1024_fp32_jax_over_ours": (">=", 1.0),
    "jax.units_1024_bf16_jax_over_ours": (">=", 1.0),
    "collection.fast_over_exact": (">=", 1.4),
    "collection.fast_mean_difference_of_255": ("<=", 0.05),
    "collection.two_workers_over_one": (">=", 1.8),
    "sharing.of_two_over_alone": (">=", 0.45),
    "mazes.fast_over_default": (">=", 5.0),
    "mazes.first_person_over_default": (">=", 5.0),
    "mazes.training_overhead_share": ("<=", 0.2),
}
"""What this package promises on two cores without a GPU; of bf16 over fp32, where `machine.bf16_kernels` says yes."""


def bench(quick: bool = False, device: str = "auto") -> dict[str, Any]:
    """Run every measurement.

    Args:
        quick: a smaller set and fewer repetitions.
        device: where networks are trained.

    Returns:
        Nested ratios and rates, with the machine and the versions they were measured on.
    """
    place = pick_device(device)
    torch.manual_seed(0)
    repeats = 5 if quick else 15
    with tempfile.TemporaryDirectory() as folder:
        dataset, opening = synthetic_set(Path(folder), 20 if quick else 200)
        results: dict[str, Any] = {"opening": opening, "sampling": sampling(dataset, repeats)}
        dataset.to(place)
        results |= {
            "pretraining": pretraining(dataset, Path(folder), repeats),
            "finetuning": finetuning(dataset, repeats),
            "jax": against_jax(dataset, max(2, repeats // 3)),
            "stacking": stacking(dataset, max(2, repeats // 3)),
            "methods": methods(dataset, Path(folder), repeats),
            "memories": memories(dataset, Path(folder), repeats),
            "memory": memory(Path(folder), dataset.frames.numel()),
        }
    results["collection"] = collection(60 if quick else 200)
    results["sharing"] = sharing(3 if quick else 10)
    results["mazes"] = maze_pictures(60 if quick else 200) | maze_training()
    return results | {"machine": machine(device), "versions": versions()}


def print_table(results: dict[str, Any], goals: Mapping[str, tuple[str, float]], title: str) -> None:
    """All measurements on the terminal, those that have a goal with it and a verdict."""
    table = Table(title=title)
    table.add_column("measurement")
    for name in ("value", "goal", ""):
        table.add_column(name, justify="right")
    for name, value in flatten(results).items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        relation, goal = goals.get(name, ("", 0.0))
        if relation and float(shown) == goal:
            shown = str(value)  # a goal that is missed is not shown as reached
        reached = value <= goal if relation == "<=" else value >= goal if relation else None
        verdict = {True: "[green]reached[/]", False: "[red]missed[/]", None: ""}[reached]
        table.add_row(name, shown, f"{relation} {goal:g}" if relation else "", verdict)
    Console().print(table)
