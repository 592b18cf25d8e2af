#!/usr/bin/env bash
# One would guess: under autocast a linear layer is the same whether its seeds run one by one or stacked by `vmap`.
# What happens: the layer adds its bias before it rounds to bfloat16 and returns bfloat16; `vmap` splits it into a product
# in bfloat16 and a sum in float32, and returns float32.
# For this field: ensembles and stacked seeds in mixed precision are other trainings than single ones, by more than the
# order of summation.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" << 'PY'
import torch
from torch.func import vmap
from torch.nn.functional import linear

print("torch", torch.__version__)
g = torch.Generator().manual_seed(0)
x, weight, bias = (torch.randn(*shape, generator=g) for shape in ((3, 64, 32), (3, 16, 32), (3, 16)))
with torch.autocast("cpu", torch.bfloat16):
    single = torch.stack([linear(*each) for each in zip(x, weight, bias)])
    mapped = vmap(linear)(x, weight, bias)
off = (single.float() - mapped.float()).abs().max().item()
largest = single.abs().max().item()
print(single.dtype, "under vmap:", mapped.dtype, f"largest difference {off:.4f} of values up to {largest:.1f}")
assert single.dtype == torch.bfloat16 and mapped.dtype == torch.float32 and off > 0.005, "vmap now rounds as the layer does"
PY
