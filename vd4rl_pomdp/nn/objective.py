"""The contract of a pretraining objective, and what every inverse model shares.

An objective owns an `Encoder` (the part that is kept) and whatever else it trains. Its loss is pure: no optimiser, no
logging, no environment. A method of one's own subclasses `Objective`, or `InverseObjective` if it predicts actions.
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
    """Trains an encoder on windows. A method makes it with (encoder, target, options, seed)."""

    encoder: Encoder

    @abstractmethod
    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of one batch.

        Args:
            window: a batch whose `obs` are already corrupted and augmented.
            progress: share of the training that is done, 0 to 1, for schedules; where steps are replayed a tensor, of
                which Python cannot read the value.

        Returns:
            A scalar to minimise, and detached scalars to log: itself as `loss`, and whatever else tells how it goes.
        """

    def after_step(self) -> None:
        """Called after every optimiser step: the place for what no gradient moves, such as momentum encoders."""


@dataclass(frozen=True)
class ActionOptions(Options):
    """Options of every objective that predicts actions."""

    action_target: str = "kmeans"
    """What the action head predicts: kmeans, bins, mse or mse_l2."""
    target: Options = NO_OPTIONS
    """Options of the action target."""
    k_embedding: bool = True
    """Whether the action head is told k."""
    head_dim: int = 256
    """Units of the action head's two hidden layers."""
    self_prediction: float = 0.0
    """Weight of ||sg(s_{t+k}) - g(s_t, k)||^2 / D for states of D numbers; g is an MLP with 3 hidden layers of 512."""
    l2_states: float = 0.0
    """Weight of ||s_t||^2 / D of forward states of D numbers; it decays linearly to zero over the training."""

    limits: ClassVar[Limits] = {"head_dim": 1, "self_prediction": 0, "l2_states": 0}

    @property
    def largest_gap(self) -> int:
        """K: every gap k in 1..K between the two states of a pair is trained."""
        return 1

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """Options with those of the action target that the values name."""
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
        """K."""
        return self.max_k


class InverseObjective(Objective):
    """Predicts a_t from a representation of the past at t and one of what is seen at t+k, for every k up to K."""

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
        """What the prediction of a_t from the pair (t, t+k) may depend on, in a window of `rows` rows.

        Returns:
            Observation rows j (of o_j) and action indices j (of a_j).
        """

    def visible_frames(self, t: int, k: int, rows: int) -> set[int]:
        """Single frames j (the newest of o_j) that it may depend on: all of the visible rows' stacks; -1 is the one
        before the window."""
        return {j - older for j in self.visible(t, k, rows)[0] for older in range(self.encoder.frame_stack)}

    def past_visible(self, t: int) -> tuple[set[int], set[int]]:
        """Observation rows and action indices that the encoder's state of row t depends on."""
        shape, memory = self.encoder.config, self.encoder.memory
        if memory is None:
            return {t}, set()
        window, reach = shape.history_window or t + 1, memory.reach or t + 1
        # the first row of a window carries no action before it, that of a memory's reach does
        actions = range(max(0, t + 1 - window, t - reach), t) if shape.use_actions else ()
        seen = range(max(0, t + 1 - window, t + 1 - reach), t + 1)
        return set(seen[:1] if memory.first_only else seen), set(actions)

    def pairs(self, rows: int) -> Tensor:
        """The (t, k) that are scored in a window of `rows` rows: (P, 2) int64 on the CPU, not to be changed."""
        return all_pairs(rows, self.options.largest_gap)

    def _scored(self, rows: int, device: torch.device) -> tuple[Tensor, list[int]]:
        """`pairs` on a device, and the k among them, in order; copied there once, as a replayed step copies nothing."""
        if (rows, device) not in self._pairs:
            pairs = self.pairs(rows)
            self._pairs[rows, device] = pairs.to(device), sorted(set(pairs[:, 1].tolist()))
        return self._pairs[rows, device]

    def action_logits(self, window: Windows) -> Tensor:
        """Predictions for every pair: (B, P, target.outputs)."""
        past, future = self.representations(window)
        return self.head(past, future, self._scored(window.obs.shape[1], past.device)[0])

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean action loss over all real pairs, plus the optional terms; `loss_kNN` is the mean at each k."""
        past, future = self.representations(window)
        return self.loss_of(past, future, window, progress)

    def loss_of(
        self, past: Tensor, future: Tensor, window: Windows, progress: float | Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """`loss`, given the `representations` of the window."""
        pairs, gaps = self._scored(window.obs.shape[1], past.device)
        losses = self.target.loss(self.head(past, future, pairs), window.action[:, pairs[:, 0]])
        real = window.real[:, pairs.sum(1)].to(losses)
        total = _mean_over(real, losses)
        sums = losses.new_zeros(2, self.options.largest_gap + 1)  # of losses and of real pairs at every k of 0..K
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


class StateInverse(InverseObjective):
    """Predicts a_t from the encoder's own states of rows t and t+k; what differs is the encoder's memory.

    P(a_t | s_t, s_{t+k}): memoryless states give ACRO, states of a GRU over the whole past AH, over m rows FJ.
    """

    def __init__(self, encoder: Encoder, target: ActionTarget, options: ActionOptions, seed: int) -> None:
        super().__init__(encoder, encoder.dim, target, options)

    def representations(self, window: Windows) -> tuple[Tensor, Tensor]:
        """The same states (B, T, D) for both ends of a pair."""
        states = self.encoder.encode(window)
        return states, states

    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """What the states of rows t and t+k depend on."""
        (observations, actions), (later, later_actions) = self.past_visible(t), self.past_visible(t + k)
        return observations | later, actions | later_actions


def _mean_over(real: Tensor, values: Tensor) -> Tensor:
    """Mean of (B, N) values over those that are real, by a mask of numbers or truths."""
    return (values * real).sum() / real.sum()
