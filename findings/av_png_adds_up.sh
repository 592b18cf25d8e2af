#!/usr/bin/env bash
# One would guess: a PNG codec context decodes one PNG file after another, each for itself, since PNG has no state.
# What happens: the first picture is right; each later one is the sum, modulo 256, of itself and the picture before it as
# decoded. FFmpeg reads a packet that is not marked as a key frame as a difference to the last one, and a packet made
# from bytes is not marked. With `packet.is_keyframe = True`, or a new context, every picture is right.
# For this field: LeRobot stores pictures as PNG bytes; a reader that keeps one decoder for speed trains on noise.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet av==18.1.0 numpy==2.4.6 pillow==12.0.0
"$tmp/venv/bin/python" - << 'PY'
import io

import av
import numpy as np
from PIL import Image

print("av", av.__version__, "libavcodec", av.library_versions["libavcodec"])
pictures = np.random.default_rng(0).integers(0, 256, (4, 84, 84, 3), np.uint8)


def decoded(marked: bool) -> np.ndarray:
    context = av.CodecContext.create("png", "r")
    found = []
    for picture in pictures:
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "PNG")
        packet = av.Packet(file.getvalue())
        packet.is_keyframe = marked or packet.is_keyframe
        (frame,) = context.decode(packet)
        found.append(frame.to_ndarray(format="rgb24"))
    return np.stack(found)


plain, marked = decoded(False), decoded(True)
for name, found in (("as they are", plain), ("marked as key frames", marked)):
    print(f"{name}: right are {[bool((one == other).all()) for one, other in zip(found, pictures)]}")
assert np.array_equal(marked, pictures), "marked packets are decoded wrongly"
assert np.array_equal(plain, np.cumsum(pictures, axis=0, dtype=np.uint8)), "unmarked packets do not add up"
PY
