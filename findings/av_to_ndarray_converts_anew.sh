#!/usr/bin/env bash
# One would guess: `frame.to_ndarray(format="rgb24")`, as every example has it, is the fast way to a video's pictures.
# What happens: each call makes a converter of its own. In PyAV 18 (FFmpeg 8) that takes longer than decoding: one
# `VideoReformatter` for all frames gives equal pixels in half of the time or less. In PyAV 15 they hardly differed.
# For this field: videos of small pictures are read at 3,000 instead of 8,000 frames a second and core.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet av==18.1.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import sys
import time

import av
import numpy as np

print("av", av.__version__, "libswscale", av.library_versions["libswscale"])
path = sys.argv[1] + "/film.mp4"
with av.open(path, "w") as file:
    stream = file.add_stream("libx264", 20, options={"g": "2", "preset": "veryfast"})
    stream.height = stream.width = 84
    stream.pix_fmt = "yuv420p"
    for frame in np.random.default_rng(0).integers(0, 256, (400, 12, 12, 3), np.uint8):
        file.mux(stream.encode(av.VideoFrame.from_ndarray(frame.repeat(7, 0).repeat(7, 1), format="rgb24")))
    file.mux(stream.encode())
one = av.video.reformatter.VideoReformatter()
ways = {
    "to_ndarray": lambda frame: frame.to_ndarray(format="rgb24"),
    "one converter": lambda frame: one.reformat(frame, format="rgb24").to_ndarray(),
}
spent, pictures = dict.fromkeys(ways, float("inf")), {}
for name in [*ways] * 3:
    with av.open(path) as file:
        file.streams.video[0].codec_context.thread_count = 1
        started = time.process_time()
        pictures[name] = [ways[name](frame) for frame in file.decode(video=0)]
        spent[name] = min(spent[name], time.process_time() - started)
for name, seconds in spent.items():
    print(f"{name}: {400 / seconds:.0f} pictures a second of processor time")
assert np.array_equal(*pictures.values()), "pixels differ"
assert spent["to_ndarray"] > 1.4 * spent["one converter"], "a converter for each frame costs little"
PY
