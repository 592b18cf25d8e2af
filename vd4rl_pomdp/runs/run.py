"""A run is a folder: config.json first, then metrics.jsonl, checkpoints/ and results; the same command continues it.

Everything but `timing.json`, `machine.json` and the checkpoint's `manifest.json` is the same whether a run was
interrupted or not. One process owns the folder at a time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.core.registry import code_of, warn_of_other_code
from vd4rl_pomdp.core.settings import LATER, RUNTIME_FIELDS
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.runs import CONFIG_FILE, DIVERGED_FILE, EPISODES_FILE, FORMAT, MACHINE_FILE, TIMING_FILE
from vd4rl_pomdp.runs.checkpoint import Checkpoints, State, fitting, pack, unpack
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.files import holds_anything, jsonable, read_json, write_json
from vd4rl_pomdp.runs.ownership import Owner, owned
from vd4rl_pomdp.runs.provenance import CONTINUED, command, git_commit, machine, versions

_CODE = ("versions", "git_commit", "plugins", "sources")
"""What a record tells of the code."""


def remedy(folder: Path) -> str:
    """What to do about a result of a finished run that is lost or damaged."""
    return (
        f"put it back, or remove {folder / TIMING_FILE} and re-run its command: it resumes from the last "
        "checkpoint and writes it anew"
    )


class RunFolder:
    """A run's files; `with` begins the run or goes on with it, owns its folder meanwhile, and answers signals."""

    def __init__(
        self,
        path: Path,
        stage: str,
        config: Any,
        inputs: dict[str, str],
        results: Sequence[str] = (),
        parts: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Nothing is written yet.

        Args:
            path: the folder.
            stage: the stage's name.
            config: the stage's settings, a dataclass.
            inputs: hashes of what the run reads, by name: the data's fingerprint, the encoder's hash.
            results: files that a finished run holds.
            parts: names of parts that the inputs bring along, by the registries' `setting`: an encoder's corruption.

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
        self._owner: Owner | None = None
        self._results = results
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
        if stored.get("format", 1) != FORMAT:
            raise UserError(
                f"{self.path}: holds a run of format {stored.get('format', 1)}, this version writes format {FORMAT} "
                "and cannot go on with it; choose another --out"
            )
        old, inputs = (part if isinstance(part := stored.get(name), dict) else {} for name in ("config", "inputs"))
        keys = set(self.config) - RUNTIME_FIELDS  # an earlier version recorded options that nothing read, too
        differing = sorted(k for k in keys if (LATER | old).get(k) != self.config[k])
        if stored["stage"] != self.stage or differing:
            what = ", ".join(differing) or f"stage {stored['stage']}"
            raise UserError(f"{self.path}: holds a run with another config ({what}); choose another --out or remove it")
        self._check_inputs(inputs)
        lost = next((name for name in self._results if self.finished and not (self.path / name).exists()), None)
        if lost:
            raise UserError(f"{self.path / lost}: is gone; {remedy(self.path)}")

    def _check_inputs(self, old: dict[str, str]) -> None:
        """Raise UserError if data or encoder are others than those the run began with."""
        for name, now in self.inputs.items():
            if old.get(name) != now:
                raise UserError(
                    f"{self.path}: holds a run with other content of --{name} ({self.config.get(name)} was "
                    f"{old.get(name)} and is {now}); give it what it began with, or choose another --out"
                )

    def __enter__(self) -> Self:
        self._warn_of_other_code()
        if not self.finished:
            self._owner = self._stack.enter_context(owned(self.path))
            try:
                self._check()  # another process may have begun or ended it since
                self._begin()
            except BaseException:
                self._stack.close()
                raise
        return self

    def _warn_of_other_code(self) -> None:
        kept = {} if self._begins else read_json(self.path / CONFIG_FILE)
        what = "this run began, which goes on or counts all the same; remove the run to compute it anew"
        warn_of_other_code(self.path, kept, self._parts, what)

    @property
    def _begins(self) -> bool:
        """Whether nothing is there that the run could go on with: what was recorded before tells of nothing."""
        return not (self.finished or self._checkpoints.steps() or (self.path / EPISODES_FILE).exists())

    @property
    def code(self) -> dict[str, Any]:
        """What the run began with, once it has: versions, commit, and where parts not of this package come from."""
        record = read_json(self.path / CONFIG_FILE)
        return {name: record.get(name, {}) for name in _CODE}  # early ones tell of no parts

    def _code_now(self) -> dict[str, Any]:
        return {"versions": versions(), "git_commit": git_commit()} | code_of(self._parts)

    def _begin(self) -> None:
        if self._begins:
            record = {"format": FORMAT, "stage": self.stage, "config": self.config, "inputs": self.inputs}
            origin = {"command": command(), "collection": read_plan(Path(self.config["data"]))}
            write_json(self.path / CONFIG_FILE, record | self._code_now() | origin)
        (self.path / DIVERGED_FILE).unlink(missing_ok=True)
        self._keep_machine()

    def _keep_machine(self) -> None:
        """Record the hardware; of a run that goes on, that and the code where they are others by now."""
        path, now = self.path / MACHINE_FILE, machine(self.config.get("device", "auto"))
        if self._begins or not path.exists():
            write_json(path, now)
            return
        told = read_json(path)
        parts = told.pop(CONTINUED, [])
        if not isinstance(parts, list):
            raise UserError(f"{path}: is damaged ({CONTINUED!r} is no list); remove it and re-run the same command")
        part, begun = now | self._code_now(), told | self.code
        if part != (begun | parts[-1] if parts else begun):
            write_json(path, told | {CONTINUED: [*parts, part]})

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
        checkpoint = self._checkpoints.newest()
        if checkpoint is None and read_episodes(self.path / EPISODES_FILE):
            raise UserError(
                f"{self.path}: has evaluations, but the checkpoints that they were made after are gone: put them back, "
                "or remove the folder to start the run again"
            )
        if checkpoint is not None:
            self._before = checkpoint.seconds
            with fitting(checkpoint):
                take(unpack(checkpoint.files))

    def save(self, step: int, state: State) -> None:
        """Keep the state after a step as the newest checkpoint."""
        self.require_owner()
        self._checkpoints.add(step, pack(state), self.seconds)

    def require_owner(self) -> None:
        """Raise an error if another process has taken the run over; see `Owner.check`."""
        assert self._owner is not None, "a run is written inside its `with` block"
        self._owner.check()

    def mark_diverged(self, step: int, message: str) -> None:
        """Say that a number was no longer finite after `step`; going on with the run takes the mark away."""
        self.require_owner()
        write_json(self.path / DIVERGED_FILE, {"step": step, "message": message})

    def finish(self, **more: Any) -> None:
        """Mark the run as done, keeping its wall-clock seconds and the last checkpoint."""
        self.require_owner()
        self._checkpoints.prune(1)
        write_json(self.path / TIMING_FILE, {"seconds": round(self.seconds, 2)} | more)
