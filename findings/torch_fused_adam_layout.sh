#!/usr/bin/env bash
# One would guess: Adam's state may be saved contiguous and loaded again, as checkpoints usually are written; `fused`
# changes how fast a step is, not what it computes.
# What happens: where convolutions' weights are channels-last, the fused step on a CPU pairs weights and moments by their
# place in memory. After loading contiguous moments it moves the wrong weights, without an error or a warning. The plain
# step is right.
# For this field: convolutions are often trained channels-last, and a run that is cut and resumed ends elsewhere.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" << 'PY'
import torch

print("torch", torch.__version__)
LAST = torch.channels_last


def trained(fused, contiguous):
    g = torch.Generator().manual_seed(0)
    weights = torch.nn.Parameter(torch.randn(4, 3, 2, 2, generator=g).to(memory_format=LAST))
    adam = torch.optim.Adam([weights], lr=0.1, fused=fused)
    for step in range(3):
        weights.grad = torch.randn(4, 3, 2, 2, generator=g).to(memory_format=LAST)
        if step == 2 and contiguous:
            saved = adam.state_dict()
            for moments in saved["state"].values():
                moments.update({name: value.clone(memory_format=torch.contiguous_format) for name, value in moments.items()})
            adam.load_state_dict(saved)
        adam.step()
    return weights.detach()


off = {fused: (trained(fused, True) - trained(fused, False)).abs().max().item() for fused in (False, True)}
print("largest difference to a run that was not cut, learning rate 0.1:", {f"fused={k}": round(v, 4) for k, v in off.items()})
assert off[False] == 0, "the plain step depends on the layout, too"
assert off[True] > 0.05, "the fused step now minds the layout"
PY
