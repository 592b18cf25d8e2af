"""Settings of the pretraining stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.objective import InverseConfig
from vd4rl_pomdp.runs.device import Precision
from vd4rl_pomdp.runs.metrics import WandbMode


@dataclass(frozen=True, kw_only=True)
class PretrainConfig(CorruptionConfig, InverseConfig):
    """Settings of `vd4rl-pomdp pretrain`."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Run folder; the same command continues a run that was cut."""
    method: str = "mik+a"
    """Objective to train; see the documentation for the list."""
    preset: str = "paper"
    """paper, cpu or smoke: the defaults of all other settings."""
    task: str = ""
    """The set's task, where neither its shards nor its folder's name tell."""
    seed: int = 0
    """Seed of the networks, the batches and the corruption."""
    steps: int = 50_000
    """Gradient steps."""
    batch_size: int = 16
    """Windows in a batch."""
    window: int = 32
    """Rows of a window."""
    learning_rate: float = 3e-4
    """Adam's learning rate."""
    shift: int = 4
    """Random shift in pixels, one for each window."""
    frame_encoder: str = "drq"
    """Frame encoder: drq, or nature at a fraction of the cost."""
    feature_dim: int = 256
    """Width of the frame encoder's output."""
    history: Literal["method", "none", "gru"] = "method"
    """Memory of the encoder: what the method has, none, or a GRU over the past (also for memoryless baselines)."""
    hidden_dim: int = 256
    """Units of the GRU."""
    gru_layers: int = 1
    """Layers of the GRU."""
    m: int | None = None
    """Rows before t that a state is computed from; None: what the method has (fj and fj+a 8, the others all)."""
    n: int | None = None
    """mik and mik+a: rows after t+k that the future encoder reads; None: all to the window's end."""
    history_window: int = 0
    """After pretraining, compute states from the last this many rows; 0: as in training."""
    literal_future: bool = False
    """mik+a only: give the future encoder a_{t+k-1}, as the paper's formula reads literally (a leak at k = 1)."""
    action_target: str = "kmeans"
    """What the action head predicts: kmeans, bins, mse or mse_l2."""
    codes: int = 20
    """K-means codes, or bins for each action dimension."""
    homer_codes: int = 0
    """homer only: codes of its discrete bottleneck; 0 for none."""
    precision: Precision = "fp32"
    """fp32, or bf16 autocast."""
    device: str = "auto"
    """auto, cpu or cuda."""
    log_every: int = 50
    """Steps between two rows of metrics."""
    checkpoint_every: int = 500
    """Steps between two checkpoints."""
    wandb: WandbMode = "off"
    """Mirror metrics to wandb: off, offline or online."""


_UNSET = Path()
PRESETS = {
    "paper": PretrainConfig(data=_UNSET, out=_UNSET),
    "cpu": PretrainConfig(
        data=_UNSET, out=_UNSET, preset="cpu", steps=3_000, batch_size=8, frame_encoder="nature", precision="bf16"
    ),
    "smoke": PretrainConfig(
        data=_UNSET,
        out=_UNSET,
        preset="smoke",
        steps=20,
        batch_size=2,
        window=8,
        max_k=3,
        frame_encoder="nature",
        feature_dim=32,
        hidden_dim=32,
        head_dim=32,
        codes=4,
        log_every=5,
        checkpoint_every=10,
    ),
}
"""Defaults by preset: `paper` is the full setting, `cpu` fits two cores, `smoke` shows in seconds that all works."""
