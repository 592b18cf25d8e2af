"""K-means on actions by scikit-learn; run as a subprocess, so that training does not keep sklearn's 110 MB loaded."""

import sys

import numpy as np
from sklearn.cluster import KMeans
from threadpoolctl import threadpool_limits


def fit_centers(sample: np.ndarray, codes: int, start: int) -> np.ndarray:
    """K-means centres (codes, A) float64 of a (N, A) float64 sample; `start` seeds the three initialisations."""
    with threadpool_limits(1):  # more threads are no faster, and the last digits depend on their number
        centers: np.ndarray = KMeans(codes, n_init=3, random_state=start).fit(sample).cluster_centers_
    return centers


if __name__ == "__main__":
    _codes, _start, _width = map(int, sys.argv[1:])
    _sample = np.frombuffer(sys.stdin.buffer.read()).reshape(-1, _width)
    sys.stdout.buffer.write(fit_centers(_sample, _codes, _start).tobytes())
