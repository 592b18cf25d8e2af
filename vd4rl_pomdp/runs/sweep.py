"""A sweep is a list of stage commands, each of which can be run by hand or on another machine."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from vd4rl_pomdp.errors import UserError


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


def sweep_runs(sweep: Sweep) -> Iterator[list[list[str]]]:
    """Every run as the words of its stages' command lines, in the order in which they depend on one another."""
    for seed in sweep.seeds:
        for corruption in sweep.corruptions:
            for method in sweep.methods:
                yield _stages(sweep, method, corruption, seed)


def _stages(sweep: Sweep, method: str, corruption: str, seed: int) -> list[list[str]]:
    folder = sweep.out / method / corruption / f"seed{seed}"
    common = ["--data", str(sweep.data), "--preset", sweep.preset, "--seed", str(seed)]
    chosen = ["--method", method, "--corruption", corruption, "--out", str(folder / "pretrain")]
    stages = [["pretrain", *common, *chosen, *_flags(sweep.pretrain)]]
    for algorithm in sweep.algorithms:
        place = ["--encoder", str(folder / "pretrain" / "encoder"), "--algorithm", algorithm]
        out = ["--out", str(folder / f"finetune-{algorithm}")]
        stages.append(["finetune", *common, *place, *out, *_flags(sweep.finetune)])
    return stages


def _flags(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UserError(f"the flags {text!r} cannot be split into words ({error}): close the quotation") from error
