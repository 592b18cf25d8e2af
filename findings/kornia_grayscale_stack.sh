#!/usr/bin/env bash
# One would guess: kornia's `RandomGrayscale` turns each frame of a stack (9 channels: three RGB frames) grey, or
# refuses other than 3 channels, as its `ColorJitter` does.
# What happens: it takes nine channels for nine spectral bands and replaces each by the mean of all: three frames in
# which something moves become three equal ones.
# For this field: grayscale is a usual augmentation of stacked frames. Here it removes velocity as well as colour, and
# does not weigh colours as it does for one frame. Fold frames into the batch before augmenting them.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" kornia==0.9.0 kornia-rs==0.2.0 numpy==2.4.6
OMP_NUM_THREADS=1 "$tmp/venv/bin/python" -W ignore - << 'PY'
import kornia
import torch
from kornia.augmentation import ColorJitter, RandomGrayscale

print("kornia", kornia.__version__, "torch", torch.__version__)
frames = torch.zeros(3, 3, 84, 84)
for time, column in enumerate((20, 40, 60)):
    frames[time, 1, 40:44, column : column + 4] = 1  # a green square moves to the right
gray = RandomGrayscale(p=1.0)


def columns(image):
    return sorted({int(at) // 4 * 4 for at in image.amax(0).amax(0).nonzero().ravel()})


apart, stacked = gray(frames), gray(frames.view(1, 9, 84, 84)).view(3, 3, 84, 84)
for name, seen in (("frame by frame", apart), ("as a stack", stacked)):
    print(f"{name}: columns of the square in each frame {[columns(frame) for frame in seen]}, value {seen.max():.3f}")
try:
    ColorJitter(0.2, 0.2, 0.2, 0.1, p=1.0)(frames.view(1, 9, 84, 84))
    raised = False
except ValueError as error:
    raised = True
    print("ColorJitter:", str(error).splitlines()[0])
assert raised and [columns(frame) for frame in apart] == [[20], [40], [60]]
assert torch.equal(stacked[0], stacked[1]) and torch.equal(stacked[1], stacked[2]), "frames stay apart"
PY
