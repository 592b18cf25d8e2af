"""A run is a folder: config.json, metrics.jsonl, checkpoints/ and results. The same command resumes it.

Everything except `timing.json`, `machine.json` and the seconds in checkpoints is identical whether or not a run was
interrupted. One process at a time owns the folder. A run's `identity` is a hash of what it computes: equal for equal
settings, seed, data and format, regardless of folder and machine. Its `recipe` omits the data's content, so it is known
before the data exist.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LATER, RUNTIME_FIELDS, flat, settings_of
from vd4rl_pomdp.core.registry import code_of, warn_of_other_code
from vd4rl_pomdp.runs import CONFIG_FILE, DIVERGED_FILE, EPISODES_FILE, FORMAT, MACHINE_FILE, TIMING_FILE
from vd4rl_pomdp.runs.checkpoint import Checkpoints, State
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.files import content_hash, holds_anything, jsonable, read_json, write_json
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.runs.provenance import CONTINUED, command, git_commit, machine, versions


def remedy(folder: Path) -> str:
    """Advice for a lost or damaged result of a finished run."""
    return (
        f"put it back, or remove {folder / TIMING_FILE} and re-run its command: it resumes from the last "
        "checkpoint and writes it anew"
    )


def identity(record: Mapping[str, Any], card: Mapping[str, Any]) -> str:
    """Hash of what a run computes, 24 hex characters.

    Args:
        record: its config.json.
        card: pretraining record of its encoder; empty for a pretraining run.
    """
    inputs = record.get("inputs", {})
    named = record["config"].get("exogenous")
    images = inputs.get("exogenous", named)  # a folder's content hash; generated images keep their name
    own = [] if images == named else [images]
    own += [inputs["weights"]] if "weights" in inputs else []  # of an image model's files, which its name may not tell
    return content_hash([recipe(record, card), inputs.get("data"), card.get("data"), *own])


def recipe(record: Mapping[str, Any], card: Mapping[str, Any], seeds: bool = True) -> str:
    """Like `identity`, without the data's content; without `seeds`, one hash for all seeds of an experiment."""
    own = settings_of(record["config"]) | {"seed": record["config"]["seed"] if seeds else None}
    before = {"settings": card["settings"], "seed": card["seed"] if seeds else None} if card else {}
    return content_hash([record.get("format", 1), record["stage"], own, before])


class RunFolder:
    """A run's files. `with` starts or resumes the run, owns its folder meanwhile, and handles signals."""

    def __init__(
        self,
        path: Path,
        stage: str,
        config: Any,
        inputs: dict[str, str],
        results: Sequence[str] = (),
        parts: Mapping[str, str] = {},
        collection: Mapping[str, Any] = {},
        words: Sequence[str] | None = None,
    ) -> None:
        """Check the folder; writes nothing.

        Args:
            path: the folder.
            stage: the stage's name.
            config: the stage's settings, a dataclass.
            inputs: hashes by name: the data's fingerprint, the encoder's hash.
            results: files that a finished run must have.
            parts: plug-ins that the inputs use, by the registries' `setting`, e.g. an encoder's corruption.
            collection: how the data were collected, for the record.
            words: the run's own command, if the command line starts several runs.

        Raises:
            UserError: the folder holds something else, a run with other settings, inputs or format, or a finished run
                that lost a result.
        """
        self.path = path
        self.config: dict[str, Any] = jsonable(flat(config))
        self.inputs = inputs
        self.stage = stage
        self._checkpoints, self._stack = Checkpoints(path), ExitStack()
        self._started, self._before = time.monotonic(), 0.0
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
        config = LATER | config
        differing = sorted(k for k in self.config.keys() - RUNTIME_FIELDS if config.get(k) != self.config[k])
        if stored["stage"] != self.stage or differing:
            what = ", ".join(differing) or f"stage {stored['stage']}"
            raise UserError(
                f"{self.path}: contains a run with a different config ({what}); choose another --out or remove it"
            )
        for name, now in self.inputs.items():
            if inputs.get(name) != now:
                flag = "model" if name == "weights" else name
                raise UserError(
                    f"{self.path}: the content of --{flag} {self.config.get(flag)} is not what this run started with "
                    f"({inputs.get(name)}, now {now}); restore that, or choose another --out"
                )
        lost = next((name for name in self._results if self.finished and not (self.path / name).exists()), None)
        if lost:
            raise UserError(f"{self.path / lost}: is missing; {remedy(self.path)}")

    def __enter__(self) -> Self:
        record = {} if self._begins else read_json(self.path / CONFIG_FILE)
        what = "this run began, which resumes or counts all the same; remove the run to compute it anew"
        warn_of_other_code(self.path, record, self._parts, what)
        if not self.finished:
            self._stack.enter_context(owned(self.path))
            try:
                self._check()  # another process may have started or finished it
                self._begin()
            except BaseException:
                self._stack.close()
                raise
        return self

    @property
    def _begins(self) -> bool:
        """Whether there is nothing to resume, so that earlier records can be overwritten."""
        return not (self.finished or self._checkpoints.steps() or (self.path / EPISODES_FILE).exists())

    def _begin(self) -> None:
        """Write the run's initial records, or append to them if it resumes with other hardware or code."""
        now = {"versions": versions(), "git_commit": git_commit()} | code_of(self._parts)
        hardware, path = machine(self.config.get("device", "auto")), self.path / MACHINE_FILE
        if self._begins:
            record = {"format": FORMAT, "stage": self.stage, "config": self.config, "inputs": self.inputs}
            made_by = {"command": command(self.stage, self._words), "collection": self._collection}
            write_json(self.path / CONFIG_FILE, record | now | made_by)
        if self._begins or not path.exists():  # a start may have been killed between the two files
            write_json(path, hardware)
        else:
            first, began = read_json(path), read_json(self.path / CONFIG_FILE)
            if began["config"] != (config := began["config"] | self.config):  # of flags that may change
                write_json(self.path / CONFIG_FILE, began | {"config": config})
            later = first.pop(CONTINUED, [])
            code = {name: began.get(name, {}) for name in now}  # versions, commit, and origin of plug-ins
            if (first | code | (later[-1] if later else {})) != hardware | now:
                write_json(path, first | {CONTINUED: [*later, hardware | now]})
        (self.path / DIVERGED_FILE).unlink(missing_ok=True)

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    @property
    def finished(self) -> bool:
        return (self.path / TIMING_FILE).exists()

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of the run so far, including those before its newest checkpoint."""
        return self._before + time.monotonic() - self._started

    def restore(self, take: Callable[[State], None]) -> None:
        """Pass the newest undamaged checkpoint's state to `take`, if there is one.

        UserError if it does not fit the run, or there are evaluations but no checkpoint.
        """
        seconds = self._checkpoints.restore(take)
        # The run would start over and append the same evaluations again.
        if seconds is None and read_episodes(self.path / EPISODES_FILE):
            raise UserError(
                f"{self.path}: has evaluations, but their checkpoints are missing: restore them, "
                "or remove the folder to start the run again"
            )
        self._before = seconds or 0.0

    def save(self, step: int, state: State) -> None:
        self._checkpoints.add(step, state, self.seconds)

    def mark_diverged(self, step: int, message: str) -> None:
        """Record that a number became non-finite after `step`. Resuming the run removes the mark."""
        write_json(self.path / DIVERGED_FILE, {"step": step, "message": message})

    def finish(self, **more: Any) -> None:
        """Mark the run as finished; keeps its wall-clock seconds and the last checkpoint."""
        self._checkpoints.prune(1)  # keep one: a result that gets lost can be recomputed from the end
        write_json(self.path / TIMING_FILE, {"seconds": round(self.seconds, 2)} | more)
