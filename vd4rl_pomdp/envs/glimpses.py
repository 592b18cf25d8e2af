"""dm_control's reacher and point_mass with a target that is seen in glimpses only, and elsewhere in a later one.

- `reacher_jump` (of `reacher easy`): the target is drawn in 3 of every 25 decisions. While it is hidden it may jump: of
  four glimpses one shows it elsewhere.
- `point_mass_cue` (of `point_mass easy`): the target is in the centre, as in dm_control, but not drawn. After 10 to 50
  decisions it is drawn elsewhere, for 10 decisions; there it stays, never to be seen again.

Neither the first frames and the actions since nor the present frames tell where the target is: a memory of what was
seen does. State and reward take the target for where it was seen last, so that such a memory knows as much as the
state. All that an episode depends on is in its simulator state: the target's place and how far aside it is put while
hidden, and, as positions of a body without a shape, a clock and the number that its random numbers come from.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from vd4rl_pomdp.core.tasks import ACTION_REPEAT
from vd4rl_pomdp.envs.rendering import suite

PERIOD, GLIMPSE, JUMPS = 25 * ACTION_REPEAT, 3 * ACTION_REPEAT, 0.25
"""reacher_jump: steps from one glimpse to the next, steps of a glimpse, and the share of glimpses that show a jump."""
CUE_BEGINS, CUE = (10 * ACTION_REPEAT, 50 * ACTION_REPEAT), 10 * ACTION_REPEAT
"""point_mass_cue: bounds of the step that the cue begins with, and its steps."""
RADII = {"reacher_jump": (0.05, 0.2), "point_mass_cue": (0.12, 0.25)}
"""Bounds of a target's distance from the centre; reacher_jump's are dm_control's."""
ASIDE = 1.0
"""How far a hidden target is put aside; pictures end 0.31 from the centre."""
_TARGET_SIZE = 0.05
_TARGET, _HIDDEN, _CLOCK, _PLAN = slice(2, 4), 4, 5, 6
"""Positions behind those of the task's own two joints."""


class _Glimpsed:
    """A task whose target is placed and shown by the plan of its episode."""

    random: np.random.RandomState

    def initialize_episode(self, physics: Any) -> None:
        """Draw positions as dm_control does, and the plan."""
        suite.reacher.randomizers.randomize_limited_and_rotational_joints(physics, self.random)
        physics.data.qpos[_PLAN] = self.random.randint(2**31)
        physics.data.qvel[_CLOCK] = 1.0
        self.plan(physics, 0)

    def before_step(self, action: np.ndarray, physics: Any) -> None:
        """Change the target before the step: no force acts on it, and what the step computes is then of one state."""
        super().before_step(action, physics)  # type: ignore[misc]  # of the task that it is mixed into
        self.plan(physics, round(physics.data.qpos[_CLOCK] / physics.timestep()) + 1)

    def plan(self, physics: Any, step: int) -> None:
        """Place, show or hide the target as it is after so many steps."""
        raise NotImplementedError

    def get_observation(self, physics: Any) -> dict[str, np.ndarray]:
        """What an actor reads: dm_control's observation, of the task's own joints, and the way to the target."""
        position, velocity = physics.position()[:2], physics.velocity()[:2]
        return {"position": position, "to_target": physics.to_target(), "velocity": velocity}


class ReacherJump(_Glimpsed, suite.reacher.Reacher):
    """See the module."""

    def plan(self, physics: Any, step: int) -> None:
        """See `_Glimpsed`."""
        if step % PERIOD == 0:
            random = _random(physics, step)
            if step == 0 or random.uniform() < JUMPS:
                _place(physics, random, RADII["reacher_jump"])
        physics.data.qpos[_HIDDEN] = 0 if step % PERIOD < GLIMPSE else ASIDE

    def get_observation(self, physics: Any) -> dict[str, np.ndarray]:
        """See `_Glimpsed`; the shoulder, which turns without limits, as cosine and sine."""
        found = super().get_observation(physics)
        shoulder, wrist = found["position"]
        return found | {"position": np.array([np.cos(shoulder), np.sin(shoulder), wrist])}


class PointMassCue(_Glimpsed, suite.point_mass.PointMass):
    """See the module."""

    def plan(self, physics: Any, step: int) -> None:
        """See `_Glimpsed`."""
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
    """dm_control's model, its target on joints, and a body without a shape that holds clock and plan."""
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
    # Level slides, on which no force acts; armature, because two of the target's have one axis.
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
