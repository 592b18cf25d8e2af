"""K-means of actions by scikit-learn; run as a program, so that a training never holds the 110 MB of its import."""

import sys

import numpy as np
from sklearn.cluster import KMeans
from threadpoolctl import threadpool_limits


def fit_centers(sample: np.ndarray, codes: int, start: int) -> np.ndarray:
    """Centres, (codes, A) float64, of (N, A) float64; `start` seeds scikit-learn's three beginnings."""
    with threadpool_limits(1):  # not faster with more, and the last digits depend on their number
        centers: np.ndarray = KMeans(codes, n_init=3, random_state=start).fit(sample).cluster_centers_
    return centers


if __name__ == "__main__":
    _codes, _start, _width = map(int, sys.argv[1:])
    _sample = np.frombuffer(sys.stdin.buffer.read()).reshape(-1, _width)
    sys.stdout.buffer.write(fit_centers(_sample, _codes, _start).tobytes())
