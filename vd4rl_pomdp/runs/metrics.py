"""metrics.jsonl: rows of means and of evaluations, one JSON object a line, appended as a run goes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.runs import METRICS_FILE
from vd4rl_pomdp.runs.files import appending, write_bytes

if TYPE_CHECKING:
    from vd4rl_pomdp.runs.sinks import Sink

WandbMode = Literal["off", "offline", "online"]
EVALUATION = "eval/"
"""How the names of an evaluation's numbers begin: eval/return/CORRUPTION, eval/score/CORRUPTION."""


class Means:
    """Means of scalars over the steps since the row before: of each over the steps that gave it."""

    def __init__(self) -> None:
        self._sums: dict[str, tuple[Tensor, int]] = {}
        """Of each scalar: its sum, float32, where it was computed, and how many steps gave it."""

    def add(self, logs: dict[str, Tensor]) -> None:
        """Count a step's scalars, each a tensor of one element; a GPU is not waited for.

        Raises:
            UserError: one is called what a row calls something else.
        """
        if taken := [name for name in logs if name == "step" or name.startswith(EVALUATION)]:
            raise UserError(f"a scalar of the loss is called {taken[0]!r}, as something else is in {METRICS_FILE}")
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
    """Appends rows {"step": int, name: number, ...}, which its sinks get, too.

    Opening it again at a checkpoint drops the rows after it: those of later steps, and an evaluation of its own step.
    Sinks that lack some of the others get them again.
    """

    def __init__(self, path: Path, step: int, sinks: Sequence[Sink] = ()) -> None:
        self._path, self._sinks = path, sinks
        kept = [row for row in read_metrics(path) if row["step"] < step + (not _is_evaluation(row))]
        write_bytes(path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        for sink in sinks:
            sink.resume(step, kept)

    def write(self, step: int, metrics: dict[str, float]) -> None:
        """Append one row; a metric that is not a finite number raises FloatingPointError."""
        bad = [name for name, value in metrics.items() if not math.isfinite(value)]
        if bad:
            raise FloatingPointError(f"{self._path.parent}: {bad[0]} is {metrics[bad[0]]} in the row of step {step}")
        with appending(self._path) as file:
            file.write(json.dumps({"step": step} | metrics) + "\n")
        for sink in self._sinks:
            sink.write(step, metrics)

    def close(self) -> None:
        """Close the sinks."""
        for sink in self._sinks:
            sink.close()


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


def _is_evaluation(row: dict[str, float]) -> bool:
    return any(name.startswith(EVALUATION) for name in row)
