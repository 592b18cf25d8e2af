"""V-D4RL's action noise (Lu et al. 2022, arXiv 2206.04779): normal, of a scheduled size, clipped, kept within bounds.

Authors' code: github.com/conglu1997/v-d4rl (drqbc/utils.py, `TruncatedNormal` and `schedule`).
"""

from __future__ import annotations

from torch import Tensor

from vd4rl_pomdp.core.streams import RandomStream

NOISE_CLIP = 0.3
"""Largest noise on a dimension of an action."""
NOISE_START, NOISE_END, NOISE_UPDATES = 1.0, 0.1, 250_000
"""Standard deviation at the first update, from the last of these updates on, and how many these are at most."""
MARGIN = 1e-6
"""How far from -1 and 1 a noisy action stays."""


def noise_at(update: int, planned: int) -> float:
    """Standard deviation of the noise after so many updates: it falls linearly, then stays.

    Args:
        update: updates that were made.
        planned: all that there will be; it falls over half of them where that is sooner than in V-D4RL, which makes
            550,000: noise that has not fallen when training ends pushes the policy's actions outwards.
    """
    done = min(1.0, update / min(NOISE_UPDATES, planned / 2))
    return NOISE_START + done * (NOISE_END - NOISE_START)


def with_noise(action: Tensor, std: float, draws: RandomStream) -> Tensor:
    """Noisy copy of (B, A) actions, within -1..1; the gradient passes as if nothing had been cut off."""
    noise = draws.normal(*action.shape) * std
    noisy = action + noise.clamp(-NOISE_CLIP, NOISE_CLIP)
    # straight through: with the true gradient, 0 beyond the bounds, a saturated action would never come back
    return noisy + (noisy.clamp(MARGIN - 1, 1 - MARGIN) - noisy).detach()
