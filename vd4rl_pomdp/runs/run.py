"""A run is a folder: config.json first, then metrics.jsonl, checkpoints/ and results; the same command resumes it.

Everything but `timing.json`, `machine.json` and the seconds in a checkpoint is the same whether a run was interrupted
or not. One process owns the folder at a time. What it computes has a name, its `identity`: equal for equal settings,
seed, data and format, whatever its folder and its machine. Its `recipe` can be told before its data exist.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import RUNTIME_FIELDS, flat, settings_of
from vd4rl_pomdp.core.registry import code_of, warn_of_other_code
from vd4rl_pomdp.runs import CONFIG_FILE, DIVERGED_FILE, EPISODES_FILE, FORMAT, MACHINE_FILE, TIMING_FILE
from vd4rl_pomdp.runs.checkpoint import Checkpoints, State
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.files import content_hash, holds_anything, jsonable, read_json, write_json
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.runs.provenance import CONTINUED, command, git_commit, machine, versions

_NOTHING: Mapping[str, Any] = MappingProxyType({})


def remedy(folder: Path) -> str:
    """What to do about a result of a finished run that is lost or damaged."""
    return (
        f"put it back, or remove {folder / TIMING_FILE} and re-run its command: it resumes from the last "
        "checkpoint and writes it anew"
    )


def identity(record: Mapping[str, Any], card: Mapping[str, Any]) -> str:
    """Name of what a run computes, 24 characters.

    Args:
        record: its config.json.
        card: what the encoder it started from says of its pretraining; empty for a pretraining run.
    """
    inputs = record.get("inputs", {})
    named = record["config"].get("exogenous")
    images = inputs.get("exogenous", named)  # the content of a folder; the name again of those that are made
    own = [] if images == named else [images]
    return content_hash([recipe(record, card), inputs.get("data"), card.get("data"), *own])


def recipe(record: Mapping[str, Any], card: Mapping[str, Any]) -> str:
    """Name of what a run computes but for the content of its data, likewise."""
    own = settings_of(record["config"]) | {"seed": record["config"]["seed"]}
    before = {"settings": card["settings"], "seed": card["seed"]} if card else {}
    return content_hash([record.get("format", 1), record["stage"], own, before])


class RunFolder:
    """A run's files; `with` begins or resumes the run, owns its folder meanwhile, and answers signals."""

    def __init__(
        self,
        path: Path,
        stage: str,
        config: Any,
        inputs: dict[str, str],
        results: Sequence[str] = (),
        parts: Mapping[str, str] = _NOTHING,
        collection: Mapping[str, Any] = _NOTHING,
        words: Sequence[str] | None = None,
    ) -> None:
        """Nothing is written yet.

        Args:
            path: the folder.
            stage: the stage's name.
            config: the stage's settings, a dataclass.
            inputs: hashes of what the run reads, by name: the data's fingerprint, the encoder's hash.
            results: files that a finished run holds.
            parts: names of parts that the inputs bring along, by the registries' `setting`: an encoder's corruption.
            collection: how the data were collected, for the record.
            words: of its own command, where the command line names several runs.

        Raises:
            UserError: the folder holds something else, a run with other settings, inputs or of another format, or one
                that was finished and has lost a result.
        """
        self.path = path
        self.config: dict[str, Any] = jsonable(flat(config))
        self.inputs = inputs
        self.stage = stage
        self._checkpoints = Checkpoints(path)
        self._started, self._before = time.monotonic(), 0.0
        self._stack = ExitStack()
        self._results, self._collection, self._words = results, dict(collection), words
        self._parts = self.config | parts
        self._check()

    def _check(self) -> None:
        """Raise UserError if the folder holds anything but this run."""
        file = self.path / CONFIG_FILE
        stored = read_json(file) if file.exists() else {}
        if "stage" not in stored:
            if holds_anything(self.path):
                raise UserError(f"{self.path}: is not empty and holds no run; choose another --out")
            return
        if stored.get("format") != FORMAT:
            raise UserError(
                f"{self.path}: holds a run of format {stored.get('format')}, this version writes format {FORMAT} "
                "and cannot resume it; choose another --out"
            )
        config, inputs = (part if isinstance(part := stored.get(name), dict) else {} for name in ("config", "inputs"))
        differing = sorted(k for k in self.config.keys() - RUNTIME_FIELDS if config.get(k) != self.config[k])
        if stored["stage"] != self.stage or differing:
            what = ", ".join(differing) or f"stage {stored['stage']}"
            raise UserError(f"{self.path}: holds a run with another config ({what}); choose another --out or remove it")
        for name, now in self.inputs.items():
            if inputs.get(name) != now:
                raise UserError(
                    f"{self.path}: holds a run with other content of --{name} ({self.config.get(name)} was "
                    f"{inputs.get(name)} and is {now}); give it what it began with, or choose another --out"
                )
        lost = next((name for name in self._results if self.finished and not (self.path / name).exists()), None)
        if lost:
            raise UserError(f"{self.path / lost}: is gone; {remedy(self.path)}")

    def __enter__(self) -> Self:
        kept = {} if self._begins else read_json(self.path / CONFIG_FILE)
        what = "this run began, which resumes or counts all the same; remove the run to compute it anew"
        warn_of_other_code(self.path, kept, self._parts, what)
        if not self.finished:
            self._stack.enter_context(owned(self.path))
            try:
                self._check()  # another process may have begun or ended it since
                self._begin()
            except BaseException:
                self._stack.close()
                raise
        return self

    @property
    def _begins(self) -> bool:
        """Whether nothing is there to resume from: what was recorded before tells of nothing."""
        return not (self.finished or self._checkpoints.steps() or (self.path / EPISODES_FILE).exists())

    def _begin(self) -> None:
        """Write what the run begins with, or add to it where what it resumes with is something else."""
        now = {"versions": versions(), "git_commit": git_commit()} | code_of(self._parts)
        hardware, path = machine(self.config.get("device", "auto")), self.path / MACHINE_FILE
        if self._begins:
            record = {"format": FORMAT, "stage": self.stage, "config": self.config, "inputs": self.inputs}
            made_by = {"command": command(self.stage, self._words), "collection": self._collection}
            write_json(self.path / CONFIG_FILE, record | now | made_by)
        if self._begins or not path.exists():  # a start may have been killed between the two files
            write_json(path, hardware)
        else:
            told, began = read_json(path), read_json(self.path / CONFIG_FILE)
            later = told.pop(CONTINUED, [])
            code = {name: began.get(name, {}) for name in now}  # versions, commit, and where other parts come from
            if (told | code | (later[-1] if later else {})) != hardware | now:
                write_json(path, told | {CONTINUED: [*later, hardware | now]})
        (self.path / DIVERGED_FILE).unlink(missing_ok=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end."""
        return (self.path / TIMING_FILE).exists()

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of the run so far, those before its newest checkpoint included."""
        return self._before + time.monotonic() - self._started

    def restore(self, take: Callable[[State], None]) -> None:
        """Hand the state of the newest whole checkpoint to `take`, if there is one.

        Raises:
            UserError: it does not fit the run, or evaluations are there, which follow a checkpoint, and none is.
        """
        seconds = self._checkpoints.restore(take)
        # Without this the run would begin again and append the same evaluations a second time.
        if seconds is None and read_episodes(self.path / EPISODES_FILE):
            raise UserError(
                f"{self.path}: has evaluations, but the checkpoints that they were made after are gone: put them back, "
                "or remove the folder to start the run again"
            )
        self._before = seconds or 0.0

    def save(self, step: int, state: State) -> None:
        """Keep the state after a step as the newest checkpoint."""
        self._checkpoints.add(step, state, self.seconds)

    def mark_diverged(self, step: int, message: str) -> None:
        """Say that a number was no longer finite after `step`; resuming the run takes the mark away."""
        write_json(self.path / DIVERGED_FILE, {"step": step, "message": message})

    def finish(self, **more: Any) -> None:
        """Mark the run as done, keeping its wall-clock seconds and the last checkpoint."""
        self._checkpoints.prune(1)  # one stays: a result that is lost later is computed again from the end
        write_json(self.path / TIMING_FILE, {"seconds": round(self.seconds, 2)} | more)
