#!/usr/bin/env bash
# One would guess: when ViZDoom's time limit ends an episode, gymnasium's `step` returns the last image and
# `truncated` without `terminated`.
# What happens: the last image is black, and the game variables (health, ammunition) are 0; at the time limit both flags
# are set.
# For this field: whoever bootstraps at a time limit asks for the value of a black image; whoever reads `terminated`
# first takes a time limit for a death. In a dataset one image of each episode shows nothing, and models of the next
# frame learn to predict it. Drop the last step.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet vizdoom==1.3.2 gymnasium==1.4.0 numpy==2.4.6
cd "$tmp" # ViZDoom writes its settings into the working directory
SDL_VIDEODRIVER=dummy "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import gymnasium
from vizdoom import gymnasium_wrapper  # noqa: F401

print("vizdoom", version("vizdoom"), "gymnasium", gymnasium.__version__)
found = {}
for name in ("VizdoomBasic-v1", "VizdoomHealthGathering-v1"):
    env = gymnasium.make(name)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    steps, terminated, truncated = 0, False, False
    while not terminated and not truncated:
        before = observation
        action = 0 if name == "VizdoomBasic-v1" else env.action_space.sample()
        observation, _, terminated, truncated, _ = env.step(action)
        steps += 1
    print(f"{name}: {steps} steps, terminated {terminated}, truncated {truncated}")
    for when, seen in (("before the last", before), ("last", observation)):
        print(f"  {when}: mean pixel {seen['screen'].mean():.1f}, variables {seen['gamevariables'].tolist()}")
    assert before["screen"].any(), "all images are black"
    assert not any(part.any() for part in observation.values()), "the last observation is not empty"
    found[name] = terminated, truncated
assert (True, True) in found.values(), "a time limit sets one flag"
PY
