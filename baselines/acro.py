"""ACRO: agent-controller representations (Islam et al. 2022, arXiv 2211.00164): a memoryless multi-step inverse model.

    P(a_t | e(o_t), e(o_{t+k})),   k in 1..K

Authors' code: github.com/manantomar/agent-centric-representations (V-D4RL's DrQ+BC with a pretraining stage).

Differences:
- All pairs of a window are scored at once; the published code samples one k in 1..14 per transition.
- The head's output is linear, theirs has a tanh; weights use PyTorch's initialisation, theirs are orthogonal.
- The action target is configurable (K-means codes by default); `mse_l2` is the published one.
- The head's first layer sums terms for e(o_t), e(o_{t+k}) and k; the published MLP (512-256-256) reads k only as an
  option.
- `--history gru` adds the memory of the sequence methods, to measure what memory alone contributes.
"""

from __future__ import annotations

from dataclasses import dataclass

from vd4rl_pomdp.nn.objective import InverseOptions, StateInverse


@dataclass(frozen=True)
class ACROOptions(InverseOptions):
    """Options of `acro`."""

    shift_shared: bool = False
    """Use one random shift for all observations of a window, as the other inverse models here do.
    The authors shift each observation independently."""


class ACRO(StateInverse):
    """Multi-step inverse model on memoryless states."""
