"""dm_control's reacher and point_mass with a target that is visible only now and then, and may move in between.

- `reacher_jump` (from `reacher easy`): the target is visible in 3 of every 25 decisions. While hidden it may jump: at
  one in four glimpses it is in a new place.
- `point_mass_cue` (from `point_mass easy`): the target starts in the centre, as in dm_control, but invisible. After 10
  to 50 decisions it appears elsewhere for 10 decisions; then it stays there and is never visible again.

Neither the current frames, nor the first frames with all actions since, determine where the target is; only a memory of
past frames does. State and reward use the place where the target was last seen, so such a memory knows as much as the
state. The simulator state holds everything that an episode depends on: the target's place, how far it is moved aside
while hidden, and, as positions of an invisible body, a clock and the seed of the episode's random numbers.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from vd4rl_pomdp.core.tasks import ACTION_REPEAT
from vd4rl_pomdp.envs.rendering import suite

PERIOD, GLIMPSE, JUMPS = 25 * ACTION_REPEAT, 3 * ACTION_REPEAT, 0.25
"""reacher_jump: simulator steps between glimpses, steps per glimpse, and probability of a jump at a glimpse."""
CUE_BEGINS, CUE = (10 * ACTION_REPEAT, 50 * ACTION_REPEAT), 10 * ACTION_REPEAT
"""point_mass_cue: range of the cue's first simulator step, and its duration in steps."""
RADII = {"reacher_jump": (0.05, 0.2), "point_mass_cue": (0.12, 0.25)}
"""Range of a target's distance from the centre; reacher_jump's is dm_control's."""
ASIDE = 1.0
"""Distance by which a hidden target is moved out of view; frames show up to 0.31 from the centre."""
_TARGET_SIZE = 0.05
_TARGET, _HIDDEN, _CLOCK, _PLAN = slice(2, 4), 4, 5, 6
"""qpos entries, after the two of the task's own joints."""


class _Glimpsed:
    """Mixin for a task whose target is placed, shown and hidden by `plan`."""

    random: np.random.RandomState

    def initialize_episode(self, physics: Any) -> None:
        """Draw initial positions as dm_control does, and the seed of the episode's plan."""
        suite.reacher.randomizers.randomize_limited_and_rotational_joints(physics, self.random)
        physics.data.qpos[_PLAN] = self.random.randint(2**31)
        physics.data.qvel[_CLOCK] = 1.0
        self.plan(physics, 0)

    def before_step(self, action: np.ndarray, physics: Any) -> None:
        """Move the target before the step (no force acts on it), so that the step's results all belong to one state."""
        super().before_step(action, physics)  # type: ignore[misc]  # the task that this is mixed into
        self.plan(physics, round(physics.data.qpos[_CLOCK] / physics.timestep()) + 1)

    def plan(self, physics: Any, step: int) -> None:
        """Set the target's place and visibility for simulator step `step`."""
        raise NotImplementedError

    def get_observation(self, physics: Any) -> dict[str, np.ndarray]:
        """The actor's input: dm_control's observation of the task's own joints, and the vector to the target."""
        position, velocity = physics.position()[:2], physics.velocity()[:2]
        return {"position": position, "to_target": physics.to_target(), "velocity": velocity}


class ReacherJump(_Glimpsed, suite.reacher.Reacher):
    """Reacher whose target is shown periodically and may jump while hidden; see the module."""

    def plan(self, physics: Any, step: int) -> None:
        """Jump with probability JUMPS every PERIOD steps; show the target for the first GLIMPSE of these."""
        if step % PERIOD == 0:
            random = _random(physics, step)
            if step == 0 or random.uniform() < JUMPS:
                _place(physics, random, RADII["reacher_jump"])
        physics.data.qpos[_HIDDEN] = 0 if step % PERIOD < GLIMPSE else ASIDE

    def get_observation(self, physics: Any) -> dict[str, np.ndarray]:
        """As in `_Glimpsed`, with the shoulder's angle, which is unlimited, as cosine and sine."""
        found = super().get_observation(physics)
        shoulder, wrist = found["position"]
        return found | {"position": np.array([np.cos(shoulder), np.sin(shoulder), wrist])}


class PointMassCue(_Glimpsed, suite.point_mass.PointMass):
    """Point mass whose target is shown once, as a cue; see the module."""

    def plan(self, physics: Any, step: int) -> None:
        """Move the target at the cue's first step; show it during the cue only."""
        first, end = CUE_BEGINS
        begin = first + int(physics.data.qpos[_PLAN]) % (end - first)
        if step == begin:
            _place(physics, _random(physics, step), RADII["point_mass_cue"])
        physics.data.qpos[_HIDDEN] = 0 if begin <= step < begin + CUE else ASIDE


def _random(physics: Any, step: int) -> np.random.RandomState:
    return np.random.RandomState([int(physics.data.qpos[_PLAN]), step])


def _place(physics: Any, random: np.random.RandomState, radii: tuple[float, float]) -> None:
    angle, radius = random.uniform(0, 2 * np.pi), random.uniform(*radii)
    physics.data.qpos[_TARGET] = radius * np.sin(angle), radius * np.cos(angle)


class _ReacherPhysics(suite.reacher.Physics):
    def finger_to_target(self) -> np.ndarray:
        return self.data.qpos[_TARGET] - self.named.data.geom_xpos["finger", :2]

    to_target = finger_to_target


class _PointMassPhysics(suite.point_mass.Physics):
    def mass_to_target(self) -> np.ndarray:
        return self.data.qpos[_TARGET] - self.named.data.geom_xpos["pointmass", :2]

    to_target = mass_to_target


def _model(domain: Any) -> tuple[bytes, dict[str, bytes]]:
    """dm_control's model with the target on joints, and an invisible body whose joints hold clock and seed."""
    xml, assets = domain.get_model_and_assets()
    root = ElementTree.fromstring(xml)
    world: Any = root.find("worldbody")
    geom = world.find("geom[@name='target']")
    world.remove(geom)
    geom.set("size", str(_TARGET_SIZE))
    target = ElementTree.SubElement(world, "body", name="target", pos=geom.attrib.pop("pos"))
    target.append(geom)
    hidden = ElementTree.SubElement(world, "body", name="plan")
    ElementTree.SubElement(hidden, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
    # Frictionless horizontal slides; armature keeps the mass matrix regular, as two of the target's share an axis.
    still = {"type": "slide", "limited": "false", "damping": "0", "armature": "1"}
    for body, name, axis in (
        (target, "target_x", "1 0 0"),
        (target, "target_y", "0 1 0"),
        (target, "target_aside", "1 0 0"),
        (hidden, "clock", "1 0 0"),
        (hidden, "plan", "0 1 0"),
    ):
        ElementTree.SubElement(body, "joint", still, name=name, axis=axis)
    return ElementTree.tostring(root), assets


def reacher_jump(random: np.random.RandomState, time_limit: float) -> Any:
    """The dm_control environment of `reacher_jump`."""
    physics = _ReacherPhysics.from_xml_string(*_model(suite.reacher))
    task = ReacherJump(_TARGET_SIZE, random=random)
    return suite.reacher.control.Environment(physics, task, time_limit=time_limit)


def point_mass_cue(random: np.random.RandomState, time_limit: float) -> Any:
    """The dm_control environment of `point_mass_cue`."""
    physics = _PointMassPhysics.from_xml_string(*_model(suite.point_mass))
    task = PointMassCue(randomize_gains=False, random=random)
    return suite.point_mass.control.Environment(physics, task, time_limit=time_limit)


SUITE = {"reacher_jump": reacher_jump, "point_mass_cue": point_mass_cue}
