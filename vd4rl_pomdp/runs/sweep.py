"""A sweep is a list of stage commands, each of which can be run by hand or on another machine."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol


class Sweep(Protocol):
    """Settings of `vd4rl-pomdp sweep`."""

    data: Path
    out: Path
    methods: list[str]
    corruptions: list[str]
    algorithms: list[str]
    seeds: list[int]
    preset: str
    pretrain: str
    finetune: str


def sweep_commands(sweep: Sweep) -> Iterator[list[str]]:
    """Words of every stage's command line, in an order in which they can be run."""
    for seed in sweep.seeds:
        for corruption in sweep.corruptions:
            for method in sweep.methods:
                folder = sweep.out / method / corruption / f"seed{seed}"
                common = ["--data", str(sweep.data), "--preset", sweep.preset, "--seed", str(seed)]
                chosen = ["--method", method, "--corruption", corruption, "--out", str(folder / "pretrain")]
                yield ["pretrain", *common, *chosen, *shlex.split(sweep.pretrain)]
                for algorithm in sweep.algorithms:
                    place = ["--encoder", str(folder / "pretrain" / "encoder"), "--algorithm", algorithm]
                    out = ["--out", str(folder / f"finetune-{algorithm}")]
                    yield ["finetune", *common, *place, *out, *shlex.split(sweep.finetune)]
