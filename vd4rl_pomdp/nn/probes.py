"""What a frozen representation says of the simulator state: a linear probe on held-out episodes.

Held out from the probe, not from pretraining: an encoder that was trained on the states themselves knew these, too.
"""

from __future__ import annotations

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.state_scale import LEAST_VARIANCE
from vd4rl_pomdp.core.tasks import Layout

HELD_OUT = 5
"""Every fifth episode is for testing; of fewer than five, the last."""


def held_out(episode: np.ndarray) -> np.ndarray:
    """(N,) bool: which rows are for testing, of (N,) episodes of rows; raises UserError for one episode alone."""
    episode = np.unique(episode, return_inverse=True)[1]
    if episode.max() == 0:
        raise UserError("a probe fits some episodes and is tested on others: one alone is too few")
    return episode % HELD_OUT == HELD_OUT - 1 if episode.max() >= HELD_OUT - 1 else episode == episode.max()


def probe_error(features: np.ndarray, targets: np.ndarray, episode: np.ndarray) -> float:
    """Mean absolute error of a ridge regression, in percent of each target's standard deviation.

    0 is perfect. Knowing nothing, which predicts the mean, gives the targets' mean absolute deviation over their
    standard deviation: 80 for normally distributed ones, less for heavier tails, never more than 100 on the data of
    the fit.

    Args:
        features: (N, D) representations.
        targets: (N, P) state variables; constant ones are left out (all constant: the error is 0).
        episode: (N,) episode of every row, two at least; every fifth is held out, of fewer the last, others are fitted.

    Raises:
        UserError: one episode alone.
    """
    error = _errors(features, targets, held_out(episode))
    return float(np.abs(error).mean() * 100) if error.size else 0.0


def probe_r2(features: np.ndarray, targets: np.ndarray, episode: np.ndarray) -> list[float]:
    """Share of the targets' variance that a ridge regression explains in every held-out episode.

    One less the mean squared error in units of each target's variance on the data of the fit: 1 is perfect, 0 knows
    nothing. The mean over episodes of one length is R^2, averaged over targets. Arguments and errors as `probe_error`.
    """
    test = held_out(episode)
    errors = np.square(_errors(features, targets, test)).mean(1)
    return [float(1 - errors[episode[test] == number].mean()) for number in np.unique(episode[test])]


def _errors(features: np.ndarray, targets: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Errors on the (N,) rows `test`, of the targets that vary, in their standard deviations; fitted on the others."""
    from sklearn.linear_model import Ridge  # 110 MB that a training, which asks `held_out` alone, does not pay
    from sklearn.preprocessing import StandardScaler

    scale = StandardScaler().fit(targets[~test])
    varying = scale.var_ > LEAST_VARIANCE
    if not varying.any():
        return np.zeros((test.sum(), 0))
    targets = scale.transform(targets)[:, varying]
    inputs = StandardScaler().fit(features[~test])
    fitted = Ridge(alpha=1.0).fit(inputs.transform(features[~test]), targets[~test])
    return fitted.predict(inputs.transform(features[test])).reshape(-1, varying.sum()) - targets[test]


def probe_state(features: np.ndarray, physics: np.ndarray, episode: np.ndarray, layout: Layout) -> dict[str, float]:
    """Errors of `probe_error` on pose (without the place on the ground) and velocity.

    Args:
        features: (N, D) representations.
        physics: (N, P) simulator states.
        episode: (N,) episode of every row.
        layout: tells pose from velocity.
    """
    return {
        "probe_pose": probe_error(features, layout.pose(physics), episode),
        "probe_velocity": probe_error(features, layout.velocity(physics), episode),
    }
