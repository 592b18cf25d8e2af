#!/usr/bin/env bash
# One would guess: of one seed, the first n values of `torch.randn(n + 1)` are `torch.randn(n)`, as in numpy.
# What happens: on the CPU torch fills 16 values at a time (Box-Muller in pairs eight apart) and draws the last 16 anew
# when the count is no multiple; below 16 it uses another order. So changing a size changes values at the front; `rand`
# is steady.
# For this field: noise for 20 episodes and for 21, or for a batch cut in two, are unrelated, and "same seed"
# comparisons of batch sizes or shards are none. Draw per episode from a generator of its own, or from numpy.
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
generator = torch.Generator().manual_seed(0)
halves = torch.cat([torch.randn(8, generator=generator), torch.randn(8, generator=generator)])
print("randn, two times 8 against 16:", int((halves == draws["torch.randn"](16)).sum()), "of 16 the same")
assert same["torch.randn"][15] == 0 and same["torch.randn"][16] < 3 and same["torch.randn"][20] < 20
assert all(count == n for name in ("torch.rand", "numpy standard_normal") for n, count in same[name].items())
assert (halves != draws["torch.randn"](16)).all()
PY
