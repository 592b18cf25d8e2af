#!/usr/bin/env bash
# One would guess: `mujoco.rollout` returns states and sensor values of the same times, so `sensordata[:, t]` measures
# `state[:, t]`.
# What happens: sensors are computed at the beginning of a step and the state is stored after it. Row t of the sensors
# belongs to row t - 1 of the states, row 0 to the initial state, and no row to the last state.
# For this field: a dataset of (state, sensor) pairs made this way is shifted by one step; a joint's position sensor
# disagrees with the position beside it.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet mujoco==3.11.0 numpy==2.4.6
"$tmp/venv/bin/python" - << 'PY'
import mujoco
import numpy as np
from mujoco import rollout

print("mujoco", mujoco.__version__)
model = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1"/></body></worldbody>
  <sensor><jointpos joint="x"/></sensor>
</mujoco>""")
data = mujoco.MjData(model)
data.qvel[0] = 1
kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
start = np.empty(mujoco.mj_stateSize(model, kind))
mujoco.mj_getState(model, data, start, kind)
states, sensors = rollout.rollout(model, data, start[None], nstep=6)
position = states[0, :, 1]  # after the time
print("state,  position:", position.round(2).tolist())
print("sensor, position:", sensors[0, :, 0].round(2).tolist())
assert np.allclose(sensors[0, 1:, 0], position[:-1]) and sensors[0, 0, 0] == 0, "otherwise aligned"
assert np.abs(sensors[0, :, 0] - position).min() > 0.009, "sensors and states are of the same times"
PY
