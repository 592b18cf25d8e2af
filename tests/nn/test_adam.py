"""Adam's state goes from one kind of step to another, and from one memory layout to another."""

import pytest
import torch
from torch import nn

from tests.recording import ReplayedAdam
from vd4rl_pomdp.nn.adam import Adam, set_learning_rate
from vd4rl_pomdp.runs.checkpoint import pack, unpack


def trained(
    kind: type[Adam], steps: int, state: dict | None = None, weights: nn.Parameter | None = None, **given: bool
):
    """Channels-last weights after some steps of a fixed sequence of gradients, and what moved them."""
    g = torch.Generator().manual_seed(0)
    first = torch.randn(4, 3, 2, 2, generator=g)
    if weights is None:
        weights = nn.Parameter(first.to(memory_format=torch.channels_last))
    adam, begun = kind([weights], 0.1, **given), 0
    if state is not None:
        adam.load_state_dict(state)
        begun = int(adam.state[weights]["step"])
    for step in range(begun + steps):
        gradient = torch.randn(4, 3, 2, 2, generator=g).to(memory_format=torch.channels_last)
        if step >= begun:
            weights.grad = gradient
            adam.step()
    return weights, adam


@pytest.mark.parametrize("after", [(Adam, {}), (Adam, {"fused": True}), (ReplayedAdam, {})], ids=str)
@pytest.mark.parametrize("before", [(Adam, {}), (Adam, {"fused": True}), (ReplayedAdam, {})], ids=str)
def test_a_saved_state_goes_on_under_another_kind_of_step(before, after):
    """Saved contiguous, as checkpoints are; its learning rate is the saved one's, its kind the own."""
    whole, _ = trained(Adam, 5)
    weights, adam = trained(before[0], 3, **before[1])
    set_learning_rate(adam, 0.2)
    weights, adam = trained(after[0], 0, unpack(pack(adam.state_dict())), weights, **after[1])
    assert float(adam.param_groups[0]["lr"]) == pytest.approx(0.2)
    assert isinstance(adam.param_groups[0]["lr"], torch.Tensor) == (after[0] is ReplayedAdam)
    set_learning_rate(adam, 0.1)
    weights, adam = trained(after[0], 2, unpack(pack(adam.state_dict())), weights, **after[1])
    torch.testing.assert_close(weights, whole)


def test_a_state_of_a_gpu_is_taken_on_a_cpu():
    weights, adam = trained(Adam, 3)
    state = adam.state_dict()
    state["param_groups"][0] |= {"capturable": True, "fused": True, "lr": torch.tensor(0.1)}
    weights, adam = trained(Adam, 2, state, weights)
    torch.testing.assert_close(weights, trained(Adam, 5)[0])
    assert adam.param_groups[0]["lr"] == pytest.approx(0.1)
