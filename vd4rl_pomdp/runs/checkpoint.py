"""Checkpoints: the two newest states of a run, each a file of `torch.save`, read with `weights_only`.

A checkpoint is written under a hidden name, flushed to the disk, and renamed when it is whole: a process that is
killed at any moment leaves the newest whole one as it was. A zip's checksums tell damaged ones.
"""

from __future__ import annotations

import io
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, disk_errors, first_line
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.runs import FORMAT
from vd4rl_pomdp.runs.files import synchronise, write_bytes

KEPT = 2
"""Checkpoints that are kept: a damaged newest one costs the steps since the one before."""
State = dict[str, Any]
"""Nested dicts, lists and tuples of tensors, Python's numbers, words, and None."""


class Checkpoints:
    """The checkpoints of the run in a folder: `checkpoints/STEP.pt`."""

    def __init__(self, run: Path) -> None:
        self._folder = run / "checkpoints"

    def add(self, step: int, state: State, seconds: float) -> None:
        """Keep a state, reached after so many seconds, as the checkpoint after `step`; drop all but the newest KEPT."""
        with disk_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self._path(step), pack({"format": FORMAT, "seconds": round(seconds, 2), "state": state}))
            synchronise(self._folder)  # before the oldest goes: a power cut would else leave neither
            self.prune(KEPT)

    def restore(self, take: Callable[[State], None]) -> float | None:
        """Hand the newest whole state to `take`; the seconds it was reached after, None without any checkpoint.

        Raises:
            UserError: there are some, but none is whole, or they are of another format or run, or not readable.
        """
        # A disk may give back other bytes than it took: the one before is worth more than a run begun again.
        damaged: dict[Path, str] = {}
        for path in map(self._path, self.steps()):
            content = read_bytes(path)
            try:
                found = unpack(content)
            except Exception as error:  # whatever a damaged file leads zipfile and torch to
                damaged[path] = first_line(error)
                continue
            for other, problem in damaged.items():
                print(f"warning: {other}: is damaged ({problem}); resuming from step {path.stem}", file=sys.stderr)
            if (stored := found["format"]) != FORMAT:
                raise UserError(
                    f"{path}: is a checkpoint of format {stored}, this version writes format {FORMAT} and cannot "
                    "resume from it; choose another --out"
                )
            try:
                take(found["state"])
            except (UserError, torch.OutOfMemoryError):
                raise
            except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
                raise UserError(
                    f"{path}: this checkpoint does not fit the run ({first_line(error)}); choose another --out, or "
                    f"remove {self._folder} to start the run again"
                ) from error
            return float(found["seconds"])
        for path, problem in damaged.items():
            raise UserError(
                f"{path}: this checkpoint is damaged ({problem}), and there is no whole one; remove {self._folder} to "
                "start the run again"
            )
        return None

    def prune(self, kept: int) -> None:
        """Drop all but the newest `kept` checkpoints, and the remains of interrupted writes."""
        with disk_errors(self._folder):
            for path in [*self._folder.glob(".*.tmp"), *map(self._path, self.steps()[kept:])]:
                path.unlink()

    def steps(self) -> list[int]:
        """Steps that have a checkpoint, the newest first."""
        with disk_errors(self._folder):
            files = self._folder.iterdir() if self._folder.is_dir() else ()
            return sorted(
                (int(path.stem) for path in files if path.suffix == ".pt" and path.stem.isdecimal()), reverse=True
            )

    def _path(self, step: int) -> Path:
        return self._folder / f"{step}.pt"


def pack(state: State) -> bytes:
    """A state as a checkpoint's content; raises UserError for what `unpack` would refuse."""
    content = io.BytesIO()
    torch.save(_copied(state, ""), content)
    return content.getvalue()


def unpack(content: bytes) -> State:
    """The state that was packed, on the CPU; raises some exception for damaged content."""
    if damaged := zipfile.ZipFile(io.BytesIO(content)).testzip():  # torch checks no sums
        raise ValueError(f"{damaged} is not what was written")
    state: State = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return state


def _copied(node: Any, place: str) -> Any:
    """A copy on the CPU in which a part of a large tensor does not bring the whole along."""
    if isinstance(node, Tensor):
        return node.detach().cpu().contiguous().clone()
    if isinstance(node, dict):
        return {key: _copied(value, f"{place}/{key}") for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [_copied(value, f"{place}/{i}") for i, value in enumerate(node)]
    if type(node) not in (type(None), bool, int, float, str):
        raise UserError(
            f"a checkpoint cannot keep {place[1:]}, which is a {type(node).__name__}: give a tensor, a number of "
            "Python's, a word, None, or lists and dicts of them"
        )
    return node
