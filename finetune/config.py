"""Settings of the fine-tuning stage and its presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from finetune.algorithms import ALGORITHMS
from finetune.histories import HistoryOptions
from vd4rl_pomdp.core.errors import MAX_SEED, refuse_outside
from vd4rl_pomdp.core.options import NO_OPTIONS, Options, StageConfig, flat
from vd4rl_pomdp.core.tasks import FRAME_SIZES, MOST_EPISODES
from vd4rl_pomdp.runs.device import Precision
from vd4rl_pomdp.runs.metrics import WandbMode


@dataclass(frozen=True, kw_only=True)
class FinetuneConfig(StageConfig):
    """Settings of `vd4rl-pomdp finetune`. --algorithm decides which flags there are: name it before --help."""

    encoder: Path = Path()
    """Encoder folder, RUN/encoder of a pretraining run; it stays frozen but for the references bc and drq_bc. Its
    corruption is used here too."""
    data: Path = Path()
    """Folder of the data set."""
    out: Path = Path()
    """Run folder; re-run the same command to resume."""
    algorithm: str = "td3_bc"
    """Algorithm, `vd4rl-pomdp list` shows all; the references bc and drq_bc bring their own."""
    seed: int = 0
    """Seed of the networks, the batches and the noise, and of the views unless --view-seed is given. --seeds 0,1,2 in
    its place trains as many runs as one: OUT/seed0 and so on."""
    updates: int = 500_000
    """Gradient updates."""
    batch_size: int = 256
    """Transitions in a batch."""
    hidden_dim: int = 1024
    """Units of each of the two hidden layers of actor and critics."""
    learning_rate: float = 3e-4
    """Adam's learning rate."""
    views: int = 4
    """Draws of corruption and shift under which the set is encoded once; 0 encodes every batch anew."""
    view_seed: int | None = None
    """Seed of the views: their corruption, shifts and random histories. Runs that share it train on the same features;
    None: the run's own seed."""
    shift: int = 4
    """Random shift in pixels, one for each episode and view; for each transition with --views 0, for each observation
    where the encoder is trained."""
    precision: Precision = "fp32"
    """Precision of the encoder: fp32, tf32 (on a GPU), or bf16 autocast."""
    update_precision: Precision = "fp32"
    """Precision of the algorithm's matrix products: fp32, tf32 (on a GPU), or, but for last layers, bf16 autocast."""
    eval_every: int = 50_000
    """Updates between two evaluations; the last one is always evaluated."""
    eval_episodes: int = 10
    """Episodes of an evaluation."""
    eval_clean: bool = True
    """Play the last evaluation under no corruption, too, which takes as long again; it changes nothing else."""
    eval_clean_episodes: int = 0
    """Episodes of the last evaluation under no corruption; 0: as many as under the corruption."""
    eval_length: int = 500
    """Most decisions in an evaluation episode, which never has more than the task's; fewer only for trials. The default
    is all of them, of a task that has more, too."""
    workers: int = 0
    """Processes that evaluate; 0 uses every core."""
    device: str = "auto"
    """auto, cpu or cuda."""
    log_every: int = 500
    """Updates that a row of metrics averages over."""
    checkpoint_every: int = 5_000
    """Updates between two checkpoints."""
    wandb: WandbMode = "off"
    """Mirror metrics to wandb: off, offline or online."""
    tensorboard: bool = False
    """Mirror metrics to TensorBoard, in OUT/tensorboard."""
    options: Annotated[Options, tyro.conf.arg(name="algorithm")] = NO_OPTIONS
    """What the chosen algorithm can be told."""
    memory: Annotated[Options, tyro.conf.arg(name="memory")] = NO_OPTIONS
    """What of an encoder with a memory the policy is given."""

    @property
    def seed_of_views(self) -> int:
        """What the views are drawn from."""
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
    """`paper` is the full setting, `cpu` the budget that results/ladder chose for two cores, `smoke` shows in seconds
    that all works."""

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        """Options of the algorithm, and of the encoder's memory."""
        return {
            "options": ALGORITHMS.named(values["algorithm"]).options.fill(values),
            "memory": HistoryOptions.fill(values),
        }

    def check(self) -> None:
        """Refuse settings that cannot work, before anything is read or written."""
        super().check()
        refuse_outside(
            self, seed=(0, MAX_SEED), updates=1, batch_size=1, hidden_dim=1, learning_rate=0, views=0,
            view_seed=(0, MAX_SEED), shift=(0, FRAME_SIZES[1] - 1), eval_every=1, eval_episodes=(1, MOST_EPISODES),
            eval_clean_episodes=(0, MOST_EPISODES), eval_length=1, log_every=1, checkpoint_every=1, workers=0,
        )  # fmt: skip


def as_trained(config: FinetuneConfig, algorithm: str, remembers: bool, decisions: int) -> FinetuneConfig:
    """The settings as an encoder's policy is trained with them: what the encoder decides, and only what it reads.

    Args:
        config: the settings that were told.
        algorithm: the algorithm that the encoder's method brings along, if it has no frozen stage; else empty.
        remembers: whether the encoder has a memory.
        decisions: of an episode of the task; an evaluation of the default length is one of whole episodes.
    """
    if config.eval_length == FinetuneConfig.eval_length:
        config = replace(config, eval_length=max(config.eval_length, decisions))
    if algorithm:
        told = config.defaults(config.preset) | flat(config)
        options = ALGORITHMS.named(algorithm).options.fill(told)
        config = replace(config, algorithm=algorithm, options=options, views=0)
    return config if remembers and not algorithm else replace(config, memory=NO_OPTIONS)
