#!/usr/bin/env bash
# One would guess: initialising the weights of ten critics as one (10, in, out) tensor gives each of them the scale that
# it would have by itself.
# What happens: both libraries read three axes as a convolution. torch counts out x in inputs per unit, so each critic's
# weights are 16 times too small for a width of 256 (sqrt(out)); jax counts 10 x in, so they are 3.2 times too small
# (sqrt(10)). Orthogonal members are not orthogonal: their largest singular values are about 0.12 (torch) and 0.6 (jax).
# For this field: an ensemble of critics starts nearer to zero than single critics of the same code, so its members,
# whose disagreement is what it is for, differ less. Initialise them one by one (`jax.vmap`, or a loop over the first
# axis).
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet jax==0.10.2 "torch>=2.11,<2.14" numpy==2.4.6
JAX_PLATFORMS=cpu "$tmp/venv/bin/python" -W ignore - << 'PY'
import math

import jax
import numpy as np
import torch

print("torch", torch.__version__, "jax", jax.__version__)
members, width, key, scale, radius = 10, 256, jax.random.key(0), {}, {}
torch.manual_seed(0)
one, stack = torch.empty(width, width), torch.empty(members, width, width)
for name, make in {"kaiming": torch.nn.init.kaiming_normal_, "xavier": torch.nn.init.xavier_normal_}.items():
    scale["torch " + name] = float(make(one).std() / make(stack).std())
for name, make in {"lecun": jax.nn.initializers.lecun_normal(), "xavier": jax.nn.initializers.xavier_normal()}.items():
    scale["jax " + name] = float(make(key, (width, width)).std() / make(key, (members, width, width)).std())
for name, ratio in scale.items():
    print(f"{name}: a stacked member's weights are {ratio:.1f} times smaller than those of a single network")
radius["torch"] = float(torch.linalg.svdvals(torch.nn.init.orthogonal_(stack))[:, 0].mean())
radius["jax"] = float(np.linalg.svd(jax.nn.initializers.orthogonal()(key, stack.shape), compute_uv=False)[:, 0].mean())
print("orthogonal: a stacked member's largest singular value", {name: round(x, 2) for name, x in radius.items()})
assert abs(scale["torch kaiming"] - math.sqrt(width)) < 0.5 and scale["torch xavier"] > 10, "torch minds members"
assert abs(scale["jax lecun"] - math.sqrt(members)) < 0.1 and scale["jax xavier"] > 3, "jax minds members"
assert radius["torch"] < 0.2 and radius["jax"] < 0.8, "members are orthogonal"
PY
