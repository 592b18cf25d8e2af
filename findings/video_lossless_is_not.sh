#!/usr/bin/env bash
# One would guess: H.264 at crf 0 (or qp 0) without chroma subsampling is lossless, and LeRobot's default video (AV1,
# crf 30, yuv420p) is close enough that nobody sees it.
# What happens: the codec is lossless, the way from RGB to 8-bit YUV and back is not: at crf 0 many values come back
# off by 1 or 2. Only `libx264rgb` gives all pixels back. At LeRobot's defaults small pictures with sharp colours are
# off by up to a hundred and more.
# For this field: PNG within parquet or `libx264rgb` keep a set of pixels (as large as each other); else measure.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet av==18.1.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import sys

import av
import numpy as np

print("av", av.__version__, "libavcodec", av.library_versions["libavcodec"])
av.logging.set_level(av.logging.ERROR)
# a checkered floor that moves, and a coloured body, as simulators draw them
across, down = np.meshgrid(np.arange(84), np.arange(84))
frames = []
for t in range(40):
    floor = (across + 2 * t) // 7 % 2 ^ down // 7 % 2
    frame = np.where(floor[..., None], np.uint8([60, 90, 130]), np.uint8([30, 50, 80]))
    frame[(across - 42) ** 2 + (down - 42 - t % 9) ** 2 < 150] = [200, 120, 40]
    frames.append(frame.astype(np.uint8))
frames = np.stack(frames)


def change(codec, pixels, **options):
    path = os.path.join(sys.argv[1], "film.mp4")
    with av.open(path, "w") as file:
        stream = file.add_stream(codec, 20, options=options)
        stream.height = stream.width = 84
        stream.pix_fmt = pixels
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        file.mux(stream.encode())
    with av.open(path) as file:
        back = np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])
    off = np.abs(back.astype(int) - frames)
    told = f"off by {off.mean():.2f} on average, {off.max()} at most, {os.path.getsize(path) // len(frames)} bytes a picture"
    print(codec, pixels, options, told)
    return off.mean(), off.max()


lossless = change("libx264", "yuv444p", g="2", crf="0")
default = change("libsvtav1", "yuv420p", g="2", crf="30", preset="12")
rgb = change("libx264rgb", "rgb24", g="2", qp="0")
assert 0 < lossless[1] < 5, "crf 0 keeps RGB, or loses much"
assert default[1] > 40, "LeRobot's default is close to the original"
assert rgb[1] == 0, "libx264rgb loses something"
PY
