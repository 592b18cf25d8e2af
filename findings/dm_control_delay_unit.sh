#!/usr/bin/env bash
# One would guess: in a dm_control composer task `delay=1` gives an observable's value of one `step` ago, and
# `buffer_size=3` its last three.
# What happens: both count simulator steps, of which a control step has 10 here: the delay is a tenth of a step, and the
# three are 2 ms apart. Before the first, the buffer holds zeros.
# For this field: three stacked images of a locomotion or manipulation task are nearly equal, and a task made partially
# observable by `delay` hides next to nothing. Set `update_interval` to the task's `physics_steps_per_control_step`, and
# give `delay` as a multiple of it.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet dm-control==1.0.44 mujoco==3.11.0 numpy==2.4.6
MUJOCO_GL=disabled "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation.observable import Generic

print("dm-control", version("dm-control"), "mujoco", version("mujoco"))


class Slider(composer.Entity):
    """A ball that moves by 0.02 a control step."""

    def _build(self):
        self.root = mjcf.RootElement()
        body = self.root.worldbody.add("body")
        self.joint = body.add("joint", type="slide", axis=[1, 0, 0])
        body.add("geom", size=[0.1])
        self.root.option.gravity = [0, 0, 0]

    @property
    def mjcf_model(self):
        return self.root


class Task(composer.Task):
    def __init__(self, **options):
        self.slider = Slider()
        self.set_timesteps(control_timestep=0.02, physics_timestep=0.002)
        self.seen = Generic(lambda physics: physics.bind(self.slider.joint).qpos.copy(), **options)
        self.seen.enabled = True

    @property
    def root_entity(self):
        return self.slider

    @property
    def task_observables(self):
        return {"seen": self.seen}

    def initialize_episode(self, physics, random_state):
        physics.bind(self.slider.joint).qpos, physics.bind(self.slider.joint).qvel = 1, 1

    def get_reward(self, physics):
        return 0.0


found = {}
for options in ({}, {"delay": 1}, {"delay": 10}, {"buffer_size": 3}, {"buffer_size": 3, "update_interval": 10}):
    env = composer.Environment(Task(**options), time_limit=1)
    steps = [env.reset()] + [env.step(np.zeros(0)) for _ in range(3)]
    found[str(options)] = seen = [np.round(step.observation["seen"].ravel(), 3).tolist() for step in steps]
    print(f"{options or 'as it is'}: {seen}")
now, one, ten, three, spaced = found.values()
assert one[1] == [1.018] and ten[1] == now[0] == [1.0], "delay counts control steps"
assert three[3] == [1.056, 1.058, 1.06] and spaced[3] == [1.02, 1.04, 1.06], "the buffer holds control steps"
assert three[0] == [0.0, 0.0, 1.0], "the first observation is repeated"
PY
