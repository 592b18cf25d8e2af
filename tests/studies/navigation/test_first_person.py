from dataclasses import replace

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.studies.navigation.drivers import (
    FirstPersonConfig,
    goals_reached,
    shipped_actor,
    train_first_person,
)


@pytest.mark.parametrize("maze", ["first_person", "hard_first_person"])
def test_the_shipped_first_person_policy_reaches_goals_and_an_idle_one_does_not(maze):
    actor = shipped_actor(MAZES[maze])
    assert actor.card["algorithm"] == "PPO"
    reached = goals_reached(actor, maze, actor.card["action_repeat"], 3)
    idle = replace(actor, weights={name: value * 0 for name, value in actor.weights.items()})
    assert reached >= 11
    assert goals_reached(idle, maze, actor.card["action_repeat"], 3) < reached / 3


def test_every_first_person_maze_is_driven_by_an_actor_of_its_kinematics():
    actors = {name: shipped_actor(spec) for name, spec in MAZES.items() if spec.first_person}
    assert actors["compass_first_person"].card == actors["first_person"].card
    means = [actors[name].weights["mean.weight"] for name in ("first_person", "hard_first_person")]
    assert not np.array_equal(*means)


def test_a_maze_that_a_planner_drives_through_trains_no_actor(tmp_path):
    with pytest.raises(UserError, match="--maze is no_curtain, which a planner drives through"):
        train_first_person(FirstPersonConfig(tmp_path / "actor.safetensors", maze="no_curtain"))


def test_a_policy_of_no_decisions_is_refused(tmp_path):
    with pytest.raises(UserError, match="--decisions is 0"):
        train_first_person(FirstPersonConfig(tmp_path / "actor.safetensors", decisions=0))


def test_ppo_training_ends_in_an_actor_that_acts_like_its_policy(tmp_path):
    trained = train_first_person(FirstPersonConfig(tmp_path / "actor.safetensors", decisions=2000))
    stored = read_actor(tmp_path / "actor.safetensors")
    seen = np.array([0.3, -0.2, 1.0, 0.1], np.float32)
    np.testing.assert_array_equal(stored.act(seen), trained.act(seen))
    assert stored.card["decisions"] == 2048, "whole rounds of PPO"
    spread = [stored.act(seen, np.random.default_rng(i)) for i in range(50)]
    assert np.std(spread, axis=0).min() > 0.1


@pytest.mark.parametrize("kind", ["file", "folder", "dangling link", "link to itself"])
def test_a_policy_replaces_nothing_but_a_policy(tmp_path, kind):
    out = tmp_path / "actor.safetensors"
    if kind == "file":
        out.write_text("mine\n")
    elif kind == "folder":
        out.mkdir()
    else:
        out.symlink_to("nothing" if kind == "dangling link" else out.name)
    with pytest.raises(UserError, match=r"actor\.safetensors: is there already and holds no actor"):
        train_first_person(FirstPersonConfig(out, decisions=1))
    assert kind != "file" or out.read_text() == "mine\n"
