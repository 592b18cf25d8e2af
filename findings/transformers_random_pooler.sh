#!/usr/bin/env bash
# One would guess: `pooler_output` of a model that `AutoModel.from_pretrained` loads comes from the checkpoint.
# What happens: most ViT checkpoints (classifiers, DINO) hold no pooling layer. AutoModel adds one with random weights
# and a line in its load report, so a frozen model's pooled features are another random projection in every process,
# while the class token of the same load is right.
# For this field: frozen image features look plausible, train policies, and never come back.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" transformers==5.24.0 numpy==2.4.6
cd "$tmp"
"$tmp/venv/bin/python" << 'PY' 2> log || { cat log; exit 1; }
import torch
import transformers
from transformers import AutoModel, ViTConfig, ViTForImageClassification

print("transformers", transformers.__version__, "torch", torch.__version__)
shape = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 64}
ViTForImageClassification(ViTConfig(**shape, image_size=32, patch_size=8)).save_pretrained("classifier")
image = torch.rand(1, 3, 32, 32)
with torch.no_grad():
    first, again = (AutoModel.from_pretrained("classifier").eval()(image) for _ in range(2))
tokens = torch.equal(first.last_hidden_state, again.last_hidden_state)
change = float((first.pooler_output - again.pooler_output).abs().max() / first.pooler_output.abs().max())
print(f"one checkpoint, loaded twice: tokens equal: {tokens}; pooled features differ by {change:.0%} of the largest")
assert tokens
assert change > 0.1, "pooled features come from the checkpoint"
PY
