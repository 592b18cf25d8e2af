#!/usr/bin/env bash
# One would guess: masking belongs to the pretraining of a masked autoencoder; its encoder in eval mode sees the image.
# What happens: `ViTMAEModel` masks three quarters of the patches at random in every forward pass, in eval mode too, and
# returns a quarter of the tokens in random order. AutoModel gives this class for MAE checkpoints.
# For this field: frozen MAE features are a usual baseline of visual control; computed like this they are noise around
# the image's features, and no two passes agree.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" transformers==5.24.0 numpy==2.4.6
cd "$tmp"
"$tmp/venv/bin/python" << 'PY' 2> log || { cat log; exit 1; }
import torch
import transformers
from transformers import AutoModel, ViTMAEConfig, ViTMAEForPreTraining

print("transformers", transformers.__version__, "torch", torch.__version__)
shape = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 64}
decoder = {f"decoder_{name}": value for name, value in shape.items()}
ViTMAEForPreTraining(ViTMAEConfig(**shape, **decoder, image_size=64, patch_size=8)).save_pretrained("mae")
model = AutoModel.from_pretrained("mae").eval()
image = torch.rand(1, 3, 64, 64)
with torch.no_grad():
    first, again = model(image), model(image)
count = first.last_hidden_state.shape[1] - 1
differ = not torch.equal(first.last_hidden_state[:, 0], again.last_hidden_state[:, 0])
print(f"{type(model).__name__}.eval(): {count} of 64 patches are encoded; class tokens of two passes differ: {differ}")
assert (count, differ) == (16, True), "the frozen encoder sees the whole image"
PY
