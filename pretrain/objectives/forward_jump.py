"""FJ and FJ+A: forward-jump inverse models, whose states see a bounded past (Wu et al. 2024, section 3.1, Table 1).

    FJ     P(a_t | f(o_{t-m}..o_t), f(o_{t+k-m}..o_{t+k})),   k in 1..K
    FJ+A   also reads the actions inside each window: a_{t-m}..a_{t-1} and a_{t+k-m}..a_{t+k-1}

Each state is computed from a zero state over its own m+1 rows. A window's first row has no previous action. For k <= m
the later window of FJ+A contains a_t: this leak is the paper's counterexample. For k > m the two windows hold what
MIK+A sees at gap k-m with a past and a future of m rows, except a_{t+k}, which MIK+A's future also reads.

Authors' code: not published.

Differences and readings:
- Frames are encoded once and windows gathered from the features: m+1 GRU steps per row, no extra convolutions.
- Observations are stacks: with three frames, the later window's first stack still shows the frames of the two rows
  before it, so no frame after o_t is hidden up to k = m+3.
- Near the start of a sampled window the past is shorter than m rows.
- In evaluation the encoder also reads only the last m+1 rows, since it was never trained on a longer past.
"""

from __future__ import annotations

from vd4rl_pomdp.nn.objective import StateInverse


class ForwardJump(StateInverse):
    """FJ (a GRU over m+1 observations) and FJ+A (which also reads actions)."""
