#!/usr/bin/env bash
# One would guess: `torch.nn.init.orthogonal_` on a GRU's recurrent weights makes each gate's matrix orthogonal, as in
# flax.
# What happens: torch stores the three gates as one (3H, H) matrix and makes its columns orthonormal as a whole. Each
# gate's matrix is not orthogonal: its mean square is a third of flax's (an LSTM's a quarter), and its smallest singular
# value is near 0.
# For this field: recurrent agents written with either library are said to have "orthogonal initialisation, gain 1", and
# start with different memories. Apply it to each of `weight.chunk(3)`.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet flax==0.12.8 jax==0.10.2 "torch>=2.11,<2.14" numpy==2.4.6
JAX_PLATFORMS=cpu "$tmp/venv/bin/python" -W ignore - << 'PY'
import flax
import jax
import numpy as np
import torch

print("flax", flax.__version__, "torch", torch.__version__)
size, found = 128, {}
torch.manual_seed(0)
for kind, gates in (("GRU", 3), ("LSTM", 4)):
    weight = getattr(torch.nn, kind)(size, size).weight_hh_l0
    torch.nn.init.orthogonal_(weight)
    found[f"torch {kind}, whole"] = weight.detach().numpy()[:size].copy()
    for part in weight.data.chunk(gates):
        torch.nn.init.orthogonal_(part)
    found[f"torch {kind}, by gate"] = weight.detach().numpy()[:size].copy()
    cell = getattr(flax.linen, kind + "Cell")(size)
    x = np.zeros((1, size), np.float32)
    carry = cell.initialize_carry(jax.random.key(0), x.shape)
    gate = {"GRU": "hn", "LSTM": "hg"}[kind]
    found[f"flax {kind}"] = np.asarray(cell.init(jax.random.key(0), carry, x)["params"][gate]["kernel"])
scale = {}
for name, gate in found.items():
    values = np.linalg.svd(gate, compute_uv=False)
    scale[name] = float((gate**2).sum() / size)
    print(f"{name:20} mean squared singular value {scale[name]:.2f}, range {values[-1]:.2f} to {values[0]:.2f}")
assert all(abs(value - 1) < 1e-3 for name, value in scale.items() if "whole" not in name)
assert scale["torch GRU, whole"] < 0.4 and scale["torch LSTM, whole"] < 0.3, "gates are orthogonal"
PY
