"""Devices and precision: bf16 is the same computation on CPUs with and without instructions for it."""

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from vd4rl_pomdp.nn.heads import ExactLinear
from vd4rl_pomdp.runs import device
from vd4rl_pomdp.runs.device import RoundedProducts, autocast

CPU = torch.device("cpu")
PRODUCTS = {"mm", "addmm", "bmm", "baddbmm", "convolution", "convolution_backward", "mkldnn_linear"}


@pytest.fixture
def no_kernels(monkeypatch):
    monkeypatch.setattr(device, "has_bf16_kernels", lambda: False)


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Conv2d(9, 8, 4, 2), nn.ReLU(), nn.Flatten(), nn.Linear(8 * 5 * 5, 16), nn.ReLU())


def gradients(net: nn.Module, image: Tensor) -> list[Tensor]:
    net.zero_grad()
    with autocast(CPU, "bf16"):
        out = net(image)
        loss = (out @ out.T).float().square().mean()
    loss.backward()
    return [loss.detach(), *(parameter.grad for parameter in net.parameters())]


class Recorded(TorchDispatchMode):
    """Notes in which precision products are computed, forwards and backwards."""

    def __init__(self) -> None:
        super().__init__()
        self.products: set[tuple[str, torch.dtype]] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if name in PRODUCTS:
            self.products |= {(name, arg.dtype) for arg in args if isinstance(arg, Tensor)}
        return func(*args, **(kwargs or {}))


def test_without_kernels_every_product_is_computed_in_fp32_gradients_included(no_kernels):
    net, image = network(), torch.rand(6, 9, 12, 12)
    with Recorded() as recorded:
        gradients(net, image)
    names, dtypes = (set(column) for column in zip(*recorded.products, strict=True))
    assert dtypes == {torch.float32}
    assert {"convolution", "convolution_backward", "mm"} <= names


def test_rounded_products_are_those_of_bf16(no_kernels, monkeypatch):
    net, image = network(), torch.rand(6, 9, 12, 12)
    rounded = gradients(net, image)
    monkeypatch.setattr(device, "has_bf16_kernels", lambda: True)
    native = gradients(net, image)
    with autocast(CPU, "fp32"):
        full = net(image)
    for ours, torchs in zip(rounded, native, strict=True):
        assert ours.dtype == torchs.dtype
        assert (ours - torchs).norm() < 0.02 * torchs.norm()
    with autocast(CPU, "bf16"):
        assert not torch.equal(net(image).float(), full)


def test_a_rounded_product_rounds_operands_and_result(no_kernels):
    torch.manual_seed(0)
    a, b = torch.randn(32, 64), torch.randn(64, 32)  # sums that cancel show what was rounded
    expected = (a.bfloat16().float() @ b.bfloat16().float()).bfloat16()
    with autocast(CPU, "bf16"):
        products = [a @ b, a.matmul(b), torch.mm(a, b), torch.einsum("ij,jk->ik", a, b), nn.functional.linear(a, b.T)]
    for product in products:  # equal to one unit: kernels sum in orders of their own
        assert product.dtype == torch.bfloat16
        assert torch.allclose(product.float(), expected.float(), rtol=2**-7, atol=1e-3)


def test_what_leaves_autocast_keeps_its_precision(no_kernels):
    head, x = ExactLinear(64, 3), torch.rand(5, 64)
    with autocast(CPU, "bf16"):
        inside = head(x)
    assert torch.equal(inside, head(x))


def test_fp32_and_cpus_with_kernels_need_no_rounding(monkeypatch):
    def refuse(self, *args):
        raise AssertionError("nothing is to be rounded")

    monkeypatch.setattr(RoundedProducts, "__torch_function__", refuse)
    for kernels, precision in ((False, "fp32"), (True, "fp32"), (True, "bf16")):
        monkeypatch.setattr(device, "has_bf16_kernels", lambda kernels=kernels: kernels)
        with autocast(CPU, precision):
            out = torch.rand(3, 4) @ torch.rand(4, 2)
        assert out.dtype == (torch.bfloat16 if precision == "bf16" else torch.float32)
