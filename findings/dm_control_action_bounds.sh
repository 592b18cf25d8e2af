#!/usr/bin/env bash
# One would guess: tasks of dm_control's suite take actions in [-1, 1] and end after 1,000 steps.
# What happens: lqr has bounds of 1e10 and no time limit: actions drawn from its own spec give a return of -1e20 and an
# error of the physics. quadruped's bounds are 0.8, 1 and 1.1 by joint. All 1e10 are finite: "is the Box bounded?" says
# yes.
# For this field: rescaling an agent's [-1, 1] to the spec is right for quadruped and ruins lqr; look at the numbers.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet dm-control==1.0.44 mujoco==3.11.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os

os.environ["MUJOCO_GL"] = "disabled"
from importlib.metadata import version

import numpy as np
from dm_control import suite
from dm_control.rl.control import PhysicsError

print("dm-control", version("dm-control"), "mujoco", version("mujoco"))
ends = {}
for name in ("unit actions", "actions of the spec"):
    env = suite.load("lqr", "lqr_6_2", task_kwargs={"random": 0})
    spec, draw, total, error, step = env.action_spec(), np.random.default_rng(0), 0.0, None, env.reset()
    for count in range(1, 1501):
        scale = 1.0 if name == "unit actions" else spec.maximum
        try:
            step = env.step(draw.uniform(-1, 1, spec.shape) * scale)
        except PhysicsError as raised:
            error = type(raised).__name__
            break
        total += step.reward
        if step.last():
            break
    ends[name] = total, count, error
    print(f"lqr_6_2, bounds {spec.maximum[0]:.0e}, {name}: return {total:.3g} after {count} steps, {error}")
quadruped = suite.load("quadruped", "walk").action_spec()
print("quadruped_walk, upper bounds:", quadruped.maximum[:3], "lower:", quadruped.minimum[:3])
assert np.isfinite(spec.maximum).all() and spec.maximum.min() == 1e10
assert ends["unit actions"][1] == 1500 and ends["unit actions"][0] > 0, "lqr ends by itself"
assert ends["actions of the spec"][0] < -1e15 and ends["actions of the spec"][2] == "PhysicsError"
assert sorted(set(quadruped.maximum)) == [0.8, 1.0, 1.1] and quadruped.minimum.min() == -1
PY
