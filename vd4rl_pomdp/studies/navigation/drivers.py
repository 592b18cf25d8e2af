"""Controllers for the mazes: planners for the top view, a small trained actor for the first-person view.

The actor is trained by PPO (stable-baselines3) on states, exported as a small file and shipped. Its inputs are the next
waypoint and its velocity, both in its own frame. The reward is the progress towards the goal, plus 1 for reaching it.
PPO's Gaussian is applied before a tanh, as in an actor's file (see `policies.actor`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from torch import nn

from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_no_folder, refuse_outside
from vd4rl_pomdp.envs.maze import CELL_OFFSET, MazeEnv
from vd4rl_pomdp.envs.mazes import ACTION_REPEAT, FREE_CELLS, HARD, MOST_STEPS, MazeSpec, get_maze
from vd4rl_pomdp.policies.actor import Actor, read_actor
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.progress import ProgressLine

POSITION_GAIN, VELOCITY_GAIN = 3.0, 0.6
"""Gains of the planner: on distance to the waypoint, and against velocity."""
_ASSETS = Path(__file__).parent / "assets"
FEATURES = 4
_EPISODE = 200
_LARGEST = 4.0
"""Bound of PPO's actions before the tanh."""
_PARALLEL = 8


class Planner:
    """Drives the mass to the environment's goal, straight through the cells; the caller adds noise."""

    def __init__(self, env: MazeEnv) -> None:
        self._maze = env.maze
        self._next: dict[tuple[int, int], dict[tuple[int, int], tuple[int, int]]] = {}
        """By goal cell: the next cell on the shortest path from every cell, by breadth-first search from the goal."""
        for goal in FREE_CELLS:
            following, queue = {goal: goal}, deque([goal])
            while queue:
                i, j = queue.popleft()
                for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                    if cell in FREE_CELLS and cell not in following:
                        following[cell] = (i, j)
                        queue.append(cell)
            self._next[goal] = following

    def act(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Action (2,) float64 for a (4,) state and a (2,) goal."""
        return POSITION_GAIN * (self.waypoint(state[:2], goal) - state[:2]) - VELOCITY_GAIN * state[2:]

    def waypoint(self, position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Where to head from a (2,) position: the goal if it is at most one cell away, else the next cell."""
        there = self._cell(goal)
        following = self._next[there][self._cell(position)]
        return goal if following == there else self._maze.cell_rowcol_to_xy(np.array(following))

    def distance(self, position: np.ndarray, goal: np.ndarray) -> float:
        """Path length over the waypoints from a (2,) position to a goal."""
        length, here = 0.0, position
        while here is not goal:
            target = self.waypoint(here, goal)
            length, here = length + float(np.linalg.norm(target - here)), target
        return length

    def cells_between(self, position: np.ndarray, goal: np.ndarray) -> list[np.ndarray]:
        """Centres (2,) of the cells on the shortest path from a position to a goal, without the first and the last."""
        here, there, centres = self._cell(position), self._cell(goal), []
        while (here := self._next[there][here]) != there:
            centres.append(self._maze.cell_rowcol_to_xy(np.array(here)))
        return centres

    def _cell(self, position: np.ndarray) -> tuple[int, int]:
        row, column = self._maze.cell_xy_to_rowcol(position)
        return int(row), int(column)


class WaypointPlanner:
    """The planner of the published generator: it stops at a waypoint near every cell's centre, and then at the goal.

    A waypoint counts as passed within NEAR of it, if the mass moved less than NEAR in the last decision.
    """

    NEAR = 0.1
    POSITION_GAIN, VELOCITY_GAIN = 5.0, 1.0
    JITTER = 0.2
    """Waypoints except the last are jittered uniformly by up to this much towards the cells' centres."""

    def __init__(self, env: MazeEnv, rng: np.random.Generator) -> None:
        self._planner, self._rng = Planner(env), rng
        self._goal, self._before = np.full(2, np.nan), np.zeros(2)
        self._ahead: list[np.ndarray] = []

    def act(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Action (2,) float64 for a (4,) state and a (2,) goal."""
        place = state[:2]
        if not np.array_equal(goal, self._goal):
            between = self._planner.cells_between(place, goal)
            back = self._rng.uniform(size=(len(between), 2)) * self.JITTER * np.sign(CELL_OFFSET)
            self._ahead = [*(np.array(between).reshape(-1, 2) + CELL_OFFSET - back), goal]
            self._goal, self._before = goal, place
        action = self.POSITION_GAIN * (self._ahead[0] - place) - self.VELOCITY_GAIN * state[2:]
        slow = np.linalg.norm(place - self._before) < self.NEAR
        if len(self._ahead) > 1 and slow and np.linalg.norm(place - self._ahead[0]) < self.NEAR:
            self._ahead.pop(0)
        self._before = place
        return action


@dataclass(frozen=True)
class FirstPersonConfig:
    """Settings of `vd4rl-pomdp navigation policy`."""

    out: Path
    """File to write the actor to."""
    maze: str = "first_person"
    """first_person, or hard_first_person."""
    decisions: int = 200_000
    """Minimum environment decisions; PPO makes whole rounds of 2,048."""
    action_repeat: int = ACTION_REPEAT
    """Simulator steps of 0.01 s per action."""
    seed: int = 0
    """Seed of the networks and the episodes."""


def shipped_actor(maze: MazeSpec) -> Actor:
    """The actor for a first-person maze: one per kind of kinematics."""
    return read_actor(_ASSETS / f"{'hard_' if maze.style is HARD else ''}first_person.safetensors")


def features(state: np.ndarray, waypoint: np.ndarray) -> np.ndarray:
    """The actor's inputs for a (6,) state: (4,) float32, waypoint and velocity in its own frame."""
    ahead = np.array([np.cos(state[2]), np.sin(state[2])])
    left = np.array([-ahead[1], ahead[0]])
    way = waypoint - state[:2]
    return np.array([way @ ahead, way @ left, state[3:5] @ ahead, state[3:5] @ left], np.float32)


class FirstPersonController:
    """Drives to the environment's goal with an actor's mean action; by default the shipped one."""

    def __init__(self, env: MazeEnv, actor: Actor | None = None) -> None:
        self._planner = Planner(env)
        self._actor = actor or shipped_actor(env.maze_spec)

    def act(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Action (2,) for a (6,) state and a (2,) goal."""
        return self._actor.act(features(state, self._planner.waypoint(state[:2], goal)))


class FirstPersonEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """The first-person maze on states, for PPO."""

    def __init__(self, maze: str, action_repeat: int) -> None:
        self._env = MazeEnv(maze, action_repeat, pixels=False)
        self._planner = Planner(self._env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (FEATURES,), np.float32)
        self.action_space = gymnasium.spaces.Box(-_LARGEST, _LARGEST, (2,), np.float32)
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start from a new position with a new goal."""
        super().reset(seed=seed)
        self._env.reset(seed=seed)
        self._steps = 0
        return self._features(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply tanh(action); the reward is the progress towards the goal, plus 1 for reaching it."""
        goal = self._env.goal
        before = self._planner.distance(self._env.state[:2], goal)
        _, reached, *_ = self._env.step(np.tanh(action))
        covered = before - self._planner.distance(self._env.state[:2], goal)
        self._steps += 1
        return self._features(), covered + reached, False, self._steps == _EPISODE, {}

    def _features(self) -> np.ndarray:
        return features(self._env.state, self._planner.waypoint(self._env.state[:2], self._env.goal))


def train_first_person(config: FirstPersonConfig) -> Actor:
    """Train and write the actor; its card holds the number of goals reached in 20 episodes."""
    if not get_maze(config.maze).first_person:
        raise UserError(f"--maze is {config.maze}, where a planner drives; choose first_person")
    refuse_outside(config, decisions=1, action_repeat=(1, MOST_STEPS), seed=(0, MAX_SEED))
    refuse_no_folder(config.out.parent)
    refuse_inside(config.out)
    if config.out.exists() or config.out.is_symlink():
        raise UserError(f"{config.out}: exists already; remove it, or choose another --out")
    try:
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.vec_env import DummyVecEnv
    except ImportError as error:
        raise UserError(
            f"training a policy needs stable-baselines3 ({error}): `pip install '.[policy]'` in the package's folder"
        ) from None

    def report(*_: Any) -> bool:
        progress.advance(_PARALLEL)
        return True  # false would stop the training

    environments = DummyVecEnv([lambda: FirstPersonEnv(config.maze, config.action_repeat) for _ in range(_PARALLEL)])
    model = PPO(
        "MlpPolicy",
        environments,
        n_steps=256,
        batch_size=512,
        gamma=0.98,
        ent_coef=1e-3,
        seed=config.seed,
        device="cpu",
        policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.ReLU},
    )
    model.set_logger(Logger(None, []))  # the default logger leaves an empty temporary folder
    with ProgressLine(f"PPO {config.maze}", config.decisions, "decisions") as progress:
        model.learn(config.decisions, callback=report)
    policy: Any = model.policy
    layers = [module for module in policy.mlp_extractor.policy_net if hasattr(module, "weight")]
    weights = {f"hidden.{i}": layer for i, layer in enumerate(layers)} | {"mean": policy.action_net}
    arrays = {f"{name}.weight": layer.weight.detach().numpy().T.copy() for name, layer in weights.items()}
    arrays |= {f"{name}.bias": layer.bias.detach().numpy().copy() for name, layer in weights.items()}
    log_std = policy.log_std.detach().numpy().copy()  # it does not depend on the state
    arrays |= {"log_std.weight": np.zeros((layers[-1].out_features, len(log_std)), np.float32), "log_std.bias": log_std}
    card = {"task": config.maze, "algorithm": "PPO", "decisions": model.num_timesteps}
    card |= {"action_repeat": config.action_repeat, "seed": config.seed}
    actor = Actor(arrays, card | {"stable_baselines3": version("stable-baselines3")})
    actor.card["goals_in_20_episodes"] = goals_reached(actor, config.maze, config.action_repeat, 20)
    actor.save(config.out)
    return actor


def goals_reached(actor: Actor, maze: str, action_repeat: int, episodes: int) -> int:
    """Goals reached by the mean action in episodes of 200 decisions with fixed seeds."""
    env = MazeEnv(maze, action_repeat, pixels=False)
    controller, reached = FirstPersonController(env, actor), 0
    for episode in range(episodes):
        _, info = env.reset(seed=10_000 + episode)
        for _ in range(_EPISODE):
            _, reward, _, _, info = env.step(controller.act(info["state"], info["goal"]))
            reached += int(reward)
    return reached
