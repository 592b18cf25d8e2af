#!/usr/bin/env bash
# One would guess: `torch.set_float32_matmul_precision("medium")` trades accuracy for speed, and float32 products are
# otherwise as fast as the processor allows.
# What happens, on AMD processors with AVX-512: by default MKL computes them, at half of what the processor can do.
# "medium" permits bfloat16 and thereby selects oneDNN, which finds no use for bfloat16 here and rounds nothing: about
# twice as fast, at the accuracy of float32.
# For this field: many cloud machines have such processors. A float32 comparison of PyTorch with JAX there mostly measures
# MKL. On other processors "medium" may round.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
OMP_NUM_THREADS=1 "$tmp/venv/bin/python" - << 'PY'
import sys
import time
from pathlib import Path

import torch

about = Path("/proc/cpuinfo").read_text()
if "AuthenticAMD" not in about or "avx512f" not in about:
    print("skipped, nothing seen: needs an AMD processor with AVX-512")
    sys.exit(77)
print("torch", torch.__version__)
torch.manual_seed(0)
x, weight = torch.randn(256, 1024), torch.randn(1024, 1024)
exact = x.double() @ weight.double().T
found = {}
for precision in ("highest", "medium"):
    torch.set_float32_matmul_precision(precision)
    error = float((torch.nn.functional.linear(x, weight) - exact).norm() / exact.norm())
    seconds = []
    for _ in range(200):
        start = time.perf_counter()
        torch.nn.functional.linear(x, weight)
        seconds.append(time.perf_counter() - start)
    found[precision] = 2 * 256 * 1024**2 / min(seconds) / 1e9, error
    print(f"{precision}: {found[precision][0]:.0f} GFLOP/s, relative error {error:.1e}")
assert found["medium"][0] > 1.4 * found["highest"][0], "the default is as fast"
assert found["medium"][1] < 1e-6, "products are rounded"
PY
