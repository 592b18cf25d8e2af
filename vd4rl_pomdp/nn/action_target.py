"""Action targets: four losses for predicting an action, behind one interface."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vd4rl_pomdp.core.errors import UserError, refuse_unknown
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import stream_seed


class ActionTarget(Protocol):
    """Loss between the action head's outputs and the true actions."""

    outputs: int
    """Output size that the head needs."""

    def loss(self, logits: Tensor, action: Tensor) -> Tensor:
        """(..., outputs) and (..., A) -> (...,) losses, in nats or squared action units."""


class KMeansTarget(nn.Module):
    """Cross-entropy on the nearest of `codes` K-means centres of the training actions (the default)."""

    def __init__(self, actions: np.ndarray, codes: int, seed: int) -> None:
        super().__init__()
        self.outputs = codes
        self.register_buffer("centers", torch.from_numpy(_fit_centers(actions, codes, seed)))
        self.centers: Tensor

    def loss(self, logits: Tensor, action: Tensor) -> Tensor:
        code = torch.cdist(action.reshape(-1, action.shape[-1]), self.centers).argmin(-1)
        loss = F.cross_entropy(logits.reshape(-1, self.outputs).float(), code, reduction="none")
        return loss.view(action.shape[:-1])


class BinsTarget(nn.Module):
    """Cross-entropy over `bins` equal bins of [-1, 1] per action dimension, averaged over dimensions."""

    def __init__(self, action_dim: int, bins: int) -> None:
        super().__init__()
        self.bins = bins
        self.outputs = action_dim * bins

    def loss(self, logits: Tensor, action: Tensor) -> Tensor:
        code = ((action.clamp(-1, 1) + 1) / 2 * self.bins).long().clamp_(max=self.bins - 1)
        loss = F.cross_entropy(logits.reshape(-1, self.bins).float(), code.reshape(-1), reduction="none")
        return loss.view(action.shape).mean(-1)


class MSETarget(nn.Module):
    """Squared error on the action, or on the L2-normalised action and prediction (ACRO's published code)."""

    def __init__(self, action_dim: int, normalise: bool) -> None:
        super().__init__()
        self.outputs = action_dim
        self.normalise = normalise

    def loss(self, logits: Tensor, action: Tensor) -> Tensor:
        if self.normalise:
            logits, action = F.normalize(logits.float(), dim=-1), F.normalize(action, dim=-1)
        return (logits.float() - action).square().mean(-1)


ACTION_TARGETS = ("kmeans", "bins", "mse", "mse_l2")


@dataclass(frozen=True)
class CodeOptions(Options):
    """Options of the discrete targets, kmeans and bins."""

    codes: int = 20
    """Number of K-means codes, or of bins per action dimension."""

    limits: ClassVar[Limits] = {"codes": 1}


def target_options(name: str) -> type[Options]:
    """Options class of a target; UserError with the choices for an unknown name."""
    refuse_unknown("action target", name, ACTION_TARGETS)
    return CodeOptions if name in ("kmeans", "bins") else Options


def make_action_target(name: str, actions: np.ndarray, codes: int, seed: int) -> KMeansTarget | BinsTarget | MSETarget:
    """Build an action target; K-means is fitted to `actions`, the (N, A) float32 training actions."""
    if name == "kmeans":
        return KMeansTarget(actions, codes, seed)
    if name == "bins":
        return BinsTarget(actions.shape[1], codes)
    return MSETarget(actions.shape[1], normalise=name == "mse_l2")


def _fit_centers(actions: np.ndarray, codes: int, seed: int) -> np.ndarray:
    """Fit K-means centres, (codes, A) float32, to at most 50,000 of the actions."""
    distinct = len(np.unique(actions, axis=0))
    if distinct < codes:
        raise UserError(f"the dataset has {distinct} distinct actions, fewer than --codes {codes}: lower --codes")
    rng = np.random.default_rng(stream_seed(seed, "kmeans", "sample"))
    sample = actions if len(actions) <= 50_000 else actions[rng.choice(len(actions), 50_000, replace=False)]
    start = stream_seed(seed, "kmeans", "centres") % 2**32  # scikit-learn accepts 32-bit seeds only
    # Run as a script, it imports neither this package nor the caller's main module; a new session keeps Ctrl-C from it.
    program = [sys.executable, "-P", str(Path(__file__).with_name("codebook.py")), str(codes), str(start)]
    content = sample.astype(np.float64)
    if "sklearn" not in sys.modules:
        with suppress(OSError, subprocess.SubprocessError):  # killed, or sklearn not importable there: fit in-process
            fitted = subprocess.run(
                [*program, str(sample.shape[1])],
                input=content.tobytes(),
                capture_output=True,
                start_new_session=True,
                check=True,
            )
            return np.frombuffer(fitted.stdout).reshape(codes, -1).astype(np.float32)
    from vd4rl_pomdp.nn.codebook import fit_centers

    return fit_centers(content, codes, start).astype(np.float32)
