"""FJ and FJ+A: forward-jump inverse models on states of a bounded past (Wu et al. 2024, section 3.1, Table 1).

    FJ     P(a_t | f(o_{t-m}..o_t), f(o_{t+k-m}..o_{t+k})),   k in 1..K
    FJ+A   the same with the actions inside each window: a_{t-m}..a_{t-1} and a_{t+k-m}..a_{t+k-1}

Each state is computed anew, from zero, over its own m+1 rows. A window's first row carries no earlier action. For
k <= m the later window of FJ+A contains a_t: the paper's counterexample rests on that. For k > m both windows show what
MIK+A sees at the gap k-m with a past and a future of m rows, but for a_{t+k}, which that future reads, too.

Authors' code: not published.

Differences and readings:
- Frames are encoded once; windows are gathered from the features (m+1 GRU steps for each row, no convolutions).
- Windows are cut short at the first row of a batch's window, where nothing earlier is known.
- The kept encoder reads its last m+1 rows in evaluation, too: it never saw a longer past.
"""

from __future__ import annotations

from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.objective import ActionOptions, StateInverse


class ForwardJump(StateInverse):
    """FJ (a GRU over m+1 observations) and FJ+A (that reads actions, too)."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: ActionOptions, seed: int) -> None:
        super().__init__(encoder, target, options, seed)
        assert encoder.config.history_window > 0, "a forward jump needs a bounded past"
