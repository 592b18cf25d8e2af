"""Where rows of metrics go besides metrics.jsonl: wandb and TensorBoard. What fails there warns once, no run stops."""

from __future__ import annotations

import json
import os
import secrets
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar
from zlib import crc32

from vd4rl_pomdp.core.errors import in_one_line
from vd4rl_pomdp.runs.files import write_bytes
from vd4rl_pomdp.runs.identity import recipe
from vd4rl_pomdp.runs.run import RunFolder

PROJECT = "vd4rl-pomdp"
INIT_TIMEOUT_S, FINISH_TIMEOUT_S = 30.0, 60.0
"""How long wandb may wait for its server before the first row and after the last one."""
LONGEST = {"name": 128, "group": 128, "tags": 64}
"""Characters that wandb accepts."""
_WANDB_OWN = {"_step", "_runtime", "_timestamp"}
"""What wandb adds to a row."""
Done = TypeVar("Done")


class Sink(Protocol):
    """Takes the rows that metrics.jsonl gets."""

    def resume(self, step: int, rows: Sequence[Mapping[str, float]]) -> None:
        """Take what this sink lacks of metrics.jsonl's rows; called once, before any `write`.

        It lacks some where a run was killed, or began without it, or where it failed.

        Args:
            step: the step that the run goes on from, 0 at its beginning.
            rows: all rows up to that step, each with its `step`.
        """

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

    def resume(self, step: int, rows: Sequence[Mapping[str, float]]) -> None:
        """Hand the rows over."""
        if (sink := self._sink) is not None:
            self._try(lambda: sink.resume(step, rows))

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


def open_sinks(run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> list[Sink]:
    """The sinks that a run's config asks for.

    Args:
        run: the run.
        labels: method, task, quality, corruption, and whatever else names the run.
        card: what the encoder it started from says of its pretraining; empty for a pretraining run.
    """
    sinks: list[Sink] = []
    if run.config["wandb"] != "off":
        sinks.append(Forgiving("wandb", run.path, lambda: WandbSink(run, labels, card)))
    if run.config["tensorboard"]:
        sinks.append(Forgiving("TensorBoard", run.path, lambda: TensorBoardSink(run.path / "tensorboard")))
    return sinks


class WandbSink:
    """A wandb run, the same one whenever the run goes on.

    wandb's own steps may not go back, as those of a run that was cut do: `step` is a number in each row instead.
    wandb keeps rows in memory until 32 KiB are full or some seconds are over: a killed run loses its last ones there.
    """

    def __init__(self, run: RunFolder, labels: Mapping[str, Any], card: Mapping[str, Any]) -> None:
        import wandb

        name = _wandb_id(run.path / "wandb" / "id")
        self._online = run.config["wandb"] == "online"
        self._has = set[frozenset[tuple[str, float]]]() if self._online else _mend_parts(run.path / "wandb", name)
        self._run = wandb.init(
            project=PROJECT,
            dir=str(run.path),
            mode=run.config["wandb"],
            id=name,
            resume="allow" if self._online else None,  # offline the id alone tells
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

    def resume(self, step: int, rows: Sequence[Mapping[str, float]]) -> None:
        """Log what is lacking: in the files of earlier parts or, online, from the last step on that the server has."""
        last = self._run.summary.get("step", 0) if self._online else 0
        for row in rows:
            if row["step"] >= last:
                self._log(row)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a row."""
        self._log({"step": step, **metrics})

    def _log(self, row: Mapping[str, float]) -> None:
        if frozenset(row.items()) not in self._has:
            self._run.log(dict(row))

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


def _mend_parts(folder: Path, name: str) -> set[frozenset[tuple[str, float]]]:
    """The rows in the offline files of a run called `name`, which are cut to their whole records.

    A killed run leaves one that is empty or ends within a record. There `wandb sync` stops, and sends no later part.
    """
    from wandb.proto.wandb_internal_pb2 import Record  # type: ignore[attr-defined]

    rows = set()
    for file in sorted(folder.glob(f"offline-run-*/run-{name}.wandb")):
        content = file.read_bytes()
        whole = list(_wandb_records(content))
        records = [Record.FromString(record) for _, record in whole]
        if not any(record.HasField("run") for record in records):
            file.unlink()
        elif (end := whole[-1][0]) < len(content):
            os.truncate(file, end)
        for record in records:
            items = {item.key or item.nested_key[0]: item.value_json for item in record.history.item}
            rows.add(frozenset((key, json.loads(value)) for key, value in items.items() if key not in _WANDB_OWN))
    return rows


def _wandb_records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Every whole record of a .wandb file and where it ends: a header of 7 bytes, then LevelDB's log format."""
    place, record = 7, b""
    while True:
        if (left := -place % 32768) < 7:  # a chunk's header does not cross blocks
            place += left
        if len(content) < place + 7:
            return
        checksum, length, kind = struct.unpack_from("<IHB", content, place)
        end = place + 7 + length
        if crc32(content[place + 6 : end]) != checksum:
            return
        record += content[place + 7 : end]
        place = end
        if kind in (1, 4):  # whole, or the last chunk of several
            yield place, record
            record = b""


class TensorBoardSink:
    """An event file for each part of a run; TensorBoard hides what earlier ones hold after the step it goes on from.

    Written by this thread: tensorboardX's own writer hands events to another one, and waits forever once that failed.
    """

    def __init__(self, folder: Path) -> None:
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.summary import scalar

        self._event, self._session, self._scalar = Event, SessionLog, scalar
        folder.mkdir(parents=True, exist_ok=True)
        self._has = self._shown(folder)
        self._writer = EventsWriter(str(folder / "events"), f".{secrets.token_hex(4)}")

    def _shown(self, folder: Path) -> set[tuple[int, str]]:
        """Step and name of every number that TensorBoard shows of a folder's files."""
        shown: set[tuple[int, str]] = set()
        for file in sorted(folder.glob("*.tfevents.*")):
            for event in map(self._event.FromString, _tensorboard_records(file.read_bytes())):
                if event.session_log.status == self._session.START:
                    shown = {place for place in shown if place[0] < event.step}
                shown |= {(event.step, value.tag) for value in event.summary.value}
        return shown

    def resume(self, step: int, rows: Sequence[Mapping[str, float]]) -> None:
        """Write the rows again from the first on that is lacking: TensorBoard takes steps in their order only."""
        lacking = [
            row["step"]
            for row in rows
            for event in self._events(row)
            if (event.step, event.summary.value[0].tag) not in self._has
        ]
        start = min([*lacking, step + 1])
        self._writer.write_event(self._event(step=start, session_log=self._session(status=self._session.START)))
        for row in rows:
            if row["step"] >= start:
                self._write(row)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append and flush a row."""
        self._write({"step": step, **metrics})

    def _write(self, row: Mapping[str, float]) -> None:
        for event in self._events(row):
            self._writer.write_event(event)
        self._writer.flush()

    def _events(self, row: Mapping[str, float]) -> list[Any]:
        summaries = [self._scalar(name, value) for name, value in row.items() if name != "step"]
        return [self._event(wall_time=time.time(), step=row["step"], summary=summary) for summary in summaries]

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


def _tensorboard_records(content: bytes) -> Iterator[bytes]:
    """Every whole record of an event file, framed by its length, that length's checksum and its own."""
    place = 0
    while len(content) >= place + 12:
        (length,) = struct.unpack_from("<Q", content, place)
        if len(content) < place + 16 + length:
            return
        yield content[place + 12 : place + 12 + length]
        place += 16 + length
