import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vd4rl_pomdp.data import table as module
from vd4rl_pomdp.data.collect import CollectConfig, _job, _plan, _roll_out, actor_hashes, replay_returns


@pytest.fixture
def played(monkeypatch):
    """Episodes are not played here: each returns its number; returns what was asked for."""
    asked = []

    def fake(config):
        asked.append((config.task, config.quality))
        return [float(i) for i in range(config.episodes)]

    monkeypatch.setattr(module, "replay_returns", fake)
    monkeypatch.setattr(module, "EPISODES", 3)
    cost = {"episodes": 2, "rows": 1000, "cpu_seconds": "20.0", "commit": ""}
    monkeypatch.setattr(module, "_cost", lambda task, episodes: {"task": task} | cost)
    return asked


def test_the_table_holds_every_set_that_can_be_made(played, tmp_path):
    rows = module.tabulate(tmp_path, ["walker_walk"], ["random", "expert"], 2, 1)
    expected = {"episodes": 3, "mean": "1.0", "min": "0.0", "max": "2.0", "seconds_100k": 1000}
    assert rows == [{"task": "walker_walk", "quality": quality} | expected for quality in ("random", "expert")]
    with (tmp_path / "returns.csv").open() as file:
        assert [row["return"] for row in csv.DictReader(file)] == ["0.0", "1.0", "2.0"] * 2


def test_what_is_in_the_table_is_not_played_again(played, tmp_path, monkeypatch):
    module.tabulate(tmp_path, ["walker_walk"], ["random"], 2, 1)
    monkeypatch.setattr(module, "ships", lambda task, quality: quality != "expert")
    rows = module.tabulate(tmp_path, ["walker_walk"], ["random", "medium", "expert"], 2, 1)
    assert played == [("walker_walk", "random"), ("walker_walk", "medium")]
    assert [row["quality"] for row in rows] == ["random", "medium"]


def test_a_set_whose_actor_has_changed_is_played_again(played, tmp_path, monkeypatch):
    module.tabulate(tmp_path, ["walker_walk"], ["random", "expert"], 2, 1)
    monkeypatch.setattr(module, "actor_hashes", lambda config: ["new"] if config.quality == "expert" else [])
    monkeypatch.setattr(module, "replay_returns", lambda config: [7.0] * config.episodes)
    rows = module.tabulate(tmp_path, ["walker_walk"], ["random", "expert"], 2, 1)
    assert [(row["quality"], row["episodes"], row["mean"]) for row in rows] == [
        ("random", 3, "1.0"),
        ("expert", 3, "7.0"),
    ]


def test_the_published_table_is_by_the_actors_that_ship():
    table = Path(__file__).parents[2] / "results" / "datasets"
    recorded = json.loads((table / "actors.json").read_text())
    with (table / "sets.csv").open() as file:
        sets = [(row["task"], row["quality"]) for row in csv.DictReader(file)]
    assert set(recorded) == {" ".join(names) for names in sets}
    shipped = {" ".join(names): actor_hashes(CollectConfig(*names, Path(), 200)) for names in sets}
    assert recorded == shipped


def test_physics_alone_gives_the_rewards_of_the_rendered_episodes(tmp_path):
    config = CollectConfig("walker_walk", "medium_replay", tmp_path, episodes=2, workers=1)
    _, episodes, policy = next(iter(_plan(config)))
    for episode in episodes:
        job = _job(config, policy, episode, 6)
        rendered, played = _roll_out(job), _roll_out(replace(job, size=None))
        assert "observation" in rendered
        assert "observation" not in played
        for key, value in played.items():
            np.testing.assert_array_equal(value, rendered[key])


def test_all_episodes_of_a_set_are_played(tmp_path):
    config = CollectConfig("walker_walk", "random", tmp_path / "set", episodes=2, workers=1)
    returns = replay_returns(config)
    assert len(set(returns)) == 2
    assert not (tmp_path / "set").exists()
