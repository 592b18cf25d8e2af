#!/usr/bin/env bash
# One would guess: `pip install rliable` gives the library that papers cite, and `random_state` makes its intervals
# repeatable.
# What happens: its dependency arch does not import beside pandas 3, which a fresh install brings. With an older pandas
# it works, but `random_state` is ignored; only numpy's global seed decides.
# For this field: published intervals cannot be made again from the seed that their code passes. Call `np.random.seed`.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet rliable==1.2.0 arch==7.2.0 pandas==3.1.1 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import subprocess
import sys

estimate = """
import warnings; warnings.simplefilter("ignore")
import numpy as np
from rliable import library, metrics
scores = {"method": np.random.default_rng(0).uniform(0, 1, (5, 3))}
iqm = lambda s: np.array([metrics.aggregate_iqm(s)])
def interval(**seed):
    return library.get_interval_estimates(scores, iqm, reps=200, **seed)[1]["method"].ravel()
a, b = (interval(random_state=np.random.RandomState(0)) for _ in range(2))
print("same random_state twice:", a, b, "the same" if (a == b).all() else "differ")
np.random.seed(0); c = interval(); np.random.seed(0); d = interval()
print("same numpy seed twice:", c, d, "the same" if (c == d).all() else "differ")
"""


def run():
    return subprocess.run([sys.executable, "-c", estimate], capture_output=True, text=True)


fresh = run()
print("rliable 1.2.0, pandas 3.1.1:", (fresh.stdout + fresh.stderr).strip().splitlines()[-1])
subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "pandas==2.3.3"], check=True)
older = run()
print("rliable 1.2.0, pandas 2.3.3:\n" + older.stdout, older.stderr)
assert fresh.returncode != 0 and "deprecate_kwarg" in fresh.stderr, "a fresh install imports"
assert [line.endswith("differ") for line in older.stdout.splitlines()] == [True, False], "random_state is used"
PY
