"""Linear probes: how well a frozen representation predicts the simulator state on held-out episodes.

Episodes are held out from the probe only, not from pretraining: `supervised` may have trained on their states.
"""

from __future__ import annotations

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.state_scale import LEAST_VARIANCE
from vd4rl_pomdp.core.tasks import Layout

HELD_OUT = 5
"""Every fifth episode is a test episode; with fewer than five episodes, the last one is."""


def held_out(episode: np.ndarray) -> np.ndarray:
    """Test rows (N,) bool, given each row's episode (N,); UserError if there is only one episode."""
    episode = np.unique(episode, return_inverse=True)[1]
    if episode.max() == 0:
        raise UserError("a probe needs at least two episodes, one to fit and one to test")
    return episode % HELD_OUT == HELD_OUT - 1 if episode.max() >= HELD_OUT - 1 else episode == episode.max()


def probe_error(features: np.ndarray, targets: np.ndarray, episode: np.ndarray) -> float:
    """Mean absolute error of a ridge regression on held-out episodes, in percent of each target's standard deviation.

    0 is perfect. Uninformative features, for which the best prediction is the mean, give 80 for normally distributed
    targets, less for heavier tails, and at most 100 on the training episodes.

    From (N, D) representations, (N, P) state variables, of which constant ones are left out (if all are, the error is
    0), and the (N,) episode of every row; errors as `held_out`, which picks the test episodes.
    """
    error = _errors(features, targets, held_out(episode))
    return float(np.abs(error).mean() * 100) if error.size else 0.0


def probe_r2(features: np.ndarray, targets: np.ndarray, episode: np.ndarray) -> list[float]:
    """Variance explained by a ridge regression, one value per held-out episode. Arguments and errors as `probe_error`.

    Each is 1 - MSE / variance, with the variance of the training episodes, averaged over targets: 1 is perfect, 0 is
    no better than the mean. If all episodes have the same length, the mean over episodes is R^2.
    """
    test = held_out(episode)
    errors = np.square(_errors(features, targets, test)).mean(1)
    return [float(1 - errors[episode[test] == number].mean()) for number in np.unique(episode[test])]


def _errors(features: np.ndarray, targets: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Standardised errors (rows, targets) on the rows `test`; fitted on the others, without constant targets."""
    from sklearn.linear_model import Ridge  # 110 MB that training, which only needs `held_out`, does not load
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
    """`probe_error` for pose (without global position) and for velocity, from (N, P) simulator states."""
    return {
        "probe_pose": probe_error(features, layout.pose(physics), episode),
        "probe_velocity": probe_error(features, layout.velocity(physics), episode),
    }
