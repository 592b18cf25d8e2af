#!/usr/bin/env bash
# One would guess: `TensorDict.load_memmap` reads a dataset; what is then computed in place stays in memory, as after
# `torch.load`, or is refused, as by numpy's `mmap_mode="r"`.
# What happens: the tensors are mapped for writing and the tensordict is not locked. `mul_` or `-=` on a loaded tensor,
# or on a slice of it, changes the files, without `save`: three runs of a program that multiplies by 10 and adds 0.5
# to the first two rows read 1, then 10.5, then 105.5 there.
# For this field: rewards scaled or states normalised in place are scaled again in each run, so the second seed trains
# on another dataset than the first; torchrl's replay buffers and its datasets on disk use these files. Clone first.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" tensordict==0.15.3 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - "$tmp" << 'PY'
import subprocess
import sys
from importlib.metadata import version

import torch
from tensordict import TensorDict

print("tensordict", version("tensordict"), "torch", torch.__version__)
folder = sys.argv[1] + "/dataset"
TensorDict({"reward": torch.ones(4), "pixels": torch.zeros(4, 3, 84, 84, dtype=torch.uint8)}, [4]).memmap(folder)
training = f"""
from tensordict import TensorDict
data = TensorDict.load_memmap({folder!r})
print("reads", data["reward"].tolist())
data["reward"].mul_(10)
data[:2]["reward"].add_(0.5)
"""
found = [subprocess.run([sys.executable, "-W", "ignore", "-c", training], check=True, capture_output=True, text=True)
         .stdout.strip() for _ in range(3)]
for number, line in enumerate(found, 1):
    print(f"process {number} {line}")
assert found[0] == "reads [1.0, 1.0, 1.0, 1.0]" and found[1] == "reads [10.5, 10.5, 10.0, 10.0]", "files are kept"
PY
