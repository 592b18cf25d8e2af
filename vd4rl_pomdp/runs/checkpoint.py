"""Checkpoints: nested state as safetensors and JSON, exchanged whole, never pickled."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs.folder import newest, replacing
from vd4rl_pomdp.runs.reading import parse_json, read_tensors, regular

State = dict[str, Any]
"""Nested dicts with str or int keys, lists, tensors, and JSON scalars."""
_TENSOR = "__tensor__"


def save_checkpoint(folder: Path, state: State) -> None:
    """Write `state`; a reader sees the old checkpoint or the new one, never a mixture."""
    tensors: dict[str, Tensor] = {}
    tree = _split(state, "", tensors)
    with replacing(folder) as fresh:
        save_file(tensors, fresh / "state.safetensors")
        (fresh / "state.json").write_text(json.dumps(tree))


def load_checkpoint(folder: Path) -> State | None:
    """Read the newest whole checkpoint, None if there is none; a damaged or pickled one raises UserError."""
    whole = newest(folder)
    if whole is None:
        return None
    with _readable(whole):
        return _join(parse_json(regular(whole / "state.json").read_text()), read_tensors(whole / "state.safetensors"))


def restore_checkpoint(folder: Path, restore: Callable[[State], None]) -> None:
    """Hand the newest whole checkpoint, if there is one, to `restore`; one that does not fit raises UserError."""
    state = load_checkpoint(folder)
    if state is not None:
        with _readable(folder):
            restore(state)


@contextmanager
def _readable(folder: Path) -> Iterator[None]:
    """Whatever a checkpoint that is damaged or of another run leads to becomes a sentence."""
    try:
        yield
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise UserError(
            f"{folder}: this checkpoint is damaged or of another format or config "
            f"({str(error).splitlines()[0]}); remove it to start the run again"
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
    assert node is None or isinstance(node, bool | int | float | str), f"{path}: cannot save a {type(node).__name__}"
    return node


def _join(node: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(node, dict) and _TENSOR in node:
        return tensors[node[_TENSOR]]
    if isinstance(node, dict):
        return {key: _join(value, tensors) for key, value in node["__dict__"]}
    if isinstance(node, list):
        return [_join(value, tensors) for value in node]
    return node


def seed_everything(seed: int) -> None:
    """Seed the global generators, which only network initialisation uses; every other draw has its own."""
    torch.manual_seed(seed)
