#!/usr/bin/env bash
# One would guess: of one seed, the first n values of `torch.randn(n + 1)` are `torch.randn(n)`, and two draws of 8 are
# one of 16, as in numpy.
# What happens: on the CPU fewer than 16 values are drawn in another order than 16 and more, and a count that is no
# multiple of 16 has its last 16 values drawn anew. So 15 and 16 values have nothing in common, three draws of 6 and
# one of 18 neither; only multiples of 16 can be cut. `torch.rand` is steady.
# For this field: six joints' noise for one environment and the noise of three environments at once are unrelated for
# the same seed, so acting one by one and in a batch cannot be compared. Draw for each episode from a generator of its
# own, or from numpy.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import numpy as np
import torch

print("torch", torch.__version__, "numpy", np.__version__)


def kept(draw, n):  # how many of n values stay when one more is drawn
    return int((np.asarray(draw(n)) == np.asarray(draw(n + 1))[:n]).sum())


draws = {
    "torch.randn": lambda n: torch.randn(n, generator=torch.Generator().manual_seed(0)),
    "torch.rand": lambda n: torch.rand(n, generator=torch.Generator().manual_seed(0)),
    "numpy standard_normal": lambda n: np.random.default_rng(0).standard_normal(n, np.float32),
}
same = {name: {n: kept(draw, n) for n in (8, 15, 16, 20)} for name, draw in draws.items()}
for name, counts in same.items():
    print(f"{name}: of n values, kept when n + 1 are drawn:", counts)
cut = {}
for count, size in ((2, 8), (3, 6), (2, 16)):
    generator = torch.Generator().manual_seed(0)
    parts = torch.cat([torch.randn(size, generator=generator) for _ in range(count)])
    cut[count, size] = int((parts == draws["torch.randn"](count * size)).sum())
    print(f"torch.randn, {count} draws of {size} against one of {count * size}: {cut[count, size]} values the same")
assert same["torch.randn"][15] == 0 and same["torch.randn"][16] < 3 and same["torch.randn"][20] < 20
assert all(count == n for name in ("torch.rand", "numpy standard_normal") for n, count in same[name].items())
assert cut == {(2, 8): 0, (3, 6): 0, (2, 16): 32}, "draws are cut otherwise"
PY
