"""Config of the pretraining stage and its presets, and the base config that it shares with maze training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from pretrain.objectives import METHODS, Method
from vd4rl_pomdp.core.errors import MAX_SEED, OR_ONES_OWN, UserError, flag_of, refuse_outside, refuse_unknown
from vd4rl_pomdp.core.hardware import Precision
from vd4rl_pomdp.core.options import NO_OPTIONS, Limits, Options, StageConfig
from vd4rl_pomdp.core.tasks import FRAME_SIZES
from vd4rl_pomdp.core.types import WINDOW
from vd4rl_pomdp.corruptions import NO_CORRUPTION, CorruptionConfig
from vd4rl_pomdp.nn.frame import FRAME_ENCODERS, STATE
from vd4rl_pomdp.nn.memory import MEMORIES
from vd4rl_pomdp.nn.objective import ActionOptions
from vd4rl_pomdp.runs.metrics import WandbMode


@dataclass(frozen=True)
class HiddenOptions(Options):
    """Options of `--frame-encoder state`, which reads standardised simulator states instead of pixels."""

    hidden_share: float = 0.0
    """Probability of hiding each state coordinate, resampled at every row (0.3 hides 30%)."""

    limits: ClassVar[Limits] = {"hidden_share": (0, 1)}


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(StageConfig):
    """Settings shared by everything that trains an objective."""

    data: Path = Path()
    """Dataset folder."""
    out: Path = Path()
    """Run folder; re-run the same command to resume."""
    method: str = "mik+a"
    """Method to train; `vd4rl-pomdp list` shows all."""
    seed: int = 0
    """Random seed of networks, batches, corruption and exogenous noise."""
    steps: int = 50_000
    """Gradient steps."""
    batch_size: int = 16
    """Windows per batch."""
    window: int = WINDOW
    """Rows per window."""
    learning_rate: float = 3e-4
    """Adam learning rate."""
    frame_encoder: str = "drq"
    """Frame encoder: drq, nature (much cheaper), nature_half (nature at half resolution), small or mixer.
    Or pretrained (a frozen image model), or state, which reads the simulator state instead of pixels."""
    precision: Precision = "fp32"
    """Precision of matrix products: fp32, tf32 (on a GPU), or bf16 autocast."""
    device: str = "auto"
    """auto, cpu or cuda."""
    log_every: int = 50
    """Log the mean of the metrics every this many steps."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    wandb: WandbMode = "off"
    """Log metrics to wandb: off, offline or online."""
    tensorboard: bool = False
    """Log metrics to TensorBoard, in OUT/tensorboard."""
    options: Annotated[Options, tyro.conf.arg(name="method")] = NO_OPTIONS
    """Options of the chosen method."""
    memory: Options = NO_OPTIONS
    """Options of the encoder's memory, if it has one."""
    frame: Annotated[Options, tyro.conf.arg(name="frame-encoder")] = NO_OPTIONS
    """Options of the chosen frame encoder."""

    choosers: ClassVar[tuple[str, ...]] = ("method", "frame_encoder", "action_target")

    def check(self) -> None:
        super().check()
        refuse_outside(
            self, seed=(0, MAX_SEED), steps=0, batch_size=1, window=2, learning_rate=0, log_every=1, checkpoint_every=1
        )
        if (gap := getattr(self.options, "max_k", 0)) >= self.window:
            raise UserError(f"--max-k {gap} needs windows of more than that many rows: raise --window or lower it")


@dataclass(frozen=True, kw_only=True)
class PretrainConfig(TrainingConfig):
    """Pretrain an encoder. Which flags exist depends on --method, --corruption, --frame-encoder, --action-target and
    --history: put these before --help to see the flags of your choice."""

    task: str = ""
    """Task of the dataset; needed only if neither its shards nor its folder name state it."""
    shift: int = 4
    """Largest random shift in pixels; the method decides whether a window or each observation is shifted as one."""
    history: str = "method"
    """Memory of the encoder, such as gru; method uses the method's default."""
    corruption: CorruptionConfig = NO_CORRUPTION
    """Corruption that makes the observations partial."""

    choosers: ClassVar[tuple[str, ...]] = (*TrainingConfig.choosers, "history", "corruption")
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {},
        "cpu": {"steps": 3_000, "batch_size": 8, "frame_encoder": "nature", "precision": "bf16"},
        "smoke": {
            "steps": 20,
            "batch_size": 2,
            "window": 8,
            "max_k": 3,
            "frame_encoder": "nature",
            "feature_dim": 32,
            "hidden_dim": 32,
            "head_dim": 32,
            "codes": 4,
            "log_every": 5,
            "checkpoint_every": 10,
        },
    }
    """`paper`: the paper's settings. `cpu`: sized for two cores. `smoke`: a test run of a few seconds."""

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        method = METHODS.named(values["method"])
        return {
            "options": method.options.fill(values),
            "memory": memory_options(history_of(values["method"], method, values["history"]), values),
            "frame": HiddenOptions.fill(values) if values["frame_encoder"] == STATE else frame_options(method, values),
            "corruption": CorruptionConfig.fill(values),
        }

    def check(self) -> None:
        super().check()
        method = METHODS.named(self.method)
        refuse_outside(self, shift=(0, FRAME_SIZES[1] - 1))
        usual = self.defaults(self.preset)
        own_shift = method.shift == "own" and not getattr(self.options, "shift_shared", False)
        for name in ("frame_encoder", "shift") if method.reads_state else ("shift",) if own_shift else ():
            if getattr(self, name) != usual[name]:
                raise UserError(f"{flag_of(name)} is not read by the method {self.method}: leave it out")
        if method.histories and getattr(self.memory, "m", None) is not None:
            raise UserError(f"--m is not for {self.method}, which trains on whole histories: leave it out")
        if self.batch_size < method.least_batch:
            why = f"{self.method} contrasts windows: give it {method.least_batch}"
            raise UserError(f"--batch-size is {self.batch_size}; {why}")
        if self.frame_encoder == STATE and not (isinstance(self.options, ActionOptions) or self.method == "random"):
            raise UserError(f"--frame-encoder state is for random and methods that predict actions, not {self.method}")


def history_of(name: str, method: Method, history: str) -> str:
    """Resolve --history to a memory's name or "none"; UserError if the method does not allow that memory."""
    if history == "method":
        return method.history
    if method.end_to_end or method.reads_state:
        raise UserError(f"{name} has no memory: --history {history} is for pretrained methods")
    if method.histories:
        raise UserError(f"{name} implies its memory: leave --history {history} out")
    if history not in MEMORIES.broken:
        refuse_unknown("--history", history, ("method", *MEMORIES), OR_ONES_OWN)
    return history


def memory_options(history: str, values: Mapping[str, Any]) -> Options:
    """Fill the options of the memory `history` from flag values; no options for "none"."""
    kind = Options if history == "none" else MEMORIES.named(history).options
    return kind.fill(values)


def frame_options(method: Method, values: Mapping[str, Any]) -> Options:
    """Fill the options of the chosen frame encoder from flag values; no options for a method that reads states."""
    kind = FRAME_ENCODERS.named(values["frame_encoder"]).options
    return Options() if method.reads_state else kind.fill(values)
