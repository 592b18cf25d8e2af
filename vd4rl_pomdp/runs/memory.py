"""Memory: what the machine has, what plainly exceeds it, and which flags decide when it has run out."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.errors import DiskFullError, OutOfMemoryError, UserError, flag_of, told_apart
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.runs.provenance import machine_memory

_OUT = (
    *("DefaultCPUAllocator", "not enough memory", "Storage size calculation overflowed", "out of memory"),
    *("CUBLAS_STATUS_ALLOC_FAILED", "CUDNN_STATUS_ALLOC_FAILED"),
)
"""What torch says on a CPU, and of a GPU's libraries, where it has no exception of its own for it."""
_LIMIT = Path("/sys/fs/cgroup/memory.max")
CPU = torch.device("cpu")
_COPIES = 4
"""Numbers kept for each parameter in training: itself, its gradient and Adam's two moments."""


def memory_of(device: torch.device) -> int:
    """Bytes of memory that a device has in all: of a CPU what this process may use of it."""
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    whole = machine_memory() or sys.maxsize
    limit = _LIMIT.read_text(encoding="utf-8").strip() if _LIMIT.exists() else "max"
    return min(whole, int(limit)) if limit.isdigit() else whole


def require_memory(needed: float, device: torch.device, config: Any, *names: str) -> None:
    """Raise UserError, naming the flags that decide, if `needed` bytes exceed all the memory of a device."""
    have = memory_of(device)
    if needed > have:
        wanted, there = told_apart(needed / 1e9, have / 1e9, 0)
        raise UserError(
            f"{_named(config, names)} takes {wanted} GB of memory, and there are {there} GB: {_remedy(names)}"
        )


def require_disk(needed: float, path: Path, config: Any, *names: str) -> None:
    """Raise UserError, naming the flags that decide, if `needed` bytes exceed what is free where `path` will be."""
    place = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    disk = shutil.disk_usage(place)
    if needed > disk.free and disk.total:  # a file system without room, such as /proc, says itself what may not be
        wanted, there = told_apart(needed / 1e9, disk.free / 1e9, 1)
        raise DiskFullError(
            f"{_named(config, names)} takes {wanted} GB on the disk of {path}, and {there} GB are free: "
            f"{_remedy(names)} or free some space"
        )


@contextmanager
def telling_memory(config: Any, *names: str) -> Iterator[None]:
    """Turn running out of memory within the block into a UserError that names the flags that decide it."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not ran_out(error):
            raise
        raise OutOfMemoryError(f"out of memory with {_named(config, names)}: {_remedy(names)}") from error


def ran_out(error: Exception) -> bool:
    """Whether an error says that memory did not suffice."""
    own = isinstance(error, MemoryError | torch.OutOfMemoryError)
    return own or any(part in str(error) for part in _OUT)


def _named(config: Any, names: tuple[str, ...]) -> str:
    settings = flat(config)
    return ", ".join(f"{flag_of(name)} {settings[name]}" for name in names if name in settings)


def _remedy(names: tuple[str, ...]) -> str:
    return "lower one of them" if len(names) > 1 else "lower it"


def bytes_of_parameters(module: nn.Module) -> int:
    """Bytes that training a module's parameters takes."""
    return _COPIES * sum(parameter.nbytes for parameter in module.parameters())


def bytes_kept(module: nn.Module, example: Tensor) -> int:
    """Bytes of activations that `module(example)` keeps for its gradient, its parameters left out."""
    parameters = {parameter.data_ptr() for parameter in module.parameters()}
    kept: dict[int, int] = {}

    def pack(value: Tensor) -> Tensor:
        kept[value.data_ptr()] = value.nbytes
        return value

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda value: value), torch.enable_grad():
        result = module(example)  # keeps what is counted alive, so that no address counts twice
    del result
    return sum(size for address, size in kept.items() if address not in parameters)
