"""No history, AH and AH+A: inverse models on one observation or on the whole past (Wu et al. 2024, sections 3 and 4).

    no_history   P(a_t | e(o_t), e(o_{t+k}))
    AH           P(a_t | f(o_0..o_t), f(o_0..o_{t+k})),   k in 1..K
    AH+A         the same with actions: f(o_0, a_0, ..., a_{t-1}, o_t) and f(o_0, a_0, ..., a_{t+k-1}, o_{t+k})

One forward GRU f gives both states, so the later one contains the earlier one's inputs. In AH+A it contains a_t as
well: an encoder that only records actions reaches zero loss. The paper has it to show that, and so do we.

Authors' code: not published.

Differences and readings:
- no_history is the encoder e alone in the same loop: ACRO's mathematics under the paper's name for it.
- The past begins at the window's first row, which carries no earlier action.
"""

from __future__ import annotations

from vd4rl_pomdp.nn.objective import StateInverse


class AllHistory(StateInverse):
    """no_history (an encoder without memory), AH (with a GRU) and AH+A (a GRU that reads actions)."""
