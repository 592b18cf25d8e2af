"""Settings of `vd4rl-pomdp navigation train` and its presets."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from pretrain.config import PretrainConfig
from vd4rl_pomdp.navigation.observations import Picture
from vd4rl_pomdp.objective import InverseConfig
from vd4rl_pomdp.runs.device import Precision
from vd4rl_pomdp.runs.metrics import WandbMode


@dataclass(frozen=True, kw_only=True)
class NavigationConfig(InverseConfig):
    """Settings of `vd4rl-pomdp navigation train`."""

    data: Path
    """Folder of a maze's data."""
    out: Path
    """Run folder; the same command continues a run that was cut."""
    method: str = "mik+a"
    """no_history, ah, ah+a, fj, fj+a, mik, mik+a, another method that predicts actions, random (mik+a, untrained), or
    supervised and supervised+a (the networks of ah and ah+a, trained on the true states)."""
    preset: str = "paper"
    """paper, cpu or smoke: the defaults of all other settings."""
    seed: int = 0
    """Seed of the networks, the batches and the exogenous noise."""
    steps: int = 200_000
    """Gradient steps."""
    average_last: int = 10_000
    """Last steps over which the reported training metrics are averaged."""
    batch_size: int = 16
    """Windows in a batch."""
    window: int = 64
    """Rows of a window."""
    learning_rate: float = 1e-4
    """Adam's learning rate, the probe's included."""
    schedule: Literal["constant", "cosine"] = "constant"
    """Learning rate after the warm-up: constant, or a half cosine down to zero."""
    warm_up: int = 0
    """Steps in which the learning rate rises linearly."""
    picture: Picture = "rgb100"
    """rgb100: pictures as stored; grey50: their luminance, averaged over 2x2 pixels."""
    exogenous: str = "none"
    """Images added to every picture: none, photographs, or a folder of CIFAR-10's files or of PNG and JPEG files."""
    exogenous_weight: float = 0.5
    """What the added images are multiplied by."""
    frame_encoder: str = "mixer"
    """Frame encoder: mixer (MLP-Mixer), small, nature or drq."""
    feature_dim: int = 256
    """Width of the frame encoder's output."""
    hidden_dim: int = 256
    """Units of each GRU layer."""
    gru_layers: int = 2
    """Layers of each GRU."""
    m: int | None = None
    """Rows before t that a state is computed from; None: what the method has (fj and fj+a 8, the others all)."""
    n: int | None = None
    """mik and mik+a: rows after t+k that the future encoder reads; None: all to the window's end."""
    literal_future: bool = False
    """mik+a only: give the future encoder a_{t+k-1}, as the paper's formula reads literally (a leak at k = 1)."""
    action_target: str = "kmeans"
    """What the action head predicts: kmeans, bins, mse or mse_l2."""
    codes: int = 20
    """K-means codes, or bins for each action dimension."""
    burn_in: int = 10
    """First rows of a window on which no state error is counted."""
    evaluation_windows: int = 256
    """Held-out windows to evaluate on."""
    refit_windows: int = 1024
    """Training windows whose frozen states the probe is refitted on."""
    refit_steps: int = 4_000
    """Gradient steps of that probe."""
    precision: Precision = "fp32"
    """fp32, or bf16 autocast."""
    device: str = "auto"
    """auto, cpu or cuda."""
    log_every: int = 100
    """Steps that a row of metrics averages over."""
    checkpoint_every: int = 1_000
    """Steps between two checkpoints."""
    wandb: WandbMode = "off"
    """Mirror metrics to wandb: off, offline or online."""

    def objective_config(self, method: str) -> PretrainConfig:
        """The same settings as those of an objective of `pretrain`."""
        shared = {f.name: getattr(self, f.name) for f in fields(PretrainConfig) if hasattr(self, f.name)}
        return PretrainConfig(**(shared | {"method": method}))


_UNSET = Path()
_CPU: dict[str, Any] = {
    "data": _UNSET,
    "out": _UNSET,
    "steps": 2_500,
    "average_last": 200,
    "window": 40,
    "learning_rate": 2e-3,
    "schedule": "cosine",
    "warm_up": 100,
    "picture": "grey50",
    "frame_encoder": "small",
    "feature_dim": 128,
    "hidden_dim": 128,
    "gru_layers": 1,
    "precision": "bf16",
    "log_every": 50,
    "checkpoint_every": 250,
}
_SMOKE: dict[str, Any] = {
    "steps": 30,
    "average_last": 10,
    "batch_size": 4,
    "window": 16,
    "max_k": 3,
    "warm_up": 5,
    "feature_dim": 32,
    "hidden_dim": 32,
    "head_dim": 32,
    "codes": 6,
    "burn_in": 4,
    "evaluation_windows": 8,
    "refit_windows": 16,
    "refit_steps": 50,
    "log_every": 5,
    "checkpoint_every": 10,
}
PRESETS = {
    "paper": NavigationConfig(data=_UNSET, out=_UNSET, l2_states=1e-3),
    "cpu": NavigationConfig(**_CPU, preset="cpu"),
    "smoke": NavigationConfig(**(_CPU | _SMOKE), preset="smoke"),
}
"""Defaults by preset: the paper's setting for a GPU, one for two cores, and one that takes seconds."""


def command_of(config: NavigationConfig) -> list[str]:
    """Words of the command that trains with a config: the preset, and every flag that differs from it."""
    words = ["vd4rl-pomdp", "navigation", "train", "--preset", config.preset]
    for field in fields(config):
        value, default = getattr(config, field.name), getattr(PRESETS[config.preset], field.name)
        flag = field.name.replace("_", "-")
        if value == default or field.name in ("preset", "device", "wandb"):
            continue
        words += [f"--{'' if value else 'no-'}{flag}"] if isinstance(value, bool) else [f"--{flag}", str(value)]
    return words
