"""ACRO: agent-controller representations (Islam et al. 2022, arXiv 2211.00164): memoryless multi-step inverse.

    P(a_t | e(o_t), e(o_{t+k})),   k in 1..K

Authors' code: github.com/manantomar/acro (V-D4RL's DrQ+BC with a pretraining stage).

Differences:
- All pairs of a window are scored at once; the published code draws one k in 1..14 for each transition.
- The action target is a choice (K-means codes by default, as in the navigation lineage); `mse_l2` is the published one.
- The head's first layer is a sum of terms for e(o_t), e(o_{t+k}) and k; the published MLP (512-256-256) has no k.
- `--history gru` gives it the memory that sequence methods have, to ask what memory alone buys.
"""

from __future__ import annotations

from torch import Tensor

from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.objective import InverseConfig, InverseObjective
from vd4rl_pomdp.types import Windows


class ACRO(InverseObjective):
    """Multi-step inverse model on the encoder's own representations of rows t and t+k."""

    def __init__(self, encoder: Encoder, target: ActionTarget, config: InverseConfig) -> None:
        super().__init__(encoder, encoder.dim, target, config)

    def representations(self, window: Windows) -> tuple[Tensor, Tensor]:
        """The same representations (B, T, D) for both ends of a pair."""
        states = self.encoder.encode(window)
        return states, states

    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """Rows t and t+k alone; with a GRU everything up to t+k, and its actions if it reads them."""
        if self.encoder.config.history == "none":
            return {t, t + k}, set()
        return set(range(t + k + 1)), set(range(t + k)) if self.encoder.config.use_actions else set()
