#!/usr/bin/env bash
# One would guess: torchmetrics' `R2Score` is scikit-learn's `r2_score` for data that comes in batches.
# What happens: it sums float32 squares and subtracts the squared mean at the end. Where the mean is a thousand times
# the standard deviation, no digit is left: 0.75 becomes 0.03 or 1.03. `ExplainedVariance` is no better. With float64
# rows and `set_dtype(torch.float64)` both are right.
# For this field: a probe's score is wrong, without a warning, for the position of an agent far from the origin, for a
# time and for an angle that never wraps. Standardise targets first.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" torchmetrics==1.9.0 scikit-learn==1.9.1 numpy==2.4.6
OMP_NUM_THREADS=1 "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import torch
from sklearn.metrics import r2_score
from torchmetrics import ExplainedVariance, R2Score

print("torchmetrics", version("torchmetrics"), "torch", torch.__version__)
worst = {torch.float32: 0.0, torch.float64: 0.0}
draw = torch.Generator().manual_seed(0)
noise = torch.randn(2, 100_000, generator=draw)
for mean in (0, 10, 100, 300, 1000):
    target = mean + 0.1 * noise[0]
    predicted = target + 0.05 * noise[1]
    truth = r2_score(target.numpy(), predicted.numpy())
    line = [f"mean {mean:4}, standard deviation 0.1: scikit-learn {truth:.3f}"]
    for dtype in worst:
        metrics = [metric().set_dtype(dtype) for metric in (R2Score, ExplainedVariance)]
        for rows in zip(predicted.to(dtype).split(500), target.to(dtype).split(500)):
            for metric in metrics:
                metric.update(*rows)
        got = [metric.compute().item() for metric in metrics]
        worst[dtype] = max(worst[dtype], abs(got[0] - truth))
        line.append(f"{str(dtype)[6:]}: R2 {got[0]:.3f}, explained variance {got[1]:.3f}")
    print("; ".join(line))
assert worst[torch.float32] > 0.1, "float32 is as good"
assert worst[torch.float64] < 0.01, "float64 is no better"
PY
