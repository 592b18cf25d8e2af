"""ACRO: agent-controller representations (Islam et al. 2022, arXiv 2211.00164): memoryless multi-step inverse.

    P(a_t | e(o_t), e(o_{t+k})),   k in 1..K

Authors' code: github.com/manantomar/agent-centric-representations (V-D4RL's DrQ+BC with a pretraining stage).

Differences:
- All pairs of a window are scored at once; the published code draws one k in 1..14 for each transition.
- The head's output is linear, theirs goes through a tanh; weights begin as PyTorch's do, theirs are orthogonal.
- The action target is a choice (K-means codes by default, as in the navigation lineage); `mse_l2` is the published one.
- The head's first layer is a sum of terms for e(o_t), e(o_{t+k}) and k; the published MLP (512-256-256) has no k unless
  asked for it.
- `--history gru` gives it the memory that sequence methods have, to ask what memory alone buys.
"""

from __future__ import annotations

from dataclasses import dataclass

from vd4rl_pomdp.nn.objective import InverseOptions, StateInverse


@dataclass(frozen=True)
class ACROOptions(InverseOptions):
    """Options of `acro`."""

    shift_shared: bool = False
    """Whether the observations of a window share one random shift, as in the other inverse models here; the authors
    shift each by itself."""


class ACRO(StateInverse):
    """Multi-step inverse model on states of an encoder without memory."""
