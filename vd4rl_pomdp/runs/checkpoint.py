"""Checkpoints: the two newest states of a run, each a folder of files with their hashes, never pickled.

    RUN/checkpoints/STEP/   manifest.json  format, seconds, SHA-256 of every other file
                            state.json     nested state, whose tensors are in
                            state.safetensors

A checkpoint is written under a hidden name, flushed to the disk, and renamed when it is whole: a process that is
killed at any moment leaves the newest whole one as it was.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, disk_errors, first_line
from vd4rl_pomdp.core.reading import parse_json, read_bytes
from vd4rl_pomdp.runs import FORMAT
from vd4rl_pomdp.runs.files import synchronise
from vd4rl_pomdp.runs.memory import ran_out

KEPT = 2
"""Checkpoints that are kept: a damaged newest one costs the steps since the one before."""
State = dict[str, Any]
"""Nested dicts with str or int keys, lists, tensors, and JSON scalars."""
_MANIFEST = "manifest.json"
_TREE, _TENSORS = "state.json", "state.safetensors"
_TENSOR = "__tensor__"


class _DamagedError(Exception):
    """A checkpoint's files are missing or differ from what was written."""


@dataclass(frozen=True)
class Checkpoint:
    """One whole checkpoint, in memory."""

    path: Path
    step: int
    seconds: float
    """Wall-clock seconds of the run up to it."""
    files: dict[str, bytes]


class Checkpoints:
    """The checkpoints of the run in a folder."""

    def __init__(self, run: Path) -> None:
        self._folder = run / "checkpoints"

    def add(self, step: int, files: dict[str, bytes], seconds: float) -> None:
        """Keep the files as the checkpoint after `step`, and drop all but the newest KEPT."""
        hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        manifest = json.dumps({"format": FORMAT, "seconds": round(seconds, 2), "sha256": hashes}, indent=1)
        target = self._folder / str(step)
        fresh = self._folder / f".{step}.tmp"
        with disk_errors(target):
            shutil.rmtree(fresh, ignore_errors=True)
            fresh.mkdir(parents=True)
            try:
                for name, content in (files | {_MANIFEST: manifest.encode()}).items():
                    (fresh / name).write_bytes(content)
                    synchronise(fresh / name)
                if target.exists():  # a damaged one, which was not gone on from
                    shutil.rmtree(target)
                fresh.rename(target)
                synchronise(self._folder)
            finally:
                shutil.rmtree(fresh, ignore_errors=True)
            self.prune(KEPT)

    def newest(self) -> Checkpoint | None:
        """The newest whole checkpoint, None for a run without any; damaged newer ones are removed with a warning each.

        Raises:
            UserError: there are some, but none is whole, or they are of another format, or not readable.
        """
        damaged: dict[Path, str] = {}
        for step in self.steps():
            try:
                found = self._read(step)
            except _DamagedError as error:
                damaged[self._folder / str(step)] = str(error)
                continue
            for path, problem in damaged.items():
                print(f"warning: {path}: is damaged ({problem}); going on from step {step}", file=sys.stderr)
                shutil.rmtree(path, ignore_errors=True)
            return found
        for path, problem in damaged.items():
            raise UserError(
                f"{path}: this checkpoint is damaged ({problem}), and there is no whole one; remove {self._folder} to "
                "start the run again"
            )
        return None

    def prune(self, kept: int) -> None:
        """Drop all but the newest `kept` checkpoints, and the remains of interrupted writes."""
        with disk_errors(self._folder):
            left = [path for path in self._folder.glob(".*.tmp")]
            for path in [*left, *(self._folder / str(step) for step in self.steps()[kept:])]:
                shutil.rmtree(path)

    def steps(self) -> list[int]:
        """Steps that have a checkpoint, the newest first."""
        with disk_errors(self._folder):
            names = [path.name for path in self._folder.iterdir()] if self._folder.is_dir() else []
        return sorted((int(name) for name in names if name.isdecimal()), reverse=True)

    def _read(self, step: int) -> Checkpoint:
        path = self._folder / str(step)
        try:
            manifest = parse_json(read_bytes(path / _MANIFEST))
            stored, seconds, hashes = manifest["format"], float(manifest["seconds"]), dict(manifest["sha256"])
            files = {name: read_bytes(path / name) for name in hashes}
        except (FileNotFoundError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, UserError):
                raise
            raise _DamagedError(first_line(error)) from error
        if stored != FORMAT:
            raise UserError(
                f"{path}: is a checkpoint of format {stored}, this version writes format {FORMAT} and cannot go on "
                "with it; choose another --out"
            )
        wrong = [name for name, content in files.items() if hashlib.sha256(content).hexdigest() != hashes[name]]
        if wrong:
            raise _DamagedError(f"{wrong[0]} is not what was written")
        return Checkpoint(path, step, seconds, files)


def pack(state: State) -> dict[str, bytes]:
    """A state as the files of a checkpoint."""
    tensors: dict[str, Tensor] = {}
    tree = _split(state, "", tensors)
    return {_TREE: json.dumps(tree).encode(), _TENSORS: save(tensors)}


def unpack(files: dict[str, bytes]) -> State:
    """The state that was packed."""
    state: State = _join(json.loads(files[_TREE]), load(files[_TENSORS]))
    return state


@contextmanager
def fitting(checkpoint: Checkpoint) -> Iterator[None]:
    """Turn the errors that a checkpoint of another run leads to within the block into one sentence."""
    try:
        yield
    except UserError:
        raise
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        if ran_out(error):
            raise
        raise UserError(
            f"{checkpoint.path}: this checkpoint does not fit the run ({first_line(error)}); choose another --out, or "
            f"remove {checkpoint.path.parent} to start the run again"
        ) from error


def _split(node: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    """JSON tree of `node`, its tensors moved to `tensors` under their paths."""
    if isinstance(node, Tensor):
        tensors[path] = node.detach().cpu().contiguous().clone()
        return {_TENSOR: path}
    if isinstance(node, dict):
        items = [[key, _split(value, f"{path}/{key}", tensors)] for key, value in node.items()]
        return {"__dict__": items}
    if isinstance(node, list | tuple):
        return [_split(value, f"{path}/{i}", tensors) for i, value in enumerate(node)]
    if not (node is None or isinstance(node, bool | int | float | str)):
        raise UserError(
            f"a checkpoint cannot keep {path[1:]}, which is a {type(node).__name__}: give a tensor, a number of "
            "Python's, a word, None, or lists and dicts of them"
        )
    return node


def _join(node: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(node, dict) and _TENSOR in node:
        return tensors[node[_TENSOR]]
    if isinstance(node, dict):
        return {key: _join(value, tensors) for key, value in node["__dict__"]}
    if isinstance(node, list):
        return [_join(value, tensors) for value in node]
    return node
