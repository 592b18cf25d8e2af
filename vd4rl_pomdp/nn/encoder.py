"""The representation that is kept: a frame encoder and, for sequence methods, a memory of the past.

`encode` (whole windows) and `step` (one row at a time, as the environment delivers them) agree to float tolerance.
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
"""What of an encoder with a memory its representation is: s_t, e(o_t), or both one after the other."""


@dataclass(frozen=True)
class EncoderConfig:
    """Everything needed to rebuild an encoder."""

    action_dim: int
    frame_encoder: str = "drq"
    feature_dim: int = 256
    history: str = "none"
    """Name of the memory that makes s_t of rows 0..t; none: s_t = e(o_t)."""
    use_actions: bool = False
    """Whether the memory also reads a_{t-1} in row t."""
    hidden_dim: int = 256
    history_window: int = 0
    """Rows the state is computed from, 0 for all since the episode's start."""
    readout: Readout = "state"
    """What the representation is; other than s_t only after pretraining."""
    channels: int = 3 * FRAME_STACK
    """Channels of an observation."""
    size: int = FRAME_SIZE
    """Height and width of an observation."""
    frame_options: dict[str, Any] = field(default_factory=dict)
    """What else the frame encoder was told, by name."""
    memory_options: dict[str, Any] = field(default_factory=dict)
    """What else the memory was told, by name."""

    @property
    def dim(self) -> int:
        """Width of the representation."""
        widths = {"frame": self.feature_dim, "state": self.hidden_dim}
        return widths["frame"] if self.history == "none" else sum(widths[part] for part in self.readout.split("+"))


@dataclass(frozen=True)
class EncoderCard:
    """Where an encoder comes from."""

    method: str
    task: str
    quality: str
    corruption: dict[str, Any]
    """The corruption it was pretrained under, as the settings of CorruptionConfig."""
    seed: int
    steps: int
    preset: str
    end_to_end: str = ""
    """Fine-tuning algorithm that trains the encoder, too; empty for a frozen encoder."""
    action_loss: float | None = None
    """For methods that predict actions: the mean of the last tenth of the pretraining's rows of metrics.

    Each row is the mean over the steps since the row before; all count the same, also where they are of fewer steps.
    """
    data: str = ""
    """Fingerprint of the set it was pretrained on."""
    settings: dict[str, Any] = field(default_factory=dict)
    """The pretraining's settings without seed, folders, device and logging; empty if they were not recorded."""


@dataclass(frozen=True)
class EncoderRecord:
    """An encoder folder's config.json: what the encoder is and where it comes from.

    `encoder` and `pretrain` name it, with its weights; the same encoder may have other values of all else.
    """

    encoder: EncoderConfig
    pretrain: EncoderCard
    version: str
    """Version and commit of this package that wrote it."""
    commit: str
    frames: int | None = None
    """Frames that the pretraining's batches held; None: not recorded."""
    probe: dict[str, float] = field(default_factory=dict)
    """Errors of linear probes, as `vd4rl_pomdp.nn.probes.probe_state` gives them; empty if none was fitted."""
    plugins: dict[str, str] = field(default_factory=dict)
    """Where parts come from that are not this package's, as `registry.code_of` tells."""
    sources: dict[str, str] = field(default_factory=dict)
    """Their files, as `registry.code_of` tells."""

    @property
    def parts(self) -> dict[str, str]:
        """Names of the parts that made it, by the registries' `setting`."""
        card = self.pretrain
        named = {"method": card.method, "task": card.task, "corruption": card.corruption["corruption"]}
        return named | {"frame_encoder": self.encoder.frame_encoder, "history": self.encoder.history}


class StreamState(NamedTuple):
    """What an encoder remembers between rows."""

    hidden: Tensor
    """(L, B, W); empty for memoryless encoders, and not read under a history window."""
    rows: Tensor
    """(B, L', F + A): the memory's last inputs under a history window, else empty."""


class Encoder(nn.Module):
    """Maps observations and past actions to the representation s_t of width `dim`."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        refuse_unknown("readout", config.readout, get_args(Readout))
        if config.frame_encoder == STATE:
            config = self.config = replace(config, feature_dim=config.channels)
            self.frame: FrameEncoder | StateFrame = StateFrame(config.channels, **config.frame_options)
        else:
            told = {"feature_dim": config.feature_dim} | config.frame_options
            self.frame = frame = make_frame_encoder(config.frame_encoder, config.channels, config.size, told)
            self.config = config = replace(config, frame_options=config.frame_options | frame.found)
        if config.history == "none":
            return
        if hasattr(self, config.history):
            raise UserError(f"memory {config.history!r}: an encoder has something of this name: choose another")
        self.add_module(config.history, self.make_memory(self._row_width))

    @property
    def memory(self) -> Memory | None:
        """What makes s_t of the rows up to t; its weights are called after it."""
        return None if self.config.history == "none" else getattr(self, self.config.history)

    @property
    def _row_width(self) -> int:
        """Width of what the memory reads at a row."""
        return self.config.feature_dim + (self.config.action_dim if self.config.use_actions else 0)

    def make_memory(self, inputs: int) -> Memory:
        """Another memory of the encoder's kind and options for rows of width `inputs`, such as one of the future."""
        told = {"hidden_dim": self.config.hidden_dim} | self.config.memory_options
        return make_memory(self.config.history, inputs, told, self.config.feature_dim)

    @property
    def dim(self) -> int:
        """Width of the representation."""
        return self.config.dim

    @property
    def remembers(self) -> bool:
        """Whether the representation depends on rows before."""
        return self.memory is not None and self.config.readout != "frame"

    @property
    def reads_state(self) -> bool:
        """Whether observations are simulator states (B, P, 1, 1) in place of pixels."""
        return self.config.frame_encoder == STATE

    @property
    def frame_stack(self) -> int:
        """Frames of an observation; 1 where its channels are not three a frame."""
        return 1 if self.reads_state or self.config.channels % 3 else self.config.channels // 3

    def encode(self, window: Windows) -> Tensor:
        """Representations of every row: (B, T, C, H, W) uint8 -> (B, T, dim); raises UserError for other pictures."""
        self._refuse_other(window.obs)
        whole = self.config.readout == "state" and not self.config.history_window
        if self.memory is not None and self.memory.first_only and whole:
            # the frame encoder's work on rows that are not read would be most of a step's
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
        # Every later state is computed anew from the last `span` rows, the row itself among them.
        recent = rows.unfold(1, span, 1)[:, 1:].transpose(2, 3)  # (B, T - span, span, I)
        later = run_memory(self.memory, self._forget_first_action(recent.flatten(0, 1)))[0][:, -1]
        return self._read(features, torch.cat([first, later.view(*recent.shape[:2], -1)], dim=1))

    def initial_state(self, batch: int) -> StreamState:
        """State before an episode's first row."""
        weight = next(self.parameters())
        hidden, rows = weight.new_zeros(0), weight.new_zeros(0)
        if self.memory is not None:
            hidden = self.memory.initial_state(batch)
            rows = weight.new_zeros(batch, 0, self._row_width)
        return StreamState(hidden, rows)

    def step(self, obs: Tensor, prev_action: Tensor, state: StreamState) -> tuple[Tensor, StreamState]:
        """Advance by one row.

        Args:
            obs: (B, C, H, W) uint8.
            prev_action: (B, A) float32, zeros at an episode's first row.
            state: from `initial_state` or the previous call.

        Returns:
            (B, dim) representation, and the state for the next row.

        Raises:
            UserError: pictures of another shape than it was built for.
        """
        self._refuse_other(obs)
        features = self.frame(obs)
        if not self.remembers:
            return features, state
        assert self.memory is not None
        row = self._rows(features[:, None], prev_action[:, None])
        span = self.config.history_window
        if span == 0:
            out, hidden = run_memory(self.memory, row, state.hidden)
            return self._read(features, out[:, 0]), state._replace(hidden=hidden)
        # Under a window no hidden state is carried on: it would remember rows that have left the window.
        rows = torch.cat([state.rows, row], dim=1)[:, -span:]
        newest = run_memory(self.memory, self._forget_first_action(rows))[0][:, -1]
        return self._read(features, newest), state._replace(rows=rows)

    def _refuse_other(self, obs: Tensor) -> None:
        """Raise UserError for observations (..., C, H, W) of another shape than this encoder's."""
        own = (self.config.channels, self.config.size, self.config.size)
        if not self.reads_state and obs.shape[-3:] != own:
            raise UserError(
                f"this encoder reads observations of shape {own}, and these are of {tuple(obs.shape[-3:])}: use frames "
                "of its size and stack, or pretrain an encoder on these"
            )

    def _read(self, features: Tensor, states: Tensor) -> Tensor:
        """The representation, given e(o_t) (..., F) and s_t (..., H)."""
        return torch.cat([features, states], dim=-1) if self.config.readout == "frame+state" else states

    def _rows(self, features: Tensor, prev_action: Tensor) -> Tensor:
        return torch.cat([features, prev_action.to(features)], dim=-1) if self.config.use_actions else features

    def _forget_first_action(self, rows: Tensor) -> Tensor:
        """A window's first row carries no earlier action."""
        if not self.config.use_actions:
            return rows
        rows = rows.clone()
        rows[:, 0, self.config.feature_dim :] = 0
        return rows
