"""One-step inverse model (Pathak et al. 2017, arXiv 1705.05363): the action between two consecutive observations.

    P(a_t | e(o_t), e(o_{t+1}))

Authors' code: github.com/pathak22/noreward-rl (the inverse model of the intrinsic curiosity module).

Differences:
- Only the inverse model: no forward model, no curiosity reward, and no policy trained with it.
- It is ACRO with K = 1; the action target is configurable.
- The two observations share one random shift, as in `acro --shift-shared`; the authors do not augment (`--shift 0`).
"""

from __future__ import annotations

from vd4rl_pomdp.nn.objective import StateInverse


class OneStepInverse(StateInverse):
    """Inverse model on consecutive states: K = 1, as its options have no max_k."""
