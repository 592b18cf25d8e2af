"""One-step inverse model (Pathak et al. 2017, arXiv 1705.05363): the action between two consecutive observations.

    P(a_t | e(o_t), e(o_{t+1}))

Authors' code: github.com/pathak22/noreward-rl (the inverse model of the intrinsic curiosity module).

Differences:
- The inverse model alone: no forward model, no curiosity reward, no policy trained with it.
- It is ACRO with K = 1; the action target is a choice.
- The two observations share one random shift, as in `acro --shift-shared`; the authors do not augment (`--shift 0`).
"""

from __future__ import annotations

from vd4rl_pomdp.nn.objective import StateInverse


class OneStepInverse(StateInverse):
    """Inverse model on consecutive states: its options have no K, so that K is 1."""
