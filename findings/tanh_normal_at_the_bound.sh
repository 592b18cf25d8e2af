#!/usr/bin/env bash
# One would guess: libraries agree on the log-likelihood of an action under a tanh-squashed normal distribution, as they
# do in the middle of the range.
# What happens: at an action of exactly 1 torch and distrax return nan, torchrl -14.1 and stable-baselines3 -21.7 for
# the same distribution: each of the latter two moves the action inside by an epsilon of its own, and the true
# log-density falls to minus infinity there. Neither reports it.
# For this field: experts saturate, so their datasets are full of exact +-1. Behaviour cloning and advantage-weighted
# regression then weigh these actions by an epsilon, and a held-out likelihood is no number to compare.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" torchrl==0.14.1 stable-baselines3==2.9.2 gymnasium==1.4.0 \
    distrax==0.1.9 jax==0.10.2 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
import math
from importlib.metadata import version

import distrax
import torch
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torchrl.modules import TanhNormal

print(*(f"{name} {version(name)}" for name in ("torch", "torchrl", "stable-baselines3", "distrax")))
zero, one = torch.zeros(1), torch.ones(1)
plain = TransformedDistribution(Normal(zero, one), [TanhTransform()])
jaxes = distrax.Transformed(distrax.Normal(0.0, 1.0), distrax.Tanh())
sb3 = SquashedDiagGaussianDistribution(1).proba_distribution(zero[None], zero[None])
density = {
    "torch": lambda action: plain.log_prob(action).item(),
    "distrax": lambda action: float(jaxes.log_prob(action.item())),
    "torchrl": lambda action: TanhNormal(zero, one).log_prob(action).item(),
    "stable-baselines3": lambda action: sb3.log_prob(action[None]).item(),
}
found = {name: [log_prob(torch.tensor([action])) for action in (0.9, 1.0)] for name, log_prob in density.items()}
for name, (inside, bound) in found.items():
    print(f"{name:18} log-likelihood of 0.9: {inside:.3f}, of 1: {bound:.3f}")
inside, bound = zip(*found.values())
assert max(inside) - min(inside) < 1e-3
assert math.isnan(bound[0]) and math.isnan(bound[1]) and math.isfinite(bound[2]), "the bound is handled otherwise"
assert bound[2] - bound[3] > 5, "torchrl and stable-baselines3 agree"
PY
