"""Settings of the fine-tuning stage and its presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from finetune.algorithms import ALGORITHMS
from finetune.histories import HistoryOptions
from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_outside
from vd4rl_pomdp.core.hardware import Precision
from vd4rl_pomdp.core.options import NO_OPTIONS, Options, StageConfig, flat
from vd4rl_pomdp.core.tasks import FRAME_SIZES, MOST_EPISODES, TASKS
from vd4rl_pomdp.runs.metrics import WandbMode


@dataclass(frozen=True, kw_only=True)
class FinetuneConfig(StageConfig):
    """Train a policy on a frozen encoder. Some flags depend on --algorithm: put it before --help."""

    encoder: Path = Path()
    """Encoder folder, `RUN/encoder` of a pretraining run. Training and evaluation use its corruption.
    The encoder stays frozen, except with bc and drq_bc, which train it end to end."""
    data: Path = Path()
    """Dataset folder."""
    out: Path = Path()
    """Run folder; re-run the same command to resume."""
    algorithm: str = "td3_bc"
    """Algorithm; `vd4rl-pomdp list` shows all of them. Encoders of bc and drq_bc use their own algorithm instead."""
    seed: int = 0
    """Seed of the networks, batches and noise, and of the views unless --view-seed is given.
    Instead, --seeds 0,1,2 trains several runs in one process, in OUT/seed0, OUT/seed1, ..."""
    updates: int = 500_000
    """Gradient updates."""
    batch_size: int = 256
    """Transitions in a batch."""
    hidden_dim: int = 1024
    """Units of each of the two hidden layers of actor and critics."""
    learning_rate: float = 3e-4
    """Adam's learning rate."""
    views: int = 4
    """Number of times the dataset is encoded up front, each with its own draw of corruption and random shift.
    If 0, every batch is encoded on the fly."""
    view_seed: int | None = None
    """Seed of the views: their corruption, shifts and random histories. None: use --seed.
    Runs with the same view seed train on the same features."""
    shift: int = 4
    """Maximum random shift in pixels, drawn once per episode and view.
    With --views 0 it is drawn per transition; when the encoder is trained, per observation."""
    precision: Precision = "fp32"
    """Encoder precision: fp32, tf32 (GPU only) or bf16 autocast."""
    update_precision: Precision = "fp32"
    """Precision of the algorithm's matrix products: fp32, tf32 (GPU only), or bf16 autocast except in last layers.
    On a GPU this, not --precision, decides whether encoders that run during the updates use tf32."""
    eval_every: int = 50_000
    """Updates between evaluations; the final update is always evaluated."""
    eval_episodes: int = 10
    """Episodes per evaluation; 0: train only, as on data whose task has no environment here."""
    eval_clean: bool = True
    """Also run the final evaluation without corruption. It doubles that evaluation's time and changes nothing else."""
    eval_clean_episodes: int = 0
    """Episodes of the uncorrupted final evaluation; 0: same as --eval-episodes."""
    eval_length: int = 500
    """Maximum decisions per evaluation episode, at most the task's own. Lower it only for quick tests.
    The default always means full episodes, even for tasks with more than 500 decisions."""
    workers: int = 0
    """Evaluation processes; 0: one per core."""
    device: str = "auto"
    """auto, cpu or cuda."""
    log_every: int = 500
    """Updates averaged into one row of metrics."""
    checkpoint_every: int = 5_000
    """Updates between checkpoints."""
    wandb: WandbMode = "off"
    """Mirror metrics to wandb: off, offline or online."""
    tensorboard: bool = False
    """Mirror metrics to TensorBoard, in OUT/tensorboard."""
    options: Annotated[Options, tyro.conf.arg(name="algorithm")] = NO_OPTIONS
    """Options of the chosen algorithm."""
    memory: Annotated[Options, tyro.conf.arg(name="memory")] = NO_OPTIONS
    """For an encoder with memory: which features the policy gets."""

    @property
    def seed_of_views(self) -> int:
        return self.seed if self.view_seed is None else self.view_seed

    choosers: ClassVar[tuple[str, ...]] = ("algorithm",)
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"update_precision": "tf32"},
        "cpu": {
            "updates": 60_000,
            "hidden_dim": 256,
            "views": 16,
            "precision": "bf16",
            "update_precision": "bf16",
            "eval_every": 60_000,
        },
        "smoke": {
            "updates": 40,
            "batch_size": 16,
            "hidden_dim": 32,
            "views": 1,
            "eval_every": 20,
            "eval_episodes": 1,
            "eval_length": 5,
            "log_every": 10,
            "checkpoint_every": 20,
        },
    }
    """`paper` is the full setting; `cpu` the budget chosen in results/ladder for two cores; `smoke` checks in seconds
    that everything runs."""

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        return {
            "options": ALGORITHMS.named(values["algorithm"]).options.fill(values),
            "memory": HistoryOptions.fill(values),
        }

    def check(self) -> None:
        super().check()
        refuse_outside(
            self, seed=(0, MAX_SEED), updates=1, batch_size=1, hidden_dim=1, learning_rate=0, views=0,
            view_seed=(0, MAX_SEED), shift=(0, FRAME_SIZES[1] - 1), eval_every=1, eval_episodes=(0, MOST_EPISODES),
            eval_clean_episodes=(0, MOST_EPISODES), eval_length=1, log_every=1, checkpoint_every=1, workers=0,
        )  # fmt: skip


def as_trained(config: FinetuneConfig, algorithm: str, remembers: bool, task: str) -> FinetuneConfig:
    """Settings that training actually uses, after the encoder has overridden or disabled some of them.

    Args:
        config: the settings as given.
        algorithm: of an end-to-end method, such as bc; empty if the encoder is frozen.
        remembers: whether the encoder has memory.
        task: its name; the default `eval_length` is raised to the decisions in one of its episodes.

    Raises:
        UserError: the task is unknown, but its episodes are to be played.
    """
    try:
        decisions = TASKS.named(task).decisions if config.eval_episodes else 0
    except UserError as error:
        raise UserError(f"{error}; `--eval-episodes 0` trains a policy without evaluating it") from error
    if config.eval_length == FinetuneConfig.eval_length:
        config = replace(config, eval_length=max(config.eval_length, decisions))
    if algorithm:
        options = ALGORITHMS.named(algorithm).options.fill(config.defaults(config.preset) | flat(config))
        config = replace(config, algorithm=algorithm, options=options, views=0)
    return config if remembers and not algorithm else replace(config, memory=NO_OPTIONS)
