"""Rows of metrics: metrics.jsonl, one JSON object a line, appended as a run goes, and its mirrors.

A mirror, wandb or TensorBoard, gets the rows of metrics.jsonl. What fails there warns once, and no run stops.
"""

from __future__ import annotations

import json
import math
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, in_one_line
from vd4rl_pomdp.core.reading import damaged, parse_json, read_bytes
from vd4rl_pomdp.runs import METRICS_FILE
from vd4rl_pomdp.runs.files import appending, write_bytes
from vd4rl_pomdp.runs.run import RunFolder, recipe

WandbMode = Literal["off", "offline", "online"]
EVALUATION = "eval/"
"""How the names of an evaluation's numbers begin: eval/return/CORRUPTION, eval/score/CORRUPTION."""
PROJECT = "vd4rl-pomdp"
INIT_TIMEOUT_S, FINISH_TIMEOUT_S = 30.0, 60.0
"""How long wandb may wait for its server before the first row and after the last one."""
LONGEST = {"name": 128, "group": 128, "tags": 64}
"""Characters that wandb accepts."""
_MOST_ADDED = 1024
"""Steps whose scalars wait for their sum."""
Metrics = Mapping[str, float]
"""One row: its `step`, and numbers by name."""


class Means:
    """Means of scalars over the steps since the row before: of each over the steps that gave it."""

    def __init__(self) -> None:
        self._sums: dict[str, tuple[Tensor, int]] = {}
        """Of each scalar: its sum, float32, and how many steps gave it."""
        self._added: list[tuple[tuple[str, ...], Tensor]] = []
        """Names and copies of the scalars of steps that are not in the sums yet."""

    def add(self, logs: dict[str, Tensor]) -> None:
        """Count a step's scalars, each a tensor of one element; a GPU is not waited for.

        Raises:
            UserError: one is called what a row calls something else.
        """
        if taken := [name for name in logs if name == "step" or name.startswith(EVALUATION)]:
            raise UserError(f"a scalar of the loss is called {taken[0]!r}, as something else is in {METRICS_FILE}")
        if logs:
            device = next(iter(logs.values())).device
            values = [value.detach().float().reshape(()).to(device) for value in logs.values()]
            self._added.append((tuple(logs), torch.stack(values)))  # one operation; to sum would be one a scalar
        if len(self._added) >= _MOST_ADDED:
            self._sum()

    def _sum(self) -> None:
        """Add the steps' scalars to the sums, in order and in float32."""
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
        """The means, which begin anew."""
        self._sum()
        means = {name: float(total) / steps for name, (total, steps) in self._sums.items()}
        self._sums = {}
        return means

    def state_dict(self) -> dict[str, tuple[Tensor, int]]:
        """What `load_state_dict` takes."""
        self._sum()
        return dict(self._sums)

    def load_state_dict(self, state: dict[str, tuple[Tensor, int]]) -> None:
        """Resume counting from `state_dict`."""
        self._sums, self._added = {name: (total, steps) for name, (total, steps) in state.items()}, []


class Mirror(Protocol):
    """Takes the rows that metrics.jsonl gets; opening it hands it all rows so far."""

    def write(self, row: Metrics) -> None:
        """Take a row."""

    def close(self) -> None:
        """Send what is left."""


class MetricsLog:
    """Appends rows {"step": int, name: number, ...} to metrics.jsonl and its mirrors.

    Opening it again at a checkpoint drops the rows after it: those of later steps, and an evaluation of its own step.
    """

    def __init__(
        self, path: Path, step: int, mirrors: Mapping[str, Callable[[Sequence[Metrics]], Mirror]] | None = None
    ) -> None:
        """Open or reopen.

        Args:
            path: the metrics.jsonl.
            step: the step that the run resumes from, 0 at its beginning.
            mirrors: by name, what opens a mirror, given the rows up to that step: it may lack any.
        """
        self._path = path
        # The checkpoint's own step is trained, but not evaluated: that follows it, and is done again.
        kept = [
            row
            for row in read_metrics(path)
            if row["step"] < step or (row["step"] == step and not any(name.startswith(EVALUATION) for name in row))
        ]
        write_bytes(path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        self._mirrors: dict[str, Mirror] = {}
        for name, opened in (mirrors or {}).items():
            if (mirror := self._try(name, lambda opened=opened: opened(kept))) is not None:  # type: ignore[misc]
                self._mirrors[name] = mirror

    def write(self, step: int, metrics: Metrics) -> None:
        """Append one row; a metric that is not a finite number raises FloatingPointError."""
        bad = [name for name, value in metrics.items() if not math.isfinite(value)]
        if bad:
            raise FloatingPointError(f"{self._path.parent}: {bad[0]} is {metrics[bad[0]]} in the row of step {step}")
        row = {"step": step, **metrics}
        with appending(self._path) as file:
            file.write(json.dumps(row) + "\n")
        for name, mirror in list(self._mirrors.items()):
            self._try(name, lambda mirror=mirror: mirror.write(dict(row)))  # type: ignore[misc]

    def close(self) -> None:
        """Close the mirrors."""
        for name, mirror in list(self._mirrors.items()):
            self._try(name, mirror.close)

    def _try(self, name: str, act: Callable[[], Any]) -> Any:
        try:
            return act()
        except Exception as error:  # whatever a service or its library raises
            self._mirrors.pop(name, None)
            reason = in_one_line(error) or type(error).__name__
            reason += "; `pip install '.[tracking]'` in the package's folder" if isinstance(error, ImportError) else ""
            where = self._path.parent
            print(f"warning: {name} fails ({reason}); the run continues, {where} has it all", file=sys.stderr)


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Rows of a metrics.jsonl, none if there is no file; a last line that is not whole is left out.

    Raises:
        UserError: a line is damaged.
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
) -> dict[str, Callable[[Sequence[Metrics]], Mirror]]:
    """What opens the mirrors that a run's config asks for.

    Args:
        run: the run.
        labels: method, task, quality, corruption, and whatever else names the run.
        card: what the encoder it started from says of its pretraining; empty for a pretraining run.
    """
    found: dict[str, Callable[[Sequence[Metrics]], Mirror]] = {}
    if run.config["wandb"] != "off":
        found["wandb"] = lambda rows: Wandb(run, labels, card, rows)
    if run.config["tensorboard"]:
        found["TensorBoard"] = lambda rows: TensorBoard(run.path / "tensorboard", rows)
    return found


class Wandb:
    """A wandb run, the same one whenever the run resumes; offline its files are then written anew, all rows included.

    wandb's own steps may not go back, as those of a run that was cut do: `step` is a number in each row instead.
    """

    def __init__(
        self, run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any], rows: Sequence[Metrics]
    ) -> None:
        import wandb

        folder, online = run.path / "wandb", run.config["wandb"] == "online"
        if not (folder / "id").exists():  # drawn: two runs of one recipe are two
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes(folder / "id", secrets.token_hex(8).encode())
        name = (folder / "id").read_text(encoding="ascii").strip()
        for earlier in folder.glob(f"offline-run-*-{name}"):  # a killed process leaves files that `wandb sync` refuses
            shutil.rmtree(earlier)
        whole = run.config | dict(labels) | {"stage": run.stage, "inputs": run.inputs}
        self._run = wandb.init(
            project=PROJECT,
            dir=str(run.path),
            mode=run.config["wandb"],
            id=name,
            resume="allow" if online else None,  # offline the id alone tells
            reinit="create_new",
            job_type=run.stage,
            config=whole | ({"pretraining": dict(card)} if card else {}),
            settings=wandb.Settings(
                console="off",
                quiet=True,
                init_timeout=INIT_TIMEOUT_S,
                finish_timeout=FINISH_TIMEOUT_S,
                finish_timeout_raises=True,
            ),
            **wandb_names(run, labels, card),
        )
        self._run.define_metric("*", step_metric="step")
        sent = self._run.summary.get("step", 0) if online else 0
        for row in rows:
            if row["step"] >= sent:  # the server may lack some of the last one's
                self.write(row)

    def write(self, row: Metrics) -> None:
        """Log a row."""
        self._run.log(dict(row))

    def close(self) -> None:
        """Upload what is left."""
        self._run.finish()


def wandb_names(run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> dict[str, Any]:
    """`group`, equal for the seeds of one experiment, `name` and `tags` of a run."""
    told = [str(value) for name, value in labels.items() if name != "seed" and value != ""]
    record = {"stage": run.stage, "config": run.config | {"seed": None}}
    mark = recipe(record, {**card, "seed": None} if card else {})[:6]
    title = " ".join([run.stage, *told])
    group = f"{title[: LONGEST['group'] - 7]} {mark}"
    seed = f" seed {run.config['seed']}"
    tags = [tag[: LONGEST["tags"]] for tag in dict.fromkeys([run.stage, *told])]
    return {"group": group, "name": title[: LONGEST["name"] - len(seed)] + seed, "tags": tags}


class TensorBoard:
    """An event file, written anew whenever the run resumes.

    Written by this thread: tensorboardX's own writer hands events to another one, and waits forever once that failed.
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
        """Append and flush a row."""
        for name, value in row.items():
            if name != "step":
                summary = self._scalar(name, value)
                self._writer.write_event(self._event(wall_time=time.time(), step=row["step"], summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
