#!/usr/bin/env bash
# One would guess: inside `torch.autocast` a layer uses its present weights.
# What happens: autocast casts each weight that needs a gradient once and keeps the bf16 copy until the outermost
# autocast region ends. Updates in place, an optimiser's step among them, are not seen; the loss goes on as if nothing
# had been learned.
# For this field: a loop of several updates (critic, then actor; many steps per batch) inside one region trains actors
# against an old critic, without an error. One region per forward pass, or `cache_enabled=False`.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import torch

print("torch", torch.__version__)


def losses(**options):
    torch.manual_seed(0)
    layer = torch.nn.Linear(64, 1)
    x, y = torch.randn(256, 64), torch.randn(256, 1)
    optimiser = torch.optim.SGD(layer.parameters(), 0.05)
    found = []
    with torch.autocast("cpu", torch.bfloat16, **options):
        for _ in range(3):
            loss = (layer(x) - y).square().mean()
            found.append(round(loss.item(), 4))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.autocast("cpu", torch.bfloat16):
        found.append(round((layer(x) - y).square().mean().item(), 4))
    return found


cached, fresh = losses(), losses(cache_enabled=False)
print("three SGD steps in one region, then in a new one:", cached)
print("the same with cache_enabled=False:               ", fresh)
assert cached[0] == cached[1] == cached[2] and cached[3] < cached[2], "updates are seen"
assert fresh[0] > fresh[1] > fresh[2]
PY
