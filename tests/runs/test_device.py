"""Devices and precision."""

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.heads import ExactLinear
from vd4rl_pomdp.runs.device import autocast, pick_device, set_products

CPU = torch.device("cpu")


def test_products_are_in_bf16_but_for_those_that_leave_autocast():
    head, x = ExactLinear(64, 3), torch.rand(5, 64)
    with autocast(CPU, "bf16"):
        assert (x @ x.T).dtype == torch.bfloat16
        inside = head(x)
    assert torch.equal(inside, head(x))
    with autocast(CPU, "fp32"):
        assert (x @ x.T).dtype == torch.float32


@pytest.mark.parametrize(("name", "told"), [("gpu", "unknown device 'gpu'"), ("cuda:99", "no such GPU is visible")])
def test_a_device_that_is_not_there_is_refused(name, told):
    assert pick_device("cpu") == CPU
    with pytest.raises(UserError, match=told):
        pick_device(name)


@pytest.mark.gpu
@pytest.mark.parametrize(("precision", "error"), [("fp32", (0, 1e-5)), ("tf32", (1e-5, 1e-2))])
def test_products_on_a_gpu_have_the_precision_that_is_set(precision, error):
    g = torch.Generator().manual_seed(0)
    a, b = torch.randn(512, 512, generator=g), torch.randn(512, 512, generator=g)
    truth = (a.double() @ b.double()).float()
    set_products(torch.device("cuda"), precision)
    found = (a.cuda() @ b.cuda()).cpu()
    off = float((found - truth).norm() / truth.norm())
    set_products(torch.device("cuda"), "fp32")
    assert error[0] <= off <= error[1]


def test_tf32_on_a_cpu_is_fp32():
    assert not autocast(CPU, "tf32")._enabled
    before = torch.get_float32_matmul_precision()
    set_products(CPU, "tf32")
    assert torch.get_float32_matmul_precision() == before
