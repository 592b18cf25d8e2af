"""What exceeds a machine is said in one line that names the flags, before anything is done where it can be known."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import finetune.config
import pretrain.config
from finetune.train import finetune as run_finetune
from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core.errors import UserError, told_apart
from vd4rl_pomdp.runs import memory
from vd4rl_pomdp.runs.memory import CPU, bytes_kept, memory_of, require_disk, require_memory, telling_memory


@dataclass
class Settings:
    batch_size: int = 8
    window: int = 4


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        np._core._exceptions._ArrayMemoryError((10**15,), np.dtype("u1")),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 7 GiB"),
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: you tried"
        ),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        RuntimeError("Storage size calculation overflowed with sizes=[1000000000, 3000000000]"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_running_out_of_memory_names_the_flags(error):
    message = "out of memory with --batch-size 8, --window 4: lower one of them"
    with pytest.raises(UserError, match=message), telling_memory(Settings(), "batch_size", "window"):
        raise error


def test_another_error_stays_what_it_is():
    with pytest.raises(RuntimeError, match="shapes"), telling_memory(Settings(), "batch_size"):
        raise RuntimeError("shapes cannot be multiplied")


def test_allocations_that_no_machine_grants_are_told():
    with pytest.raises(UserError, match="out of memory"), telling_memory(Settings(), "batch_size"):
        torch.empty(2**60, dtype=torch.uint8)
    with pytest.raises(UserError, match="out of memory"), telling_memory(Settings(), "batch_size"):
        np.empty(2**60, np.uint8)


def test_more_than_the_machine_or_the_disk_has_is_refused(tmp_path):
    require_memory(memory_of(CPU), CPU, Settings(), "window")
    needed = memory_of(CPU) + 1
    shown = " GB of memory, and there are ".join(told_apart(needed / 1e9, memory_of(CPU) / 1e9, 0))
    with pytest.raises(UserError, match=rf"--window 4 takes {shown} GB: lower it"):
        require_memory(needed, CPU, Settings(), "window")
    require_disk(1, tmp_path / "not" / "there", Settings(), "window")
    with pytest.raises(UserError, match=r"--window 4 takes .* GB on the disk of .*: lower it or free"):
        require_disk(1e18, tmp_path / "not" / "there", Settings(), "window")
    require_disk(1e18, Path("/proc/not/there"), Settings(), "window")  # no disk: making the folder says what is wrong


def test_a_limit_of_the_control_group_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "_LIMIT", tmp_path / "memory.max")
    whole = memory_of(CPU)
    (tmp_path / "memory.max").write_text("max\n")
    assert memory_of(CPU) == whole
    (tmp_path / "memory.max").write_text("1000\n")
    assert memory_of(CPU) == 1000


def test_a_system_that_does_not_tell_its_memory_refuses_nothing(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(memory, "_LIMIT", tmp_path / "none")
    assert memory_of(CPU) == sys.maxsize
    require_memory(1e15, CPU, Settings(), "window")


def test_what_a_module_keeps_for_its_gradient_is_counted():
    module = nn.Sequential(nn.Linear(10, 20), nn.ReLU(), nn.Linear(20, 30), nn.Tanh())
    inputs, hidden, outputs = 10, 20, 30  # ReLU's output is the next layer's input
    assert bytes_kept(module, torch.zeros(7, 10)) == 7 * 4 * (inputs + hidden + outputs)


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path / "cache"))
    return write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])


@pytest.mark.parametrize("changes", [{"batch_size": 200_000, "window": 16}, {"hidden_dim": 10**6}, {"head_dim": 10**9}])
def test_a_pretraining_beyond_the_machine_leaves_no_run(data, tmp_path, changes):
    config = pretrain.config.PretrainConfig.of("smoke", data=data, out=tmp_path / "out", **changes)
    flag, value = next((name.replace("_", "-"), number) for name, number in changes.items())
    with pytest.raises(UserError, match=rf"memory.*--{flag} {value}|--{flag} {value}.*memory"):
        run_pretrain(config)
    assert not config.out.exists()


@pytest.mark.parametrize("name", ["views", "batch_size", "hidden_dim"])
def test_a_finetuning_beyond_the_machine_leaves_no_run(data, tmp_path, name):
    made = run_pretrain(pretrain.config.PretrainConfig.of("smoke", data=data, out=tmp_path / "made", method="random"))
    given = {"encoder": made.path / "encoder", "data": data, "out": tmp_path / "out"}
    config = finetune.config.FinetuneConfig.of("smoke", **given, **{name: 10**9})
    with pytest.raises(UserError, match=rf"--{name.replace('_', '-')} 1000000000.* takes .* GB of memory"):
        run_finetune(config)
    assert not config.out.exists()


@pytest.mark.parametrize(
    ("value", "limit", "decimals", "shown"),
    [
        (4.2e9, 1e3, 0, ("4,200,000,000", "1,000")),
        (4.004, 4.0036, 1, ("4.0040", "4.0036")),
        (0.796, 0.8, 2, ("0.796", "0.800")),
        (1e-6, 0.0, 1, ("0.000001", "0.000000")),
        (2.0, 2.0, 1, ("2.0", "2.0")),
    ],
)
def test_numbers_are_shown_so_that_the_larger_is_seen_to_be(value, limit, decimals, shown):
    assert told_apart(value, limit, decimals) == shown
