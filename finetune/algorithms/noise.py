"""V-D4RL's action noise (Lu et al. 2022, arXiv 2206.04779): normal, of a scheduled size, clipped, kept within bounds.

Authors' code: github.com/conglu1997/v-d4rl (drqbc/utils.py, `TruncatedNormal` and `schedule`).
"""

from __future__ import annotations

from torch import Tensor

NOISE_CLIP = 0.3
"""Largest noise on a dimension of an action."""
NOISE_START, NOISE_END, NOISE_UPDATES = 1.0, 0.1, 250_000
"""Standard deviation at the first update, from the last of these updates on, and how many these are at most."""
MARGIN = 1e-6
"""How far from -1 and 1 a noisy action stays."""


def share_of(done: int | Tensor, whole: float) -> float | Tensor:
    """How much of a whole is done, 1 at most: a number of a number, a tensor of one."""
    if isinstance(done, Tensor):
        return (done.double() / whole).clamp(max=1.0)
    return min(1.0, done / whole)


def noise_at(update: int | Tensor, planned: int) -> float | Tensor:
    """Standard deviation of the noise after so many updates: it falls linearly, then stays.

    Args:
        update: updates that were made, see `Algorithm.updates`.
        planned: all that there will be; it falls over half of them where that is sooner than in V-D4RL, which makes
            550,000: noise that has not fallen when training ends pushes the policy's actions outwards.
    """
    done = share_of(update, min(NOISE_UPDATES, planned / 2))
    return NOISE_START + done * (NOISE_END - NOISE_START)


def with_noise(action: Tensor, noise: Tensor) -> Tensor:
    """Copy of (B, A) actions with (B, A) noise, within -1..1; the gradient passes as if nothing had been cut off."""
    noisy = action + noise.clamp(-NOISE_CLIP, NOISE_CLIP)
    # straight through: with the true gradient, 0 beyond the bounds, a saturated action would never come back
    return noisy + (noisy.clamp(MARGIN - 1, 1 - MARGIN) - noisy).detach()
