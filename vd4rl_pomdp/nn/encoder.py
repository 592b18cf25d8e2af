"""The encoder: a frame encoder and, for sequence methods, a memory of the past.

`encode` (whole windows, for training) and `step` (one row at a time, for acting) agree to float tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from vd4rl_pomdp.core.errors import UserError, refuse_unknown
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.frame import STATE, FrameEncoder, StateFrame, make_frame_encoder
from vd4rl_pomdp.nn.memory import Memory, make_memory, run_memory

Readout = Literal["state", "frame", "frame+state"]
"""Representation of an encoder with a memory: s_t, e(o_t), or both concatenated."""


@dataclass(frozen=True)
class EncoderConfig:
    """Everything needed to rebuild an encoder."""

    action_dim: int
    frame_encoder: str = "drq"
    feature_dim: int = 256
    history: str = "none"
    """Name of the memory that computes s_t from rows 0..t; "none": s_t = e(o_t)."""
    use_actions: bool = False
    """Whether the memory also reads a_{t-1} at row t."""
    hidden_dim: int = 256
    history_window: int = 0
    """Number of most recent rows that s_t is computed from, including row t; 0: all since the episode's start."""
    readout: Readout = "state"
    """The representation that is returned; values other than "state" are set only after pretraining."""
    channels: int = 3 * FRAME_STACK
    """Channels of an observation."""
    size: int = FRAME_SIZE
    """Height and width of an observation."""
    frame_options: dict[str, Any] = field(default_factory=dict)
    """Other options of the frame encoder, by name."""
    memory_options: dict[str, Any] = field(default_factory=dict)
    """Other options of the memory, by name."""

    @property
    def dim(self) -> int:
        widths = {"frame": self.feature_dim, "state": self.hidden_dim}
        return widths["frame"] if self.history == "none" else sum(widths[part] for part in self.readout.split("+"))


@dataclass(frozen=True)
class EncoderCard:
    """How an encoder was pretrained."""

    method: str
    task: str
    quality: str
    corruption: dict[str, Any]
    """The corruption of its pretraining, as CorruptionConfig fields."""
    seed: int
    steps: int
    preset: str
    end_to_end: str = ""
    """Fine-tuning algorithm that also trains the encoder; empty for a frozen encoder."""
    action_loss: float | None = None
    """For methods that predict actions: mean action loss over the last tenth of the logged metric rows.

    Each row is the mean over the steps since the previous row; all rows have equal weight.
    """
    data: str = ""
    """Fingerprint of the pretraining data set."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Pretraining config without seed, folders, device and logging; empty if not recorded."""


@dataclass(frozen=True)
class EncoderRecord:
    """Contents of an encoder folder's config.json.

    `encoder`, `pretrain` and the weights identify an encoder (`encoder_hash`); the other fields are informational.
    """

    encoder: EncoderConfig
    pretrain: EncoderCard
    version: str
    """Version (and commit, below) of the package that wrote it."""
    commit: str
    frames: int | None = None
    """Number of frames in all pretraining batches; None: not recorded."""
    probe: dict[str, float] = field(default_factory=dict)
    """Linear probe errors from `nn.probes.probe_state`; empty if no probe was fitted."""
    plugins: dict[str, str] = field(default_factory=dict)
    """Origin of the parts that come from other packages; see `registry.code_of`."""
    sources: dict[str, str] = field(default_factory=dict)
    """Source files of these parts; see `registry.code_of`."""

    @property
    def parts(self) -> dict[str, str]:
        """Names of the registered parts it was made with, keyed by setting, such as {"method": "mik+a", ...}."""
        card = self.pretrain
        named = {"method": card.method, "task": card.task, "corruption": card.corruption["corruption"]}
        return named | {"frame_encoder": self.encoder.frame_encoder, "history": self.encoder.history}


class StreamState(NamedTuple):
    """State of an encoder between calls of `step`."""

    hidden: Tensor
    """(L, B, W) memory state; empty for memoryless encoders, unused with a history window."""
    rows: Tensor
    """(B, up to history_window, F + A): the memory's most recent inputs with a history window, else empty."""


class Encoder(nn.Module):
    """Maps observations and past actions to the representation s_t of dimension `dim`."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        refuse_unknown("readout", config.readout, get_args(Readout))
        if config.frame_encoder == STATE:
            config = self.config = replace(config, feature_dim=config.channels)
            self.frame: FrameEncoder | StateFrame = StateFrame(config.channels, **config.frame_options)
        else:
            options = {"feature_dim": config.feature_dim} | config.frame_options
            self.frame = frame = make_frame_encoder(config.frame_encoder, config.channels, config.size, options)
            self.config = config = replace(config, frame_options=config.frame_options | frame.found)
        if config.history == "none":
            return
        if config.history in {*dir(type(self)), *dir(self)}:  # not `hasattr`, which would evaluate properties
            raise UserError(f"memory {config.history!r}: an encoder has an attribute of this name: choose another")
        self.add_module(config.history, self.make_memory(self._row_width))

    @property
    def memory(self) -> Memory | None:
        """The memory, None for "none"; its weights are named after it, such as `gru.weight_ih_l0`."""
        return None if self.config.history == "none" else getattr(self, self.config.history)

    @property
    def _row_width(self) -> int:
        return self.config.feature_dim + (self.config.action_dim if self.config.use_actions else 0)

    def make_memory(self, inputs: int) -> Memory:
        """New memory of the same kind and options for rows of width `inputs`, such as MIK's backward memory."""
        options = {"hidden_dim": self.config.hidden_dim} | self.config.memory_options
        return make_memory(self.config.history, inputs, options, self.config.feature_dim)

    @property
    def dim(self) -> int:
        return self.config.dim

    @property
    def remembers(self) -> bool:
        """Whether the representation depends on earlier rows."""
        return self.memory is not None and self.config.readout != "frame"

    @property
    def reads_state(self) -> bool:
        """Whether observations are simulator states (B, P, 1, 1) instead of pixels."""
        return self.config.frame_encoder == STATE

    @property
    def frame_stack(self) -> int:
        """Number of frames in an observation; 1 if its channels are not RGB frames."""
        return 1 if self.reads_state or self.config.channels % 3 else self.config.channels // 3

    def encode(self, window: Windows) -> Tensor:
        """Representations of every row: (B, T, C, H, W) uint8 -> (B, T, dim); UserError for another image shape."""
        self._refuse_other(window.obs, "B", "T")
        whole = self.config.readout == "state" and not self.config.history_window
        if self.memory is not None and self.memory.first_only and whole:
            # only the first row's features are read: skip the frame encoder, most of a step's cost, on the others
            features = pad(self.frame(window.obs[:, :1]), (0, 0, 0, window.obs.shape[1] - 1))
        else:
            features = self.frame(window.obs)
        return self.from_features(features, window.prev_action)

    def from_features(self, features: Tensor, prev_action: Tensor) -> Tensor:
        """Representations from (B, T, F) frame features and (B, T, A) previous actions."""
        if not self.remembers:
            return features
        assert self.memory is not None
        rows, span = self._rows(features, prev_action), self.config.history_window
        if span == 0 or rows.shape[1] <= span:
            return self._read(features, run_memory(self.memory, rows)[0])
        first = run_memory(self.memory, rows[:, :span])[0]
        # Every later state is computed from the initial state over the last `span` rows, its own row included.
        recent = rows.unfold(1, span, 1)[:, 1:].transpose(2, 3)  # (B, T - span, span, I)
        later = run_memory(self.memory, self._forget_first_action(recent.flatten(0, 1)))[0][:, -1]
        return self._read(features, torch.cat([first, later.view(*recent.shape[:2], -1)], dim=1))

    def initial_state(self, batch: int) -> StreamState:
        weight = next(self.parameters())
        if self.memory is None:
            return StreamState(weight.new_zeros(0), weight.new_zeros(0))
        return StreamState(self.memory.initial_state(batch), weight.new_zeros(batch, 0, self._row_width))

    def step(self, obs: Tensor, prev_action: Tensor, state: StreamState) -> tuple[Tensor, StreamState]:
        """Advance by one row: (B, C, H, W) uint8, (B, A) -> (B, dim) and the next state; errors as in `encode`.

        `prev_action` is zero at an episode's first row.
        """
        self._refuse_other(obs, "B")
        features = self.frame(obs)
        if not self.remembers:
            return features, state
        assert self.memory is not None
        row = self._rows(features[:, None], prev_action[:, None])
        span = self.config.history_window
        if span == 0:
            out, hidden = run_memory(self.memory, row, state.hidden)
            return self._read(features, out[:, 0]), state._replace(hidden=hidden)
        # With a history window no hidden state is kept: it would remember rows that have left the window.
        rows = torch.cat([state.rows, row], dim=1)[:, -span:]
        newest = run_memory(self.memory, self._forget_first_action(rows))[0][:, -1]
        return self._read(features, newest), state._replace(rows=rows)

    def _refuse_other(self, obs: Tensor, *leading: str) -> None:
        """Raise UserError for observations (`leading`, C, H, W) of another shape than this encoder's."""
        size = 1 if self.reads_state else self.config.size
        own = (self.config.channels, size, size)
        if obs.dim() != len(leading) + 3:
            raise UserError(
                f"this encoder reads observations of shape ({', '.join([*leading, *map(str, own)])}) here, not "
                f"{tuple(obs.shape)}: add or remove leading dimensions"
            )
        if not self.reads_state and obs.shape[-3:] != own:
            raise UserError(
                f"this encoder reads observations of shape {own}, not {tuple(obs.shape[-3:])}: use frames "
                "of its size and stack, or pretrain an encoder on these"
            )

    def _read(self, features: Tensor, states: Tensor) -> Tensor:
        return torch.cat([features, states], dim=-1) if self.config.readout == "frame+state" else states

    def _rows(self, features: Tensor, prev_action: Tensor) -> Tensor:
        return torch.cat([features, prev_action.to(features)], dim=-1) if self.config.use_actions else features

    def _forget_first_action(self, rows: Tensor) -> Tensor:
        """Zero the previous action in a window's first row, as it precedes the window."""
        if not self.config.use_actions:
            return rows
        rows = rows.clone()
        rows[:, 0, self.config.feature_dim :] = 0
        return rows
