"""The documentation's example of user-defined tasks is executed in all stages."""

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from finetune.config import FinetuneConfig
from finetune.evaluation import Episode, episode_rows, evaluate_run
from finetune.train import finetune as run_finetune
from pretrain.config import PretrainConfig
from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import read_shard
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.data import View, open_dataset
from vd4rl_pomdp.data.check import check_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.report.page import write_report
from vd4rl_pomdp.runs.episodes import read_episodes

PAGE = Path(__file__).parents[1] / "docs" / "add_a_task.md"
CODE = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]


@pytest.fixture
def tasks():
    with TASKS.isolated():
        exec(compile(CODE, "my_task.py", "exec"), {"__name__": "my_task"})
        yield TASKS


def test_documented_task_runs_in_all_stages(tasks, tmp_path):
    """Fine-tuning runs as a script, whose worker processes import the task; other stages run in this process."""
    script, data, runs = tmp_path / "my_task.py", tmp_path / "centre" / "random", tmp_path / "runs"
    script.write_text(CODE)
    for line in (
        f"data collect --task centre --quality random --frame-size 64 --out {data} --episodes 3 --workers 1",
        f"data check {data}",
        f"pretrain --method mik+a --corruption patch --preset smoke --data {data} --out {runs}/pretrain",
        f"finetune --encoder {runs}/pretrain/encoder --preset smoke --data {data} --out {runs}/finetune --workers 2",
        f"report {runs} --out {tmp_path}/report",
    ):
        if "--workers 2" not in line:
            main(line.split())
            continue
        command = [sys.executable, str(script), *line.split()]
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=False)
        assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "report" / "summary.csv").open()))
    assert [(row["method"], row["task"]) for row in rows] == [("mik+a", "centre")]


def trained(data: Path, out: Path, method: str = "mik+a", **settings: object) -> FinetuneConfig:
    """Pretrain at smoke size, and return a fine-tuning config for the encoder."""
    encoder = run_pretrain(PretrainConfig.of("smoke", data=data, out=out / "pretrain", method=method)).path / "encoder"
    return FinetuneConfig.of("smoke", encoder=encoder, data=data, out=out / "run", workers=1, **settings)


def test_dm_control_task_of_another_frame_size_runs_in_all_stages(tasks, tmp_path):
    name, size, data = "cartpole_swingup", 64, tmp_path / "cartpole_swingup" / "random"
    collect(CollectConfig(name, "random", data, episodes=3, workers=1, frame_size=size), 8)
    checked = check_dataset(data)
    assert (checked["task"], checked["frame_size"]) == (name, size)
    assert checked["replay_max_error"] == 0.0
    run = run_finetune(trained(data, tmp_path / "runs")).path
    assert load_encoder(run / "encoder")[0].config.size == size
    assert {row["task"] for row in read_episodes(run / "episodes.csv")} == {name}
    assert {row["task"] for row in evaluate_run(run, "patch", 1, 1)[0]} == {name}
    assert np.load(run / "film.npz")["corrupted"].shape[1:] == (9, size, size)
    assert (run / "probe.json").exists()
    write_report([tmp_path / "runs"], tmp_path / "report")
    assert (tmp_path / "report" / "index.html").exists()


def test_state_reference_needs_simulator_states(tasks, tmp_path):
    for name in ("cartpole_swingup", "centre"):
        collect(CollectConfig(name, "random", tmp_path / name, episodes=2, workers=1, frame_size=32), 8)
    config = PretrainConfig.of("smoke", method="state", out=tmp_path / "run", data=tmp_path)
    run = run_pretrain(replace(config, data=tmp_path / "cartpole_swingup"))
    # position of the cart, sine and cosine of the pole's angle, two velocities
    assert load_encoder(run.path / "encoder")[0].config.channels == 5
    with pytest.raises(UserError, match="centre: stores no simulator states"):
        run_pretrain(replace(config, data=tmp_path / "centre", out=tmp_path / "none"))


def test_termination_is_stored_in_the_last_row(tasks, tmp_path):
    tasks.register("fast", replace(tasks["centre"], arguments={"speed": 0.2}))
    (shard,) = collect(CollectConfig("fast", "random", tmp_path / "set", episodes=30, workers=1, frame_size=16), 30)
    rows = read_shard(shard)
    starts = np.flatnonzero(rows["step_type"] == 0)
    lengths = np.diff([*starts, len(rows["reward"])])
    ended = lengths < 31
    assert 0 < ended.sum() < 30, "some episodes terminate, some reach the time limit"
    last = starts + lengths - 1
    assert (rows["step_type"][last] == 2).all()
    assert (rows["discount"][last] == np.where(ended, 0.0, 1.0)).all()
    assert (np.delete(rows["discount"], last) == 1).all()
    assert "physics" not in rows
    assert (rows["reward"][last][ended] > 0.8).all(), "terminal rows have the largest reward"
    dataset = open_dataset(tmp_path / "set")
    assert View(dataset).transitions([int(lengths[0]) - 2]).discount.item() == (0.0 if ended[0] else 1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quality": "expert"}, "centre has no states for an actor to read: use --quality random"),
        ({"quality": "medium_replay"}, "centre has no states"),
        ({"task": "cartpole_swingup", "quality": "expert"}, "no expert actor ships for cartpole_swingup .*train_actor"),
        ({"task": "cartpole_swingup", "quality": "expert_noisy"}, "has no action_noise: .*--action-noise"),
        ({"frame_size": 15}, "--frame-size is 15; it must be at least 16 and at most 480"),
    ],
)
def test_impossible_collections_write_nothing(tasks, tmp_path, changes, message):
    config = replace(CollectConfig("centre", "random", tmp_path / "set"), **changes)
    with pytest.raises(UserError, match=message):
        collect(config)
    assert not (tmp_path / "set").exists()


def test_too_small_frames_are_rejected_before_training(tasks, tmp_path):
    data = tmp_path / "centre"
    collect(CollectConfig("centre", "random", data, episodes=2, workers=1, frame_size=16), 8)
    for changes, message in (
        ({"corruption": "patch", "patch_size": 17}, r"patch size 17 exceeds the image \(16x16\)"),
        ({"shift": 16}, "--shift is 16; it must be at least 0 and at most 15"),
        ({"frame_encoder": "nature"}, "frame encoder 'nature' cannot read images of 16x16 pixels"),
    ):
        with pytest.raises(UserError, match=message):
            run_pretrain(PretrainConfig.of("smoke", data=data, out=tmp_path / "run", **changes))
        assert not (tmp_path / "run").exists()


def test_evaluation_is_not_longer_than_the_task(tasks, tmp_path):
    tasks.register("short", replace(tasks["centre"], decisions=9))
    data = tmp_path / "short"
    collect(CollectConfig("short", "random", data, episodes=3, workers=1, frame_size=50))
    assert {len(part) for part in np.split(open_dataset(data).t, 3)} == {10}
    run = run_finetune(trained(data, tmp_path, "random", eval_length=500))
    assert {row["length"] for row in read_episodes(run.path / "episodes.csv")} == {9}


def test_evaluation_covers_whole_episodes_of_long_tasks(tasks, tmp_path):
    tasks.register("long", replace(tasks["centre"], arguments={"speed": 0.0}, decisions=510))
    data = tmp_path / "long"
    collect(CollectConfig("long", "random", data, episodes=2, workers=1, frame_size=50), 60)
    config = trained(data, tmp_path, "random", updates=2, eval_every=2, eval_length=500, eval_clean=False)
    run = run_finetune(config)
    assert run_finetune(config).finished, "the same command finds the finished run"
    assert {row["length"] for row in read_episodes(run.path / "episodes.csv")} == {510}
    assert json.loads((run.path / "config.json").read_text())["config"]["eval_length"] == 510
    assert {row["length"] for row in evaluate_run(run.path, None, 1, 1)[0]} == {510}


def test_score_uses_the_tasks_divisor(tasks):
    tasks.register("games", replace(tasks["centre"], score_divisor=4.0))
    (row,) = episode_rows([Episode("none", 0, [2.0], None)], {"task": "games"})
    assert (row["return"], row["score"]) == (2.0, 0.5)


def test_registered_tasks_have_gymnasium_ids(tmp_path):
    script = tmp_path / "ids.py"
    script.write_text(
        CODE.partition("\nif __name__")[0]
        + "import vd4rl_pomdp.envs\n"
        + "env = gymnasium.make('vd4rl_pomdp/Centre-Patch16-v0', frame_size=32)\n"
        + "print(env.reset(seed=0)[0].shape, env.spec.max_episode_steps)\n"
        + "print(gymnasium.spec('vd4rl_pomdp/CartpoleSwingup-ZeroFrames-v0').max_episode_steps)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["(9, 32, 32) 200", "500"]


def test_changed_task_code_does_not_resume_a_collection(tmp_path):
    file, config = tmp_path / "my_task.py", CollectConfig("centre", "random", tmp_path / "set", episodes=2, workers=1)
    config = replace(config, episodes_per_shard=1, frame_size=50)

    def collect_by(text):
        file.write_text(text)
        with TASKS.isolated():
            exec(compile(text, file, "exec"), {"__name__": "my_task"})
            return collect(config, 8)

    first, second = collect_by(CODE)
    sources = json.loads((tmp_path / "set" / "collection.json").read_text())["sources"]
    assert sources == {"task centre": f"my_task.py {sha256(CODE.encode()).hexdigest()[:12]}"}
    assert collect_by(CODE + "# changed\n") == [first, second], "a complete dataset is accepted"
    for path in (second, tmp_path / "set" / "provenance.json"):
        path.unlink()
    with pytest.raises(UserError, match=r"set: is unfinished, and the code of task centre has changed since"):
        collect_by(CODE + "# changed\n")
    assert collect_by(CODE) == [first, second]
