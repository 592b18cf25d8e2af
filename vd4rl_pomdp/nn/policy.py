"""Policy on frozen representations: standardise, MLP, tanh. It is saved as a self-contained folder."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save
from torch import Tensor, nn
from torch.random import fork_rng

from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.reading import damaged, read_bytes, read_tensors, safetensors_metadata
from vd4rl_pomdp.nn.heads import ExactLinear, mlp
from vd4rl_pomdp.runs.files import read_json, write_bytes, write_json

_WEIGHTS, _SHAPE = "model.safetensors", "config.json"
_NO_POLICY = "not a policy folder", "`vd4rl-pomdp finetune` writes one as RUN/policy"
_STEP = "step"
"""Metadata key for the training step in the weights file."""


class Standardise(nn.Module):
    """Per dimension, subtract the training features' mean and divide by their standard deviation + 1e-3."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))
        self.mean: Tensor
        self.std: Tensor

    def fit(self, features: Tensor) -> None:
        """Compute the statistics of (..., dim) features, in chunks to save memory."""
        flat = features.view(-1, features.shape[-1])
        total = squares = torch.zeros_like(self.mean, dtype=torch.float64)
        for part in flat.split(65_536):
            # Float32 sums over a whole data set are too inexact for small standard deviations.
            values = part.double()
            total, squares = total + values.sum(0), squares + values.square().sum(0)
        mean = total / len(flat)
        self.mean.copy_(mean)
        self.std.copy_((squares / len(flat) - mean.square()).clamp(min=0).sqrt() + 1e-3)

    def forward(self, z: Tensor) -> Tensor:
        return (z.float() - self.mean) / self.std


class Policy(nn.Module):
    """Deterministic policy: (B, D) representations -> (B, A) actions in [-1, 1]."""

    def __init__(self, dim: int, action_dim: int, hidden: int) -> None:
        super().__init__()
        self.shape = {"dim": dim, "action_dim": action_dim, "hidden": hidden}
        self.standardise = Standardise(dim)
        self.net = mlp(dim, hidden, action_dim, last=ExactLinear)

    def forward(self, z: Tensor) -> Tensor:
        return self.from_standardised(self.standardise(z))

    def from_standardised(self, z: Tensor) -> Tensor:
        return torch.tanh(self.net(z))

    def save(self, folder: Path | str, step: int | None = None) -> None:
        """Write the policy folder; if given, the training step `step` is stored with the weights."""
        folder = Path(folder)
        weights = {k: v.contiguous().cpu() for k, v in self.state_dict().items()}
        write_bytes(folder / _WEIGHTS, save(weights, None if step is None else {_STEP: str(step)}))
        write_json(folder / _SHAPE, self.shape)


def load_policy(folder: Path | str) -> Policy:
    """Read a policy folder; raises UserError if it is missing or damaged."""
    folder = Path(folder)
    try:
        shape, weights = read_json(folder / _SHAPE), read_tensors(folder / _WEIGHTS)
        with torch.device("meta"):  # without memory, of which a few digits in its config.json may take any amount
            Policy(**shape).load_state_dict(weights, assign=True)
        with fork_rng(devices=[]):  # the random initial weights are overwritten: keep the caller's RNG state
            policy = Policy(**shape)
        policy.load_state_dict(weights)
    except (FileNotFoundError, SafetensorError, RuntimeError, TypeError) as error:
        raise UserError(f"{folder}: {_NO_POLICY[0]} ({first_line(error)}); {_NO_POLICY[1]}") from error
    return policy.eval().requires_grad_(False)


def policy_step(folder: Path) -> int | None:
    """Training step stored with a policy folder's weights, None if there is none; UserError as `load_policy`."""
    with damaged(folder, *_NO_POLICY):
        step = safetensors_metadata(read_bytes(folder / _WEIGHTS)).get(_STEP)
        return None if step is None else int(step)
