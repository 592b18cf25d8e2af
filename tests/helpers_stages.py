"""The stages at their smallest size, interruptions, and the contents of run folders."""

import hashlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch

import finetune.config
import pretrain.config
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.runs.checkpoint import Checkpoints

VARYING = ("timing.json", "pretrain_timing.json", "machine.json")


def option_names() -> set[str]:
    """Names of the options of all plug-ins."""
    kinds, found = [Options], set[str]()
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        found |= {field.name for field in fields(kind)}
    return found


def contents(folder: Path) -> dict[str, str]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name not in VARYING)
    return {p.relative_to(folder).as_posix(): hashlib.sha256(_stable(p)).hexdigest() for p in files}


def _stable(path: Path) -> bytes:
    """A file's content without run paths and seconds."""
    text = path.read_bytes()
    if path.suffix == ".pt":
        return repr(_spelled(torch.load(path, weights_only=True)["state"])).encode()
    if path.name == "results.json":
        return b"\n".join(line for line in text.splitlines() if b'"command"' not in line)
    if path.name == "config.json":
        return b"\n".join(line for line in text.splitlines() if b'"out"' not in line and b'"encoder":' not in line)
    return text


def _spelled(node: Any) -> Any:
    """A state with tensors replaced by hashes, since pickles depend on object identity."""
    if isinstance(node, torch.Tensor):
        return str(node.dtype), tuple(node.shape), hashlib.sha256(node.numpy().tobytes()).hexdigest()
    if isinstance(node, dict):
        return {key: _spelled(value) for key, value in node.items()}
    return [_spelled(value) for value in node] if isinstance(node, list | tuple) else node


class CutError(Exception):
    pass


def run_until_cut(monkeypatch, number: int, run: Callable[..., object], *configs: object) -> None:
    """Run a stage, and raise in place of writing its `number`-th checkpoint."""
    calls, add = [], Checkpoints.add

    def cut(self, *arguments):
        calls.append(arguments)
        if len(calls) == number:
            raise CutError
        add(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "add", cut)
        with pytest.raises(CutError):
            run(*configs)


def smoke_pretrain(data: Path, out: Path, **changes: object) -> pretrain.config.PretrainConfig:
    return pretrain.config.PretrainConfig.of(
        "smoke", **({"data": data, "out": out, "corruption": "patch+zero_frames"} | changes)
    )


def smoke_finetune(encoder: Path, data: Path, out: Path, **changes: object) -> finetune.config.FinetuneConfig:
    return finetune.config.FinetuneConfig.of("smoke", encoder=encoder, data=data, out=out, workers=1, **changes)
