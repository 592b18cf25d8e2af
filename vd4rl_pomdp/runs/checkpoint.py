"""Checkpoints: the two newest states of a run, one `torch.save` file each, read with `weights_only`.

A checkpoint is written under a hidden name, flushed to disk and then renamed, so a process killed at any moment leaves
the previous one intact. Damage is detected by the zip's checksums.
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
"""Checkpoints to keep. If the newest is damaged, only the steps since the one before are lost."""
State = dict[str, Any]  # nested dicts, lists and tuples of tensors, numbers, strings and None


class Checkpoints:
    """The checkpoints of the run in a folder: `checkpoints/STEP.pt`."""

    def __init__(self, run: Path) -> None:
        self._folder = run / "checkpoints"

    def add(self, step: int, state: State, seconds: float) -> None:
        """Save a state reached after `seconds` as the checkpoint of `step`, and delete all but the newest KEPT."""
        content = pack({"format": FORMAT, "seconds": round(seconds, 2), "state": state})
        with disk_errors(self._folder):
            write_bytes(self._folder / f"{step}.pt", content)
            synchronise(self._folder)  # before deleting the oldest: otherwise a power cut could lose both
            self.prune(KEPT)

    def restore(self, take: Callable[[State], None]) -> float | None:
        """Pass the newest undamaged state to `take`; return the run's seconds then, or None without checkpoints.

        UserError if all checkpoints are damaged or unreadable, or belong to another format or run.
        """
        # Disks corrupt files; falling back to the previous checkpoint beats starting over.
        damaged: dict[Path, str] = {}
        for step in self.steps():
            content = read_bytes(path := self._folder / f"{step}.pt")
            try:
                found = unpack(content)
            except Exception as error:  # zipfile and torch raise anything on a damaged file
                damaged[path] = first_line(error)
                continue
            for other, problem in damaged.items():
                print(f"warning: {other}: is damaged ({problem}); resuming from step {step}", file=sys.stderr)
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
                f"{path}: this checkpoint is damaged ({problem}), and no other is complete; remove {self._folder} to "
                "start the run again"
            )
        return None

    def prune(self, kept: int) -> None:
        """Delete all but the newest `kept` checkpoints, and leftovers of interrupted writes."""
        with disk_errors(self._folder):
            for path in [*self._folder.glob(".*.tmp"), *(self._folder / f"{step}.pt" for step in self.steps()[kept:])]:
                path.unlink()

    def steps(self) -> list[int]:
        """Steps that have a checkpoint, newest first."""
        with disk_errors(self._folder):
            files = [*self._folder.iterdir()] if self._folder.is_dir() else []  # glob would hide errors
        return sorted((int(one.stem) for one in files if one.suffix == ".pt" and one.stem.isdecimal()), reverse=True)


def pack(state: State) -> bytes:
    """Serialise a state; UserError for types that `unpack` would reject."""
    content = io.BytesIO()
    torch.save(_copied(state, ""), content)
    return content.getvalue()


def unpack(content: bytes) -> State:
    """Deserialise a state onto the CPU; raises an exception of any kind for damaged content."""
    if damaged := zipfile.ZipFile(io.BytesIO(content)).testzip():  # torch.load does not verify checksums
        raise ValueError(f"{damaged} is not what was written")
    state: State = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return state


def _copied(node: Any, place: str) -> Any:
    """Copy to the CPU. Cloning keeps a view from saving its whole storage."""
    if isinstance(node, Tensor):
        return node.detach().cpu().contiguous().clone()
    if isinstance(node, dict):
        return {key: _copied(value, f"{place}/{key}") for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [_copied(value, f"{place}/{i}") for i, value in enumerate(node)]
    if type(node) not in (type(None), bool, int, float, str):
        raise UserError(
            f"a checkpoint cannot store {place[1:]}, which is a {type(node).__name__}: use a tensor, a Python number, "
            "a string, None, or lists and dicts of them"
        )
    return node
