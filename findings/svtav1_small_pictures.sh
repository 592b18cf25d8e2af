#!/usr/bin/env bash
# One would guess: a video encoder that cannot take a size of picture raises an error.
# What happens: SVT-AV1 in PyAV 15, the codec that LeRobot records with by default and the PyAV that it asks for (<16),
# ends the whole process by SIGFPE for pictures of 24x24 and below. From 28x28 on, and in PyAV 18, it works.
# For this field: recording a gridworld's small pictures dies without a traceback, and the episode with it. Enlarge
# the pictures, or record with vcodec="h264".
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
for version in 15.1.0 18.1.0; do
    python3 -m venv "$tmp/$version"
    "$tmp/$version/bin/pip" install --quiet av==$version numpy==2.4.6
    for size in 16 48; do
        code=0
        "$tmp/$version/bin/python" - "$tmp/film.mp4" $size > "$tmp/told" 2>&1 << 'PY' || code=$?
import sys

import av
import numpy as np

size = int(sys.argv[2])
with av.open(sys.argv[1], "w") as file:
    stream = file.add_stream("libsvtav1", 20, options={"g": "2", "crf": "30", "preset": "12"})
    stream.height = stream.width = size
    stream.pix_fmt = "yuv420p"
    for level in range(5):
        picture = np.full((size, size, 3), 20 * level, np.uint8)
        file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    file.mux(stream.encode())
PY
        echo "av $version, pictures of ${size}x${size}: exit code $code"
        case $version/$size in 15.1.0/16) want=136 ;; *) want=0 ;; esac # 136: ended by SIGFPE
        test $code = $want || { tail -3 "$tmp/told"; echo "expected $want"; exit 1; }
    done
done
