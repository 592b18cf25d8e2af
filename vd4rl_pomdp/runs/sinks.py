"""Where rows of metrics go besides metrics.jsonl: wandb and TensorBoard. What fails there warns once, no run stops."""

from __future__ import annotations

import secrets
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

from vd4rl_pomdp.errors import in_one_line
from vd4rl_pomdp.runs.files import write_bytes
from vd4rl_pomdp.runs.identity import recipe
from vd4rl_pomdp.runs.run import RunFolder

PROJECT = "vd4rl-pomdp"
INIT_TIMEOUT_S, FINISH_TIMEOUT_S = 30.0, 60.0
"""How long wandb may wait for its server before the first row and after the last one."""
LONGEST = {"name": 128, "group": 128, "tags": 64}
"""Characters that wandb accepts."""
Done = TypeVar("Done")


class Sink(Protocol):
    """Takes the rows that metrics.jsonl gets."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Take the row of a step."""

    def close(self) -> None:
        """Send what is left."""


class Forgiving:
    """A sink that, once something fails in it, warns, names the reason, and takes nothing more."""

    def __init__(self, name: str, folder: Path, open_sink: Callable[[], Sink]) -> None:
        self._name, self._folder = name, folder
        self._sink: Sink | None = None
        self._sink = self._try(open_sink)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Hand the row over; a number may not be changed by it."""
        if (sink := self._sink) is not None:
            self._try(lambda: sink.write(step, dict(metrics)))

    def close(self) -> None:
        """Close the sink, if it still works."""
        if (sink := self._sink) is not None:
            self._try(sink.close)

    def _try(self, act: Callable[[], Done]) -> Done | None:
        try:
            return act()
        except Exception as error:  # whatever a service or its library raises
            reason = in_one_line(error) or type(error).__name__
            reason += "; `pip install '.[tracking]'` in the package's folder" if isinstance(error, ImportError) else ""
            print(
                f"warning: {self._name} fails ({reason}); the run goes on, {self._folder} has it all", file=sys.stderr
            )
            self._sink = None
            return None


def open_sinks(run: RunFolder, step: int, labels: Mapping[str, Any], card: Mapping[str, Any]) -> list[Sink]:
    """The sinks that a run's config asks for.

    Args:
        run: the run.
        step: the step that it goes on from.
        labels: method, task, quality, corruption, and whatever else names the run.
        card: what the encoder it started from says of its pretraining; empty for a pretraining run.
    """
    sinks: list[Sink] = []
    if run.config["wandb"] != "off":
        sinks.append(Forgiving("wandb", run.path, lambda: WandbSink(run, labels, card)))
    if run.config["tensorboard"]:
        sinks.append(Forgiving("TensorBoard", run.path, lambda: TensorBoardSink(run.path / "tensorboard", step)))
    return sinks


class WandbSink:
    """A wandb run, the same one whenever the run goes on.

    wandb's own steps may not go back, as those of a run that was cut do: `step` is a number in each row instead.
    """

    def __init__(self, run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> None:
        import wandb

        self._run = wandb.init(
            project=PROJECT,
            dir=str(run.path),
            mode=run.config["wandb"],
            id=_wandb_id(run.path / "wandb" / "id"),
            resume="allow" if run.config["wandb"] == "online" else None,  # offline the id alone tells
            reinit="create_new",
            job_type=run.stage,
            config=_whole_config(run, labels, card),
            settings=wandb.Settings(
                console="off",
                quiet=True,
                init_timeout=INIT_TIMEOUT_S,
                finish_timeout=FINISH_TIMEOUT_S,
                finish_timeout_raises=True,
            ),
            **names(run, labels, card),
        )
        self._run.define_metric("*", step_metric="step")

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a row."""
        self._run.log({"step": step, **metrics})

    def close(self) -> None:
        """Upload what is left."""
        self._run.finish()


def names(run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> dict[str, Any]:
    """`group`, equal for the seeds of one experiment, `name` and `tags` of a run."""
    told = [str(value) for name, value in labels.items() if name != "seed" and value != ""]
    record = {"stage": run.stage, "config": run.config | {"seed": None}}
    mark = recipe(record, {**card, "seed": None} if card else {})[:6]
    title = " ".join([run.stage, *told])
    group = f"{title[: LONGEST['group'] - 7]} {mark}"
    seed = f" seed {run.config['seed']}"
    tags = [tag[: LONGEST["tags"]] for tag in dict.fromkeys([run.stage, *told])]
    return {"group": group, "name": title[: LONGEST["name"] - len(seed)] + seed, "tags": tags}


def _whole_config(run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that a run can be filtered by, the encoder's pretraining as `pretraining`."""
    whole: dict[str, Any] = run.config | dict(labels) | {"stage": run.stage, "inputs": run.inputs}
    return whole | ({"pretraining": dict(card)} if card else {})


def _wandb_id(file: Path) -> str:
    """The wandb run of a folder, drawn when it is first asked for: two runs of one recipe are two."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, secrets.token_hex(8).encode())
    return file.read_text(encoding="ascii").strip()


class TensorBoardSink:
    """An event file for each part of a run; TensorBoard hides what earlier ones hold after the step it goes on from.

    Written by this thread: tensorboardX's own writer hands events to another one, and waits forever once that failed.
    """

    def __init__(self, folder: Path, step: int) -> None:
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.summary import scalar

        self._event, self._scalar = Event, scalar
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"), f".{secrets.token_hex(4)}")
        self._writer.write_event(Event(step=step + 1, session_log=SessionLog(status=SessionLog.START)))

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append and flush a row."""
        for name, value in metrics.items():
            summary = self._scalar(name, value)
            self._writer.write_event(self._event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
