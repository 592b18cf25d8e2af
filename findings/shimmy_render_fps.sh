#!/usr/bin/env bash
# One would guess: `metadata["render_fps"]` of shimmy's dm_control environments is frames per second, one per
# environment.
# What happens: it holds the decision's length in milliseconds (25 for walker, which makes 40 decisions a second), in a
# dict that the class owns: making a cheetah changes the walker's to 10. `spec.max_episode_steps` is None for all.
# For this field: films play at the wrong speed, and a control rate taken from there is wrong. `1 / env.unwrapped.dt`
# is right.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet shimmy==2.0.1 gymnasium==1.4.0 dm-control==1.0.44 mujoco==3.11.0 \
    numpy==2.4.6 imageio packaging
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os

os.environ["MUJOCO_GL"] = "disabled"
from importlib.metadata import version

import gymnasium
import shimmy  # noqa: F401, registers dm_control's tasks

print("shimmy", version("shimmy"), "gymnasium", gymnasium.__version__)
walker = gymnasium.make("dm_control/walker-walk-v0")
told = walker.unwrapped.metadata["render_fps"]
print("walker: render_fps", told, "decisions a second", 1 / walker.unwrapped.dt, "limit", walker.spec.max_episode_steps)
cheetah = gymnasium.make("dm_control/cheetah-run-v0")
after = walker.unwrapped.metadata["render_fps"]
print("cheetah:", cheetah.unwrapped.metadata["render_fps"], "decisions a second", 1 / cheetah.unwrapped.dt)
print("walker, after the cheetah was made: render_fps", after)
assert told == 25 and round(1 / walker.unwrapped.dt) == 40 and after == 10 and round(1 / cheetah.unwrapped.dt) == 100
assert walker.spec.max_episode_steps is None
PY
