"""Devices, precision and frame buffers."""

import os

import pytest
import torch

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.hardware import FrameBuffers, autocast, pick_device, set_products
from vd4rl_pomdp.nn.heads import ExactLinear

CPU = torch.device("cpu")


def test_autocast_uses_bf16_except_for_exact_layers():
    head, x = ExactLinear(64, 3), torch.rand(5, 64)
    with autocast(CPU, "bf16"):
        assert (x @ x.T).dtype == torch.bfloat16
        inside = head(x)
    assert torch.equal(inside, head(x))
    with autocast(CPU, "fp32"):
        assert (x @ x.T).dtype == torch.float32


@pytest.mark.parametrize(("name", "message"), [("gpu", "unknown device 'gpu'"), ("cuda:99", "no such GPU is visible")])
def test_missing_device_is_rejected(name, message):
    assert pick_device("cpu") == CPU
    with pytest.raises(UserError, match=message):
        pick_device(name)


@pytest.mark.parametrize(
    ("running", "threads", "cores", "warns"), [(2, 2, 2, True), (1, 2, 2, False), (2, 1, 2, False), (13, 4, 16, False)]
)
def test_training_warns_if_busy_cores_would_slow_its_threads_down(
    tmp_path, monkeypatch, capsys, running, threads, cores, warns
):
    load = tmp_path / "loadavg"
    load.write_text(f"0.5 0.6 0.7 {running}/412 999\n")
    monkeypatch.setattr(hardware, "_RUNNING", load)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(cores))
    for of_all in (cores, 2 * cores):  # on some cores of a machine, the others' threads do not count
        monkeypatch.setattr(os, "cpu_count", lambda of_all=of_all: of_all)
        hardware.warn_of_busy_cores(CPU)
        assert ("other programs use 1 of 2 cores" in capsys.readouterr().err) == (warns and of_all == cores)


@pytest.mark.gpu
@pytest.mark.parametrize(("precision", "error"), [("fp32", (0, 1e-5)), ("tf32", (1e-5, 1e-2))])
def test_gpu_matrix_products_have_the_set_precision(precision, error):
    g = torch.Generator().manual_seed(0)
    a, b = torch.randn(512, 512, generator=g), torch.randn(512, 512, generator=g)
    truth = (a.double() @ b.double()).float()
    set_products(torch.device("cuda"), precision)
    found = (a.cuda() @ b.cuda()).cpu()
    off = float((found - truth).norm() / truth.norm())
    set_products(torch.device("cuda"), "fp32")
    assert error[0] <= off <= error[1]


def test_tf32_has_no_effect_on_cpu():
    assert not autocast(CPU, "tf32")._enabled
    before = torch.get_float32_matmul_precision()
    set_products(CPU, "tf32")
    assert torch.get_float32_matmul_precision() == before


def test_buffers_are_reused_only_when_unreferenced():
    buffers = FrameBuffers()
    first = buffers.take((2, 3, 84, 84))
    address = first.data_ptr()
    part = first.view(-1)[5:9]
    del first
    assert buffers.take((2, 3, 84, 84)).data_ptr() != address, "a view of the first block is alive"
    del part
    assert address in {tensor.data_ptr() for tensor in [buffers.take((2, 3, 84, 84)) for _ in range(2)]}


def test_live_buffers_have_their_shape_and_do_not_share_memory():
    buffers = FrameBuffers()
    shapes = [tuple(buffers.take((count, 3, 84, 84)).shape) for count in (3, 1, 2, 3, 0, 5, 4)]
    assert shapes == [(count, 3, 84, 84) for count in (3, 1, 2, 3, 0, 5, 4)]
    held = [buffers.take((1, 3, 84, 84)).fill_(i) for i in range(9)]
    assert [int(tensor.float().mean()) for tensor in held] == list(range(9))
    assert len({tensor.data_ptr() for tensor in held}) == 9
    assert held[0].dtype == torch.uint8
