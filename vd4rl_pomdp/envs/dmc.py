"""dm_control's tasks as in V-D4RL: one camera, action repeat, and the simulator state of every row."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.tasks import FRAME_SIZE, TASKS, DMCTask, Layout
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.envs import rendering
from vd4rl_pomdp.envs.pixels import PixelEnv, Render, TimeStep, between, check_bounds
from vd4rl_pomdp.envs.rendering import mujoco, suite

_JOINT = mujoco.mjtJoint


class DMCEnv(PixelEnv):
    """One task. Replaying an episode's actions from its first simulator state reproduces the rewards exactly."""

    def __init__(
        self, task: DMCTask, render: Render = "fast", size: int | None = FRAME_SIZE, length: int | None = None
    ) -> None:
        super().__init__(task, size, length)
        self._random = np.random.RandomState(0)
        self.simulator = _load(task, self._random)
        """The dm_control environment."""
        cameras = self.physics.model.ncam
        if not 0 <= task.camera < cameras:
            raise UserError(
                f"dm_control's {task.domain} {task.task} has no camera {task.camera}: register the task with one of 0 "
                f"to {cameras - 1}"
            )
        self._layout = task.layout or self._found_layout(task.camera)
        if size is not None:
            rendering.prepare(self.physics, render, size)
            self._frame_camera = rendering.FrameCamera(self.physics, size, task.camera)

    @property
    def physics(self) -> Any:
        return self.simulator.physics

    @property
    def layout(self) -> Layout:
        """The layout given by the task, else the one found from the MuJoCo model."""
        return self._layout

    def _found_layout(self, camera: int) -> Layout:
        model = self.physics.model
        self.simulator.reset()  # some tasks have no observation before the first reset
        widths = self.simulator.action_spec().shape[0], len(flat_state(self.simulator)), model.nq
        travel, beside = _ground_travel(model, camera)
        joints = list(zip(model.jnt_type, model.jnt_qposadr, model.jnt_limited, model.jnt_bodyid, strict=True))
        turning = [int(start) for kind, start, limited, _ in joints if kind == _JOINT.mjJNT_HINGE and not limited]
        offset = {_JOINT.mjJNT_FREE: 3, _JOINT.mjJNT_BALL: 0}  # a free joint's qpos starts with x, y, z
        quaternions = [int(start) + offset[kind] for kind, start, *_ in joints if kind in offset]
        # no camera can show bodies without any geom in their tree
        visible = set(model.body_rootid[model.geom_bodyid].tolist())
        unseen = [int(start) for _, start, _, body in joints if int(model.body_rootid[body]) not in visible]
        return Layout(*widths, travel, tuple(turning), tuple(quaternions), beside, tuple(unseen))

    @property
    def rate(self) -> float:
        return 1 / (self.simulator.control_timestep() * self.task.action_repeat)

    def close(self) -> None:
        if self.size is not None:
            self._frame_camera.close()

    def _begin(self, seed: int) -> None:
        self._random.seed(seed)
        self.simulator.reset()
        # A reset keeps the solver's warm start from the previous episode; clear it, so that replays match.
        start_from(self.simulator, self.physics.get_state())

    def _apply(self, action: np.ndarray) -> tuple[float, bool, float]:
        return repeat_action(self.simulator, action, self.task.action_repeat)

    def _time_step(self, reward: float, discount: float, step_type: StepType) -> TimeStep:
        return TimeStep(
            frame=self._frame_camera.frame() if self.size and self.drawing else None,
            state=flat_state(self.simulator),
            physics=self.physics.get_state(),
            reward=reward,
            discount=discount,
            step_type=step_type,
        )


def flat_state(env: Any) -> np.ndarray:
    """dm_control's observation, flattened in its own order: (D,) float32."""
    observation = env.task.get_observation(env.physics)
    return np.concatenate([np.ravel(value) for value in observation.values()]).astype(np.float32)


def observed_states(task: DMCTask, physics: np.ndarray) -> np.ndarray:
    """Observations of simulator states: (N, P) float64 -> (N, D) float32, the actor's input `TimeStep.state`."""
    env = _load(task, np.random.RandomState(0))
    env.reset()
    found = []
    for state in physics:
        start_from(env, state)
        found.append(flat_state(env))
    return np.stack(found)


def start_from(env: Any, state: np.ndarray) -> None:
    """Set the simulator's state and clear everything else, including the solver's warm start."""
    with env.physics.reset_context():
        env.physics.set_state(state)


def repeat_action(env: Any, action: np.ndarray, repeat: int) -> tuple[float, bool, float]:
    """Repeat an action, or stop when the task ends; returns (summed reward, whether it ended, discount).

    `action` in [-1, 1] is rescaled to the task's bounds.
    """
    total, bounds = 0.0, env.action_spec()
    rescaled = between(action, bounds.minimum, bounds.maximum)
    for _ in range(repeat):
        step = env.step(rescaled)
        total += step.reward
        if step.last():
            return float(total), True, float(step.discount)
    return float(total), False, 1.0


def replay_rewards(task: str, physics: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Rewards (T,) float64 of actions (T, A) in a dm_control task, from the simulator state (P,) of the first row."""
    played = TASKS.named(task)
    assert isinstance(played, DMCTask), "other tasks store no states"
    env = _load(played, np.random.RandomState(0))
    env.reset()
    start_from(env, physics)
    return np.array([repeat_action(env, action, played.action_repeat)[0] for action in actions])


def replays(task: DMCTask) -> bool:
    """Whether the simulator state determines an episode. False for tasks that randomise the model, such as a target."""
    random = np.random.RandomState(0)
    env, models = _load(task, random), []
    for seed in (1, 2):
        random.seed(seed)
        env.reset()
        model = env.physics.model.ptr
        models.append(np.empty(mujoco.mj_sizeModel(model), np.uint8))
        mujoco.mj_saveModel(model, None, models[-1])
    return np.array_equal(models[0], models[1])


def _ground_travel(model: Any, camera: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Position entries that a tracking camera cannot show, since it moves along with its subject.

    First the subject's entries along the ground: x and y of a free joint, or horizontal slides. Second, if the subject
    is free, the first of these entries of each other free body. Both are empty without a tracking camera, or if the
    subject is fixed to the world, such as a hand.
    """
    if model.cam_mode[camera] not in (mujoco.mjtCamLight.mjCAMLIGHT_TRACK, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM):
        return (), ()
    on_ground: list[list[int]] = [[] for _ in range(model.njnt)]
    for joint, kind in enumerate(model.jnt_type):
        start, child_of_world = int(model.jnt_qposadr[joint]), model.body_parentid[model.jnt_bodyid[joint]] == 0
        if child_of_world and kind == _JOINT.mjJNT_FREE:
            on_ground[joint] = [start, start + 1]
        elif child_of_world and kind == _JOINT.mjJNT_SLIDE and abs(model.jnt_axis[joint][2]) < 0.5:
            on_ground[joint] = [start]
    moving = {int(model.jnt_bodyid[joint]): kind for joint, kind in enumerate(model.jnt_type) if on_ground[joint]}
    followed = int(model.body_rootid[model.cam_bodyid[camera]])
    subject = followed or next(iter(moving), 0)  # a camera attached to the world follows the centre of all bodies
    travel = [place for joint, places in enumerate(on_ground) if model.jnt_bodyid[joint] == subject for place in places]
    if moving.get(subject) != _JOINT.mjJNT_FREE:
        return tuple(travel), ()
    others = [places[0] for joint, places in enumerate(on_ground) if len(places) == 2 and places[0] != travel[0]]
    return tuple(travel), tuple(others)


def _load(task: DMCTask, random: np.random.RandomState) -> Any:
    """Load the dm_control environment, without its time limit; PixelEnv applies ours."""
    rendering.check_mujoco()
    arguments = {"random": random, "time_limit": float("inf")}
    if "." in task.domain:
        try:
            make = partial(importlib.import_module(task.domain).SUITE[task.task], **arguments)
        except (ImportError, AttributeError, KeyError) as error:
            raise UserError(f"{task.domain} offers no task {task.task!r} in a SUITE ({first_line(error)})") from error
    elif (task.domain, task.task) in suite.ALL_TASKS:
        make = partial(suite.load, task.domain, task.task, task_kwargs=arguments)
    else:
        tasks = ", ".join(name for domain, name in suite.ALL_TASKS if domain == task.domain)
        choices = tasks or ", ".join(sorted({domain for domain, _ in suite.ALL_TASKS}))
        raise UserError(f"dm_control has no task {task.domain!r}, {task.task!r}: choose one of {choices}")
    try:
        env = make()
    except AttributeError as error:
        if "MjModel" not in str(error):
            raise
        raise UserError(
            f"dm-control is incompatible with mujoco {mujoco.__version__} ({error}): install a tested pair, "
            "`pip install 'dm-control==1.0.44' 'mujoco==3.11.0'`"
        ) from error
    check_bounds(f"dm_control's {task.domain} {task.task}", env.action_spec().minimum, env.action_spec().maximum)
    return env
