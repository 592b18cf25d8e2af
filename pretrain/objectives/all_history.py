"""No history, AH and AH+A: inverse models on one observation or on the whole past (Wu et al. 2024, sections 3 and 4).

    no_history   P(a_t | e(o_t), e(o_{t+k}))
    AH           P(a_t | f(o_0..o_t), f(o_0..o_{t+k})),   k in 1..K
    AH+A         the same with actions: f(o_0, a_0, ..., a_{t-1}, o_t) and f(o_0, a_0, ..., a_{t+k-1}, o_{t+k})

One forward GRU f computes both states, so the later one contains the earlier one's inputs. In AH+A that includes a_t:
an encoder that only records actions reaches zero loss. The paper includes AH+A to show this failure, and so do we.

Authors' code: not published.

Differences and readings:
- no_history is ACRO's loss under the paper's name: the memoryless encoder e in the same loop.
- The past starts at the window's first row, which has no previous action.
"""

from __future__ import annotations

from vd4rl_pomdp.nn.objective import StateInverse


class AllHistory(StateInverse):
    """no_history (an encoder without memory), AH (with a GRU) and AH+A (a GRU that reads actions)."""
