"""Adam's state transfers between implementations and memory layouts."""

import pytest
import torch
from torch import nn

from tests.recording import ReplayedAdam
from vd4rl_pomdp.nn.adam import Adam, set_learning_rate
from vd4rl_pomdp.runs.checkpoint import pack, unpack


def trained(
    kind: type[Adam], steps: int, state: dict | None = None, weights: nn.Parameter | None = None, **given: bool
):
    """Channels-last weights after `steps` of a fixed gradient sequence, and their optimiser."""
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
def test_adam_state_transfers_between_implementations(before, after):
    """The state is saved contiguously; the learning rate's value is restored, but not its type."""
    whole, _ = trained(Adam, 5)
    weights, adam = trained(before[0], 3, **before[1])
    set_learning_rate(adam, 0.2)
    weights, adam = trained(after[0], 0, unpack(pack(adam.state_dict())), weights, **after[1])
    assert float(adam.param_groups[0]["lr"]) == pytest.approx(0.2)
    assert isinstance(adam.param_groups[0]["lr"], torch.Tensor) == (after[0] is ReplayedAdam)
    set_learning_rate(adam, 0.1)
    weights, adam = trained(after[0], 2, unpack(pack(adam.state_dict())), weights, **after[1])
    torch.testing.assert_close(weights, whole)


def test_adam_state_of_a_gpu_loads_on_a_cpu():
    weights, adam = trained(Adam, 3)
    state = adam.state_dict()
    state["param_groups"][0] |= {"capturable": True, "fused": True, "lr": torch.tensor(0.1)}
    weights, adam = trained(Adam, 2, state, weights)
    torch.testing.assert_close(weights, trained(Adam, 5)[0])
    assert adam.param_groups[0]["lr"] == pytest.approx(0.1)
