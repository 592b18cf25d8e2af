"""Rows of metrics in metrics.jsonl, one JSON object per line, and their mirrors.

A mirror (wandb or TensorBoard) gets the same rows. If it fails, it warns once and the run continues.
"""

from __future__ import annotations

import json
import math
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, in_one_line
from vd4rl_pomdp.core.reading import damaged, parse_json, read_bytes
from vd4rl_pomdp.runs import METRICS_FILE
from vd4rl_pomdp.runs.files import appending, write_bytes
from vd4rl_pomdp.runs.run import RunFolder, recipe

WandbMode = Literal["off", "offline", "online"]
EVALUATION = "eval/"  # prefix of an evaluation's metrics: eval/return/CORRUPTION, eval/score/CORRUPTION
PROJECT = "vd4rl-pomdp"
INIT_TIMEOUT_S, FINISH_TIMEOUT_S = 30.0, 60.0
"""Seconds that wandb may wait for its server before the first row and after the last one."""
_MOST_ADDED = 1024  # steps buffered before their scalars are summed
Metrics = Mapping[str, float]  # one row: `step`, and numbers by name


class Means:
    """Means of scalars over the steps since the previous row, each over the steps that logged it."""

    def __init__(self) -> None:
        self._sums: dict[str, tuple[Tensor, int]] = {}
        """By scalar: its float32 sum, and the number of steps that logged it."""
        self._added: list[tuple[tuple[str, ...], Tensor]] = []
        """Names and copies of the scalars of steps not summed yet."""

    def add(self, logs: dict[str, Tensor]) -> None:
        """Add a step's scalars, each a one-element tensor, without a GPU sync.

        UserError if a scalar's name is reserved.
        """
        if taken := [name for name in logs if name == "step" or name.startswith(EVALUATION)]:
            raise UserError(
                f"a scalar of the loss is called {taken[0]!r}, which {METRICS_FILE} uses already: rename it"
            )
        if logs:
            device = next(iter(logs.values())).device
            values = [value.detach().float().reshape(()).to(device) for value in logs.values()]
            self._added.append((tuple(logs), torch.stack(values)))  # one kernel; summing would take one per scalar
        if len(self._added) >= _MOST_ADDED:
            self._sum()

    def _sum(self) -> None:
        """Add the buffered scalars to the sums, in order and in float32."""
        if not self._added:
            return
        columns: dict[str, list[np.float32]] = {}
        values = torch.cat([values for _, values in self._added]).cpu().numpy()
        for name, value in zip((name for names, _ in self._added for name in names), values, strict=True):
            columns.setdefault(name, []).append(value)
        for name, column in columns.items():
            total, steps = self._sums.get(name) or (torch.zeros(()), 0)
            summed = np.cumsum([np.float32(total), *column], dtype=np.float32)[-1]
            self._sums[name] = torch.tensor(summed), steps + len(column)
        self._added = []

    def take(self) -> dict[str, float]:
        self._sum()
        means = {name: float(total) / steps for name, (total, steps) in self._sums.items()}
        self._sums = {}
        return means

    def state_dict(self) -> dict[str, tuple[Tensor, int]]:
        self._sum()
        return dict(self._sums)

    def load_state_dict(self, state: dict[str, tuple[Tensor, int]]) -> None:
        self._sums, self._added = {name: (total, steps) for name, (total, steps) in state.items()}, []


class MetricsLog:
    """Appends rows {"step": int, name: number, ...} to metrics.jsonl and its mirrors.

    Reopening it at a checkpoint drops later rows, and evaluations at the checkpoint's own step, which will be repeated.
    """

    def __init__(
        self, path: Path, step: int, mirrors: Mapping[str, Callable[[Sequence[Metrics]], Any]] | None = None
    ) -> None:
        """Open or reopen at the step from which the run resumes; `mirrors` open by name, given all rows up to there."""
        self._path = path
        # The checkpoint's step is trained but not yet evaluated.
        rows = [
            row
            for row in read_metrics(path)
            if row["step"] < step or (row["step"] == step and not any(name.startswith(EVALUATION) for name in row))
        ]
        write_bytes(path, "".join(json.dumps(row) + "\n" for row in rows).encode())
        self._mirrors: dict[str, Any] = {}
        for name, open_mirror in (mirrors or {}).items():
            if (mirror := self._try(name, open_mirror, rows)) is not None:
                self._mirrors[name] = mirror

    def write(self, step: int, metrics: Metrics) -> None:
        """Append one row; FloatingPointError for a metric that is not finite."""
        bad = [name for name, value in metrics.items() if not math.isfinite(value)]
        if bad:
            raise FloatingPointError(f"{self._path.parent}: {bad[0]} is {metrics[bad[0]]} in the row of step {step}")
        row = {"step": step, **metrics}
        with appending(self._path) as file:
            file.write(json.dumps(row) + "\n")
        for name, mirror in list(self._mirrors.items()):
            self._try(name, mirror.write, row)

    def close(self) -> None:
        for name, mirror in list(self._mirrors.items()):
            self._try(name, mirror.close)

    def _try(self, name: str, act: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return act(*arguments)
        except Exception as error:  # services and their libraries raise anything
            self._mirrors.pop(name, None)
            reason = in_one_line(error) or type(error).__name__
            reason += "; `pip install '.[tracking]'` in the package's folder" if isinstance(error, ImportError) else ""
            where = self._path.parent
            print(f"warning: {name} fails ({reason}); the run continues, and {where} has all metrics", file=sys.stderr)


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Rows of a metrics.jsonl; empty without a file. A truncated last line is skipped.

    UserError if a line is damaged.
    """
    if not path.exists():
        return []
    rows, content = list[dict[str, float]](), read_bytes(path)
    with damaged(path, "a line is not JSON of numbers", "remove the line"):
        for line in content.decode().rpartition("\n")[0].splitlines():
            row = parse_json(line)
            if not (isinstance(row, dict) and "step" in row and all(isinstance(v, int | float) for v in row.values())):
                raise ValueError("it holds no numbers with their step")
            rows.append(row)
    return rows


def mirrors_of(
    run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]
) -> dict[str, Callable[[Sequence[Metrics]], Any]]:
    """Functions that open the mirrors enabled in a run's config; `card` is its encoder's pretraining record, if any."""
    wandb = {"wandb": partial(Wandb, run, labels, card)} if run.config["wandb"] != "off" else {}
    return wandb | (
        {"TensorBoard": partial(TensorBoard, run.path / "tensorboard")} if run.config["tensorboard"] else {}
    )


class Wandb:
    """A wandb run; resuming continues the same one. Offline, its files are rewritten with all rows on every resume.

    wandb's own step counter cannot go back, as a resumed run does, so `step` is logged as a metric instead.
    """

    def __init__(
        self, run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any], rows: Sequence[Metrics]
    ) -> None:
        import wandb

        folder, online = run.path / "wandb", run.config["wandb"] == "online"
        if not (folder / "id").exists():  # random: two runs of one recipe are two wandb runs
            write_bytes(folder / "id", secrets.token_hex(8).encode())
        name = (folder / "id").read_text(encoding="ascii").strip()
        for earlier in folder.glob(f"offline-run-*-{name}"):  # `wandb sync` rejects the files of a killed process
            shutil.rmtree(earlier)
        waits: dict[str, Any] = {"init_timeout": INIT_TIMEOUT_S, "finish_timeout": FINISH_TIMEOUT_S}
        whole = run.config | dict(labels) | {"stage": run.stage, "inputs": run.inputs}
        self._run = wandb.init(
            project=PROJECT,
            dir=str(run.path),
            mode=run.config["wandb"],
            id=name,
            resume="allow" if online else None,  # offline the id suffices
            reinit="create_new",
            job_type=run.stage,
            config=whole | ({"pretraining": dict(card)} if card else {}),
            settings=wandb.Settings(console="off", quiet=True, **waits, finish_timeout_raises=True),
            **wandb_names(run, labels, card),
        )
        self._run.define_metric("*", step_metric="step")
        sent = self._run.summary.get("step", 0) if online else 0
        for row in rows:
            if row["step"] >= sent:  # the server may lack metrics of its last step
                self.write(row)

    def write(self, row: Metrics) -> None:
        self._run.log(dict(row))

    def close(self) -> None:
        self._run.finish()


def wandb_names(run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> dict[str, Any]:
    """wandb's `name`, `tags` and `group` of a run; seeds of one experiment share the group."""
    words = [run.stage, *(str(value) for name, value in labels.items() if name != "seed" and value != "")]
    mark = recipe({"stage": run.stage, "config": run.config}, card, seeds=False)[:6]
    title = " ".join(words)
    return {
        "group": f"{title} {mark}",
        "name": f"{title} seed {run.config['seed']}",
        "tags": list(dict.fromkeys(words)),
    }


class TensorBoard:
    """An event file, rewritten whenever the run resumes.

    Written in this thread: tensorboardX's SummaryWriter uses a background thread and hangs forever if that fails.
    """

    def __init__(self, folder: Path, rows: Sequence[Metrics]) -> None:
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        self._event, self._scalar = Event, scalar
        folder.mkdir(parents=True, exist_ok=True)
        for earlier in folder.glob("*.tfevents.*"):
            earlier.unlink()
        self._writer = EventsWriter(str(folder / "events"), f".{secrets.token_hex(4)}")
        for row in rows:
            self.write(row)

    def write(self, row: Metrics) -> None:
        for name, value in row.items():
            if name != "step":
                summary = self._scalar(name, value)
                self._writer.write_event(self._event(wall_time=time.time(), step=row["step"], summary=summary))
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
