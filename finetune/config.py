"""Settings of the fine-tuning stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vd4rl_pomdp.runs.device import Precision
from vd4rl_pomdp.runs.metrics import WandbMode


@dataclass(frozen=True, kw_only=True)
class FinetuneConfig:
    """Settings of `vd4rl-pomdp finetune`."""

    encoder: Path
    """Encoder folder, RUN/encoder of a pretraining run; it stays frozen. Its corruption is used here too."""
    data: Path
    """Folder of the data set."""
    out: Path
    """Run folder; the same command continues a run that was cut."""
    algorithm: str = "td3_bc"
    """td3_bc, drqv2_bc or bc; the references bc and drq_bc bring their own."""
    preset: str = "paper"
    """paper, cpu or smoke: the defaults of all other settings."""
    seed: int = 0
    """Seed of the networks, the views and the batches."""
    updates: int = 500_000
    """Gradient updates."""
    batch_size: int = 256
    """Transitions in a batch."""
    hidden_dim: int = 1024
    """Units of each of the two hidden layers of actor and critics."""
    learning_rate: float = 3e-4
    """Adam's learning rate."""
    gamma: float = 0.99
    """Discount of a decision."""
    n_step: int = 3
    """Steps of the n-step return."""
    alpha: float = 2.5
    """Weight of the critic against behaviour cloning (TD3+BC's alpha)."""
    views: int = 4
    """Draws of corruption and shift under which the set is encoded once; 0 encodes every batch anew."""
    shift: int = 4
    """Random shift in pixels, one for each episode and view."""
    precision: Precision = "fp32"
    """Precision of the frozen encoder: fp32, or bf16 autocast."""
    eval_every: int = 50_000
    """Updates between two evaluations; the last one is always evaluated."""
    eval_episodes: int = 10
    """Episodes of an evaluation."""
    eval_length: int = 500
    """Most decisions in an evaluation episode, which never has more than the task's; fewer only for trials."""
    workers: int = 0
    """Processes that evaluate; 0 uses every core."""
    device: str = "auto"
    """auto, cpu or cuda."""
    log_every: int = 500
    """Updates between two rows of metrics."""
    checkpoint_every: int = 5_000
    """Updates between two checkpoints."""
    wandb: WandbMode = "off"
    """Mirror metrics to wandb: off, offline or online."""


_UNSET = Path()
PRESETS = {
    "paper": FinetuneConfig(encoder=_UNSET, data=_UNSET, out=_UNSET),
    "cpu": FinetuneConfig(
        encoder=_UNSET,
        data=_UNSET,
        out=_UNSET,
        preset="cpu",
        updates=50_000,
        hidden_dim=256,
        precision="bf16",
        eval_every=25_000,
    ),
    "smoke": FinetuneConfig(
        encoder=_UNSET,
        data=_UNSET,
        out=_UNSET,
        preset="smoke",
        updates=40,
        batch_size=16,
        hidden_dim=32,
        views=1,
        eval_every=20,
        eval_episodes=1,
        eval_length=5,
        log_every=10,
        checkpoint_every=20,
    ),
}
"""Defaults by preset: `paper` is the full setting, `cpu` fits two cores, `smoke` shows in seconds that all works."""
