"""Base classes of pretraining objectives: `Objective`, and `InverseObjective` for methods that predict actions.

An objective owns an `Encoder` (the part that is kept) and any other modules it trains. It only computes the loss: no
optimiser, no logging, no environment. To write a method, subclass one of the two.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.options import NO_OPTIONS, Limits, Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget, target_options
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.heads import PairHead, all_pairs, mlp


class Objective(nn.Module, ABC):
    """Trains an encoder on windows. `Method.build` calls its constructor with (encoder, target, options, seed)."""

    encoder: Encoder

    @abstractmethod
    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of one batch.

        Args:
            window: a batch whose `obs` are already corrupted and augmented.
            progress: fraction of training done, 0 to 1, for schedules. In CUDA graphs it is a tensor: use tensor
                arithmetic, never `float(progress)` or `if`.

        Returns:
            A scalar to minimise, and detached scalars to log: `loss` itself and any other diagnostics.
        """

    def after_step(self) -> None:
        """Called after every optimiser step, for updates without gradients, such as momentum encoders."""


@dataclass(frozen=True)
class ActionOptions(Options):
    """Options of every objective that predicts actions."""

    action_target: str = "kmeans"
    """Target of the action head: kmeans, bins, mse or mse_l2."""
    target: Options = NO_OPTIONS
    """Options of the action target."""
    k_embedding: bool = True
    """Condition the action head on k, by an embedding."""
    head_dim: int = 256
    """Units in each of the action head's two hidden layers."""
    self_prediction: float = 0.0
    """Weight of ||sg(s_{t+k}) - g(s_t, k)||^2 / D for D-dimensional states; g is an MLP with 3 hidden layers of 512."""
    l2_states: float = 0.0
    """Weight of ||s_t||^2 / D for D-dimensional forward states; it decays linearly to zero over training."""

    limits: ClassVar[Limits] = {"head_dim": 1, "self_prediction": 0, "l2_states": 0}

    @property
    def largest_gap(self) -> int:
        """Largest gap K between the two states of a pair; every k in 1..K is trained."""
        return 1

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """Build the options from flag values, including those of the chosen action target."""
        kind = target_options(values.get("action_target", cls.action_target))
        return super().fill({**values, "target": kind.fill(values)})


@dataclass(frozen=True)
class InverseOptions(ActionOptions):
    """Options of multi-step inverse models."""

    max_k: int = 15
    """Largest gap K between the two states of a pair; every k in 1..K is trained."""

    limits: ClassVar[Limits] = {"max_k": 1}

    @property
    def largest_gap(self) -> int:
        return self.max_k


class InverseObjective(Objective):
    """Predicts a_t from a representation of the past at t and one of the future at t+k, for every k in 1..K."""

    def __init__(self, encoder: Encoder, future_dim: int, target: ActionTarget, options: ActionOptions) -> None:
        super().__init__()
        self.encoder = encoder
        self.options = options
        self.target = target
        self.head = PairHead(
            encoder.dim, future_dim, options.largest_gap, target.outputs, options.head_dim, options.k_embedding
        )
        self._pairs: dict[tuple[int, torch.device], tuple[Tensor, list[int]]] = {}
        self.predictor = mlp(encoder.dim + 1, 512, encoder.dim, layers=3) if options.self_prediction else None

    @abstractmethod
    def representations(self, window: Windows) -> tuple[Tensor, Tensor]:
        """Past (B, T, D) and future (B, T, D') representations of every row."""

    @abstractmethod
    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """Inputs that the prediction of a_t from the pair (t, t+k) depends on, in a window of `rows` rows.

        `nn.visibility` checks it against the computation.

        Returns:
            Indices j of the visible observations o_j, and of the visible actions a_j.
        """

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean action loss over all real (unpadded) pairs plus the optional terms; logs `loss_kNN`, the mean per k."""
        past, future = self.representations(window)
        return self.loss_of(past, future, window, progress)

    def loss_of(
        self, past: Tensor, future: Tensor, window: Windows, progress: float | Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """`loss` from precomputed `representations` of the window."""
        pairs, gaps = self._scored(window.obs.shape[1], past.device)
        losses = self.target.loss(self.head(past, future, pairs), window.action[:, pairs[:, 0]])
        real = window.real[:, pairs.sum(1)].to(losses)
        total = _mean_over(real, losses)
        sums = losses.new_zeros(2, self.options.largest_gap + 1)  # sum of losses, number of real pairs, per k in 0..K
        sums.index_add_(1, pairs[:, 1], torch.stack([(losses.detach() * real).sum(0), real.sum(0)]))
        means = sums[0] / sums[1].clamp(min=1)
        logs = {"action_loss": total.detach()} | {f"loss_k{k:02d}": means[k] for k in gaps}
        if self.predictor is not None:
            t, k = pairs.unbind(1)
            gap = (k / self.options.largest_gap).to(past).expand(past.shape[0], -1)[..., None]
            predicted = self.predictor(torch.cat([past[:, t], gap], dim=-1))
            term = _mean_over(real, (predicted - past[:, t + k].detach()).square().mean(-1))
            total, logs["self_prediction"] = total + self.options.self_prediction * term, term.detach()
        if self.options.l2_states:
            term = _mean_over(window.real, past.square().mean(-1))
            total, logs["l2_states"] = total + self.options.l2_states * (1 - progress) * term, term.detach()
        logs["loss"] = total.detach()
        return total, logs

    def pairs(self, rows: int) -> Tensor:
        """The (t, k) scored in a window of `rows` rows: (P, 2) int64 on the CPU; cached, do not modify."""
        return all_pairs(rows, self.options.largest_gap)

    def _scored(self, rows: int, device: torch.device) -> tuple[Tensor, list[int]]:
        """`pairs` on a device, and their sorted distinct k; cached, because CUDA graphs cannot copy from the host."""
        if (rows, device) not in self._pairs:
            pairs = self.pairs(rows)
            self._pairs[rows, device] = pairs.to(device), sorted(set(pairs[:, 1].tolist()))
        return self._pairs[rows, device]

    def action_logits(self, window: Windows) -> Tensor:
        """Action head outputs for every pair: (B, P, target.outputs)."""
        past, future = self.representations(window)
        return self.head(past, future, self._scored(window.obs.shape[1], past.device)[0])

    def visible_frames(self, t: int, k: int, rows: int) -> set[int]:
        """Like `visible`, as single frames: frame j is the newest of o_j. By default all frames of the visible stacks,
        for stacks of 3 and rows {0, 1}: {-2, -1, 0, 1}; negative ones precede the window."""
        return {j - older for j in self.visible(t, k, rows)[0] for older in range(self.encoder.frame_stack)}

    def past_visible(self, t: int) -> tuple[set[int], set[int]]:
        """Indices of the observations and actions that the encoder's state at row t depends on."""
        shape, memory = self.encoder.config, self.encoder.memory
        if memory is None:
            return {t}, set()
        window, reach = shape.history_window or t + 1, memory.reach or t + 1
        # a window's first row has no previous action; the first row within a memory's reach does
        actions = range(max(0, t + 1 - window, t - reach), t) if shape.use_actions else ()
        seen = range(max(0, t + 1 - window, t + 1 - reach), t + 1)
        return set(seen[:1] if memory.first_only else seen), set(actions)


class StateInverse(InverseObjective):
    """P(a_t | s_t, s_{t+k}) with both states from the same encoder.

    The encoder's memory makes the method: none gives ACRO, a GRU over the whole past AH, a GRU over m+1 rows FJ.
    """

    def __init__(self, encoder: Encoder, target: ActionTarget, options: ActionOptions, seed: int) -> None:
        super().__init__(encoder, encoder.dim, target, options)

    def representations(self, window: Windows) -> tuple[Tensor, Tensor]:
        """The encoder's states (B, T, D), used for both ends of a pair."""
        states = self.encoder.encode(window)
        return states, states

    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """Everything that the states at rows t and t+k depend on."""
        (observations, actions), (later, later_actions) = self.past_visible(t), self.past_visible(t + k)
        return observations | later, actions | later_actions


def _mean_over(real: Tensor, values: Tensor) -> Tensor:
    """Mean of (B, N) values where the bool or 0/1 mask `real` is set."""
    return (values * real).sum() / real.sum()
