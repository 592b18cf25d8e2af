"""The package's Adam moves weights as PyTorch's does, to the bit."""

import subprocess
import sys

SCRIPT = """
import sys
import torch
from vd4rl_pomdp.nn.adam import Adam


def moved(kind, **told):
    weight = torch.nn.Parameter(torch.linspace(-1, 1, 7))
    optimiser = kind([weight], **told)
    for step in range(4):
        optimiser.zero_grad()
        (weight - 3).pow(4).sum().backward()
        optimiser.step()
        optimiser.load_state_dict(optimiser.state_dict())
    return weight.detach()


own = [moved(Adam, learning_rate=0.1, fused=fused) for fused in (False, True)]
assert "torch._dynamo" not in sys.modules, "it takes 140 MB and a second to import"
for found, told in zip(own, ({}, {"fused": True})):
    assert torch.equal(found, moved(torch.optim.Adam, lr=0.1, **told))
"""


def test_it_moves_weights_as_pytorchs_and_does_not_import_its_compiler():
    subprocess.run([sys.executable, "-c", SCRIPT], check=True, timeout=120)
