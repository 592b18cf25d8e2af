"""metrics.jsonl: rows of means, one JSON object a line, appended as a run goes.

wandb may mirror it and can never stop a run.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs.files import appending, write_bytes
from vd4rl_pomdp.runs.reading import parse_json, read_bytes

WandbMode = Literal["off", "offline", "online"]


class Means:
    """Means of scalars over the steps since the row before: of each over the steps that gave it."""

    def __init__(self) -> None:
        self._sums: dict[str, tuple[Tensor, int]] = {}
        """Of each scalar: its sum, float32, where it was computed, and how many steps gave it."""

    def add(self, logs: dict[str, Tensor]) -> None:
        """Count a step's scalars, each a tensor of one element; a GPU is not waited for."""
        for name, value in logs.items():
            value = value.detach().float()
            total, steps = self._sums.get(name) or (torch.zeros_like(value), 0)
            self._sums[name] = total.to(value.device) + value, steps + 1

    def take(self) -> dict[str, float]:
        """The means, which begin anew."""
        means = {name: float(total) / steps for name, (total, steps) in self._sums.items()}
        self._sums = {}
        return means

    def state_dict(self) -> dict[str, tuple[Tensor, int]]:
        """What `load_state_dict` takes."""
        return dict(self._sums)

    def load_state_dict(self, state: dict[str, tuple[Tensor, int]]) -> None:
        """Go on counting from `state_dict`."""
        self._sums = {name: (total, steps) for name, (total, steps) in state.items()}


class MetricsLog:
    """Appends rows {"step": int, name: number, ...}; opening it again at a checkpoint drops the rows after it."""

    def __init__(self, path: Path, step: int, wandb: WandbMode = "off", config: dict[str, Any] | None = None) -> None:
        self._path = path
        kept = [row for row in read_metrics(path) if row["step"] <= step]
        write_bytes(path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        self._wandb = _start_wandb(wandb, path.parent, config or {})

    def write(self, step: int, metrics: dict[str, float]) -> None:
        """Append one row; a metric that is not a finite number raises FloatingPointError."""
        bad = [name for name, value in metrics.items() if not math.isfinite(value)]
        if bad:
            raise FloatingPointError(f"{self._path.parent}: {bad[0]} is {metrics[bad[0]]} in the row of step {step}")
        with appending(self._path) as file:
            file.write(json.dumps({"step": step} | metrics) + "\n")
        if self._wandb is not None:
            self._wandb.log(metrics, step=step)

    def close(self) -> None:
        """End the mirror, if there is one."""
        if self._wandb is not None:
            self._wandb.finish()


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Rows of a metrics.jsonl, none if there is no file; a last line that is not whole is left out.

    Raises:
        UserError: a line is damaged.
    """
    if not path.exists():
        return []
    try:
        return [_row(line) for line in read_bytes(path).decode().rpartition("\n")[0].splitlines()]
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path}: a line is not JSON of numbers ({error}); remove the line") from error


def _row(line: str) -> dict[str, float]:
    row = parse_json(line)
    if not isinstance(row, dict) or "step" not in row or not all(isinstance(v, int | float) for v in row.values()):
        raise ValueError("it holds no numbers with their step")
    return row


def _start_wandb(mode: WandbMode, folder: Path, config: dict[str, Any]) -> Any:
    if mode == "off":
        return None
    import wandb

    try:
        return wandb.init(project="vd4rl-pomdp", dir=str(folder), mode=mode, config=config)
    except wandb.errors.Error as error:
        print(f"wandb could not start ({error}); the run goes on, metrics are in {folder}", file=sys.stderr)
        return None
