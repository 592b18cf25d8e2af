#!/usr/bin/env bash
# One would guess: a ViT with patches of 16 refuses images of 84x84, since 84 is no multiple of 16, or pads them.
# What happens: `image_size=84` is accepted without a word by ViT, DINOv2, DINOv3, CLIP and SigLIP of transformers. The
# patch convolution drops what is left over: the last four rows and columns, 9% of the pixels, reach no output.
# For this field: frames of 84x84 are the standard, and what enters at the right or lies at the bottom (the floor) is
# cut, while the same frame mirrored is not. Choose patches of 12 or 14, or resize.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" transformers==5.24.0 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
import torch
import transformers

print("transformers", transformers.__version__)
small = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 64}
for name in ("ViT", "Dinov2", "DINOv3ViT", "CLIPVision", "SiglipVision"):
    config = getattr(transformers, name + "Config")(image_size=84, patch_size=16, **small)
    model = getattr(transformers, name + "Model")(config).eval()
    images = torch.rand(4, 3, 84, 84, requires_grad=True)
    model(images).last_hidden_state.square().sum().backward()
    seen = images.grad.abs().sum((0, 1)) > 0
    rows, columns, unseen = int(seen.any(1).sum()), int(seen.any(0).sum()), 1 - float(seen.float().mean())
    print(f"{name}: sees {rows} rows and {columns} columns; {unseen:.1%} of the pixels are unseen")
    assert seen[:80, :80].all() and not seen[80:].any() and not seen[:, 80:].any(), "the border is seen"
PY
