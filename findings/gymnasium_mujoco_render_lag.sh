#!/usr/bin/env bash
# One would guess: after `env.step`, `env.render()` of a Gymnasium MuJoCo task shows the state that the step returned.
# What happens: the last mj_step moves qpos but leaves positions of bodies (xpos) where they were before that step, and
# nothing calls mj_forward: the picture lags by one simulator step (after a reset it does not).
# For this field: pixel observations and states of one row are of two moments, a fifth of a decision apart on
# HalfCheetah.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet gymnasium==1.4.0 mujoco==3.11.0 numpy==2.4.6 imageio packaging
export MUJOCO_GL="${MUJOCO_GL:-egl}"
"$tmp/venv/bin/python" -c "import mujoco; mujoco.GLContext(8, 8).free()" 2> "$tmp/gl" || {
    tail -1 "$tmp/gl"
    echo "skipped, nothing seen: needs libegl1, libgl1 and libgl1-mesa-dri, or libosmesa6 and MUJOCO_GL=osmesa"
    exit 77
}
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import gymnasium
import mujoco
import numpy as np

print("gymnasium", gymnasium.__version__, "mujoco", mujoco.__version__)
lags = {}
for name in ("HalfCheetah-v5", "Pusher-v5"):
    env = gymnasium.make(name, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    fresh = env.render().copy()
    mujoco.mj_forward(env.model, env.data)
    assert (env.render() == fresh).all(), "a picture after reset lags too"
    for _ in range(5):
        env.step(env.action_space.high * 0.7)
    seen, state = env.render().copy(), env.data.qpos.copy()
    mujoco.mj_forward(env.model, env.data)
    true = env.render().copy()
    assert (env.data.qpos == state).all()
    lags[name] = int((seen != true).any(-1).sum())
    change = np.abs(seen.astype(int) - true).max()
    print(f"{name}: {lags[name]} pixels change by up to {change} of 255 by mj_forward alone")
    env.close()
assert min(lags.values()) > 100, "pictures show the state"
PY
