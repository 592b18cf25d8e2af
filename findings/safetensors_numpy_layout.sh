#!/usr/bin/env bash
# One would guess: safetensors.numpy stores the array that one sees, or refuses it, as safetensors.torch does.
# What happens: it writes the bytes of the underlying buffer in memory order. A transposed array or a slice of columns
# is loaded back with the right shape and wrong values, and nothing is raised; safetensors.torch raises a ValueError.
# For this field: weights move between layouts (Flax's kernels are transposed for torch), and `array.T` is how. Save
# `np.ascontiguousarray(array)`.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" safetensors==0.8.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import sys
from importlib.metadata import version

import numpy as np
import torch
from safetensors import numpy as for_numpy
from safetensors import torch as for_torch

print("safetensors", version("safetensors"), "numpy", np.__version__, "torch", torch.__version__)
kernel = np.arange(6.0).reshape(2, 3)
path, right = sys.argv[1] + "/file.safetensors", {}
for name, array in (("kernel", kernel), ("kernel.T", kernel.T), ("kernel[:, 1:]", kernel[:, 1:])):
    for_numpy.save_file({"w": array}, path)
    loaded = for_numpy.load_file(path)["w"]
    right[name] = bool((loaded == array).all())
    try:
        for_torch.save_file({"w": torch.from_numpy(array)}, path)
        by_torch = "saved"
    except ValueError as error:
        by_torch = f"{type(error).__name__}: {str(error)[:50]}..."
    print(f"{name}: {array.tolist()} is loaded as {loaded.tolist()}; safetensors.torch: {by_torch}")
assert right == {"kernel": True, "kernel.T": False, "kernel[:, 1:]": False}, "layouts are respected"
assert by_torch.startswith("ValueError")
PY
