#!/usr/bin/env bash
# One would guess: torch's compiler is imported by who calls `torch.compile`.
# What happens: the constructor of any optimiser imports all of `torch._dynamo`, because its methods are wrapped to keep
# the compiler away.
# For this field: every training process on a small machine takes 70 to 140 MB and a second more, compiled or not.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" << 'PY'
import sys

import torch

print("torch", torch.__version__)


def resident():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) / 1024


before, loaded = resident(), "torch._dynamo" in sys.modules
torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
grown, compiler = resident() - before, "torch._dynamo" in sys.modules
print("torch._dynamo imported before:", loaded, "after making an optimiser:", compiler, f"({grown:.0f} MiB more)")
assert not loaded and compiler and grown > 30, "an optimiser no longer imports the compiler"
PY
