#!/usr/bin/env bash
# One would guess: rliable's interquartile mean discards the lowest and highest quarter of the scores.
# What happens: it cuts whole scores, a quarter of their number rounded down. Of three seeds on one task it cuts none,
# so "IQM" is the plain mean and one lucky seed moves it freely; of five it averages the middle three (60%), of seven
# the middle five (71%). Only for multiples of four is it the middle half.
# For this field: three or five seeds are usual. IQMs of methods with different numbers of runs are different
# statistics, and one more seed can change the value by the statistic alone.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet rliable==1.2.0 arch==7.2.0 pandas==2.3.3 scipy==1.17.1 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import numpy as np
from rliable import metrics

print("rliable", version("rliable"), "scipy", version("scipy"))


def interquartile(scores):
    """The mean of the middle half, with fractions of scores."""
    edges = np.linspace(0, 1, len(scores) + 1)
    weights = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0, None)
    return float(np.sort(scores) @ weights / weights.sum())


apart = {}
for count in (3, 4, 5, 7, 8):
    scores = np.linspace(200, 240, count)
    scores[-1] = 900  # one lucky seed
    found, exact, cut = metrics.aggregate_iqm(scores[:, None]), interquartile(scores), count // 4
    apart[count] = found - exact
    print(f"{count} seeds: rliable {found:.1f}, the mean of {count - 2 * cut};", end=" ")
    print(f"middle half {exact:.1f}, all {scores.mean():.1f}")
    assert np.isclose(found, scores[cut : count - cut].mean()), "cut otherwise"
assert apart[3] > 50, "three seeds are trimmed"
assert abs(apart[4]) < 1e-9 and abs(apart[8]) < 1e-9
PY
