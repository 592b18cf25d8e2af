import csv
import importlib
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from finetune.evaluation import EVALUATION_SEED, Agent
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.policies.actor import load_actor

SCRIPTS = Path(__file__).parents[2] / "tools"


def test_the_actor_acts_first_and_the_policy_remembers_its_actions(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("hand_over")
    torch.manual_seed(0)
    encoder = Encoder(EncoderConfig(6, frame_encoder="nature", history="gru", use_actions=True, hidden_dim=8)).eval()
    agent, expert = Agent(encoder, Policy(8, 6, 8).eval()), load_actor("walker_walk", "expert")
    executed, remembered = [], []
    env = CorruptedEnv(TASKS["walker_walk"], CorruptionConfig.of("none"), length=60)
    step, act = env.step, agent.act
    env.step = lambda action: (executed.append(action), step(action))[1]
    agent.act = lambda obs: (remembered.append(agent._action[0].numpy().copy()), act(obs))[1]
    result = script.play(agent, expert, env, TASKS["walker_walk"], after=59, episode=0)
    assert len(executed) == 60
    np.testing.assert_array_equal(remembered[1:], executed[:-1])

    watched = CorruptedEnv(TASKS["walker_walk"], CorruptionConfig.of("none"), length=60)
    now = watched.reset(20_000, 20_000, 0)
    for action in executed[:59]:
        np.testing.assert_array_equal(action, expert.act(now.time_step.state))
        now = watched.step(action)
    shown = expert.act(now.time_step.state)
    assert not np.allclose(executed[59], shown)
    assert result["error_after"] == round(float(np.square(executed[59] - shown).mean()), 4)
    assert result["reward"] == round(float(watched.step(executed[59]).time_step.reward), 4)

    with pytest.raises(UserError, match="--after is 60, and an episode has 60 decisions"):
        script.play(agent, expert, env, TASKS["walker_walk"], after=60, episode=0)


def test_who_hands_over_is_the_actor_of_the_data(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script, medium = importlib.import_module("hand_over"), load_actor("cheetah_run", "medium")
    Reference(294.0, {"task": "cheetah_run", "quality": "medium", "sha256": medium.sha256}).write(tmp_path)
    assert script.actor_of(tmp_path).sha256 == medium.sha256
    Reference(294.0).write(tmp_path)
    with pytest.raises(UserError, match="the one actor of its data is not known"):
        script.actor_of(tmp_path)


def test_actors_on_noisy_states_play_their_own_episodes_and_lose_return(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("noisy_states")
    noises = {"pose_noises": (0, 34), "velocity_noises": (0, 49)}
    script.main(script.Config(("cheetah_run",), **noises, episodes=2, out=tmp_path / "table.csv"))
    with (tmp_path / "table.csv").open() as file:
        rows = [(row["actor"], row["pose_noise"], float(row["return"])) for row in csv.DictReader(file)]
    for actor, mine in (("expert", rows[:4]), ("medium", rows[4:])):
        exact = importlib.import_module("export_actor").episode_returns(
            load_actor("cheetah_run", actor), TASKS["cheetah_run"], 2, EVALUATION_SEED
        )
        assert mine[:2] == [(actor, "0", round(value, 4)) for value in exact]
        assert all(row[:2] == (actor, "34") and row[2] < 0.8 * exact[0] for row in mine[2:])
    assert all(value < 0.2 * rows[0][2] for *_, value in rows[2:4]), "the expert's gait asks for more than the medium's"
    alone, noisy = (line.split(": ")[1].split() for line in capsys.readouterr().out.splitlines()[:2])
    assert float(noisy[0]) > 2 * float(alone[0]), "falls, which only the noisy episodes have, vary the height"


def test_another_python_makes_the_environment_anew(tmp_path):
    """With interpreters that only say their version, note what they make, and agree to all else."""
    (tmp_path / "tools").mkdir()
    shutil.copy(SCRIPTS / "setup.sh", tmp_path / "tools")
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    for number in (11, 12):
        python = tmp_path / f"python3.{number}"
        make = f"mkdir -p .venv/bin; cp {python} .venv/bin/python; echo {number} >>{tmp_path}/made"
        python.write_text(f'#!/bin/sh\ncase "$*" in -V) echo Python 3.{number}.0;; "-m venv"*) {make};; esac\n')
        python.chmod(0o755)

    def made_after(**chosen):
        environment = {name: value for name, value in os.environ.items() if name != "PYTHON"}
        subprocess.run(["bash", "tools/setup.sh"], cwd=tmp_path, env=environment | chosen, check=True)
        return (tmp_path / "made").read_text().split()

    one, other = ({"PYTHON": str(tmp_path / f"python3.{number}")} for number in (11, 12))
    assert made_after(**one) == made_after(**one) == ["11"]
    assert made_after(**other) == made_after() == ["11", "12"]


def test_pages_show_the_tables_that_their_rows_make(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("page_tables")
    pages = {page: {name: list(lines) for name, lines in tables.items()} for page, tables in script.pages().items()}
    assert all(tables and all(len(lines) > 3 for lines in tables.values()) for tables in pages.values())
    for page, tables in pages.items():
        text = (SCRIPTS.parent / page).read_text()
        assert script.with_tables(text, tables, page) == text, f"{page}: run `python tools/page_tables.py`"


def test_a_table_takes_the_place_of_the_one_under_its_mark(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("page_tables")
    page = "a\n\n<!-- table: one -->\n| old |\n| older |\n\n| not it |\n<!-- table: other -->\nend"
    written = script.with_tables(page, {"other": ["| 2 |"], "one": ["| 1 |"]}, "page.md")
    assert written == "a\n\n<!-- table: one -->\n| 1 |\n\n| not it |\n<!-- table: other -->\n| 2 |\nend"
    with pytest.raises(UserError, match=r"^page.md: one line `<!-- table: new -->` is wanted, .* belongs; 0 found$"):
        script.with_tables(page, {"new": ["| 3 |"]}, "page.md")
