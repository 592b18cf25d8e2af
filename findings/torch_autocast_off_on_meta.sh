#!/usr/bin/env bash
# One would guess: `torch.autocast(x.device.type, enabled=False)`, the usual way to keep a layer in its own precision,
# does nothing on any device.
# What happens: on the meta device, where shapes and memory are planned without data, switching autocast off raises
# "unsupported scalarType"; the device has no autocast dtype, and it is asked for before `enabled` is looked at.
# For this field: a network with one such layer cannot be built or measured on meta tensors.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" << 'PY'
import torch

print("torch", torch.__version__)
for device in ("cpu", "meta"):
    x = torch.ones(2, 2, device=device)
    try:
        with torch.autocast(x.device.type, enabled=False):
            said = f"product of shape {tuple((x @ x).shape)}"
    except RuntimeError as error:
        said = f"RuntimeError: {error}"
    print(f"autocast switched off on {device}: {said}")
    assert said.startswith("product" if device == "cpu" else "RuntimeError: unsupported scalarType"), said
PY
