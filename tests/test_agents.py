"""Exported agents reproduce the episodes of their cards; damaged and unknown ones are rejected."""

import io
import multiprocessing
import os
import shutil
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

import finetune.export as finetune_export
from finetune.evaluation import EVALUATION_SEED
from finetune.export import replay_agent
from finetune.train import finetune
from tests.helpers_bad_input import rejection
from tests.helpers_report import pretraining
from tests.helpers_stages import smoke_finetune
from tests.runs.results.test_results import whole_run
from vd4rl_pomdp import load_agent
from vd4rl_pomdp.agents import FILES, SHIPPED, checksums, shipped
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.report.films import side_by_side
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.provenance import machine
from vd4rl_pomdp.runs.results import read_run


def interrupted(*arguments):
    raise KeyboardInterrupt


def test_agent_copies_its_last_action():
    agent = load_agent("walker_walk/medium_expert/patch+zero_frames/mik+a")
    pictures = np.random.default_rng(0).integers(0, 256, (3, 9, 84, 84), dtype=np.uint8)

    def last_action(spoil, executed=None):
        agent.reset()
        for picture in pictures:
            action = agent.act(picture)
            chosen = action.copy()
            if spoil:
                action *= 0
            if executed is not None:
                agent.set_last_action(executed(buffer := np.full(6, 0.25)))
                buffer *= spoil
        return chosen.tolist()

    assert last_action(spoil=True) == last_action(spoil=False)
    expected = last_action(spoil=False, executed=list)
    assert expected != last_action(spoil=False)
    for executed in (np.asarray, np.float32, torch.tensor):
        assert last_action(spoil=True, executed=executed) == expected
    with pytest.raises(UserError, match="6 finite numbers"):
        agent.set_last_action(np.zeros(3))


def test_exported_agent_reproduces_episodes_of_its_card(data, encoder, tmp_path, capsys, monkeypatch):
    run = finetune(smoke_finetune(encoder, data, tmp_path / "run", eval_length=6)).path
    out = tmp_path / "agents" / "mine"
    with monkeypatch.context() as patch:
        patch.setattr("finetune.export.evaluate", interrupted)
        with pytest.raises(SystemExit):
            main(["agents", "export", str(run), "--out", str(out)])
    assert "re-run the same command" in capsys.readouterr().err
    assert not out.parent.exists()
    words = ["agents", "export", str(run), "--out", str(out), "--episodes", "2", "--workers", "1"]

    def killed() -> None:
        finetune_export.evaluate = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
        main(words)

    child = multiprocessing.get_context("fork").Process(target=killed)
    child.start()
    child.join()
    assert (child.exitcode, out.exists()) == (-signal.SIGKILL, False), "a part of an agent is none"
    main(words)
    assert [path.name for path in out.parent.iterdir()] == ["mine"], "what the killed process left is gone"
    assert f'agent: {out}, loaded by vd4rl_pomdp.load_agent("{out}")' in capsys.readouterr().out
    agent = load_agent(str(out))
    card = agent.card
    source = read_run(run)
    assert (card["run"], card["seed"], card["method"]) == (source.id, 0, "mik+a")
    assert card["data"] == source.record["inputs"]["data"]
    assert card["budget"]["finetuning"]["updates"] == source.files["timing"]["updates"]
    assert [row["evaluated_under"] for row in card["episodes"]] == ["patch+zero_frames"] * 2 + ["none"] * 2
    for row in card["episodes"]:
        corruption = CorruptionConfig.fill(card["corruption"] | {"corruption": row["evaluated_under"]})
        env = CorruptedEnv(TASKS[card["task"]], corruption, length=card["length"])
        now, rewards = env.reset(row["episode_seed"], EVALUATION_SEED, row["episode"]), []
        agent.reset()
        while not now.time_step.last:
            now = env.step(agent.act(now.obs.numpy()))
            rewards.append(now.time_step.reward)
        assert (round(float(np.cumsum(rewards)[-1]), 4), len(rewards)) == (row["return"], row["length"])
    film = tmp_path / "new" / "film.webp"
    longer = shutil.copytree(out, tmp_path / "longer")  # as exported from a run with a larger --eval-length
    write_json(longer / "card.json", card | {"length": 12})
    main(["agents", "play", str(out), str(longer), "--episodes", "2", "--film", str(film), "--workers", "1"])
    head, first, second, less, written = capsys.readouterr().out.splitlines()
    assert head.startswith(f"2 episodes of {card['task']} under patch+zero_frames")
    mean = np.mean([row["return"] for row in card["episodes"][:2]])
    values = [line.split(f"  {path}")[1] for line, path in ((first, out), (second, longer))]  # of one method and seed
    assert values[0] == values[1]
    assert values[0].split("[")[0].split() == [f"{mean:.0f}"]
    assert (less.split()[-1], written) == ("0", f"film: {film}"), "no interval without a difference"
    with Image.open(film) as moving:
        assert (moving.n_frames, moving.size) == (2, (4 * 172, 2 * 194))
    for name in FILES:
        if name.endswith(".safetensors"):
            whole, half = load_file(run / name), load_file(out / name)
            assert all(torch.equal(half[key], value.half()) for key, value in whole.items())
            assert (out / name).stat().st_size < 0.55 * (run / name).stat().st_size
    assert f"{out}: is not empty (holds" in rejection(["agents", "export", str(run), "--out", str(out)])
    for film, message in (
        (tmp_path, "ends in .webp"),
        (tmp_path / "film.gif", "ends in .webp"),
        (run / "film.webp", "lies inside"),
    ):
        assert message in rejection(["agents", "play", str(out), "--film", str(film)])
    for name in FILES:
        whole = (out / name).read_bytes()
        (out / name).write_bytes(whole + b" ")
        with pytest.raises(UserError, match=r"its files do not match card\.json"):
            load_agent(out)
        (out / name).write_bytes(whole)
    damages = [{"sha256": None}, {"quality": "medium"}, {"data": "f00"}, {"method": "acro"}, {"task": "cheetah_run"}]
    pretraining = card["budget"]["pretraining"]
    damages += [{"budget": {"pretraining": pretraining | {name: 7}}} for name in ("seed", "steps")]
    for damaged in damages:
        write_json(out / "card.json", card | damaged)
        with pytest.raises(UserError, match=r"its files do not match card\.json"):
            load_agent(out)
    of_encoder = {"pretraining": pretraining | {name: card[name] for name in ("data", "quality")}}
    write_json(out / "card.json", card | {"data": "f00", "quality": "medium", "budget": of_encoder})
    assert load_agent(out).card["data"] == "f00", "a policy trained on other data than its encoder"
    for name in ("task", "method", "corruption", "quality", "data", "seed", "length", "budget"):
        without = {key: value for key, value in card.items() if key != name}
        for damaged, value in ((without, None), (card | {name: 0.5}, 0.5)):
            write_json(out / "card.json", damaged)
            line = rejection(["agents", "play", str(out), "--episodes", "1"])
            assert f"{out / 'card.json'}: its {name} is {value}; use another copy" in line


def test_play_prints_return_of_first_agent_less_that_of_each_other(monkeypatch, capsys):
    cards = [{"task": "", "method": "mik+a", "seed": seed, "corruption": {"corruption": "none"}} for seed in range(2)]
    played = [[SimpleNamespace(total=total) for total in totals] for totals in ((30.0, 40.0), (10.0, 24.0))]
    monkeypatch.setattr("finetune.export.play_agents", lambda *_: (cards, played))
    main(["agents", "play", "one", "other"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if " less " in line)
    assert line.split("[")[0].split() == ["mik+a,", "seed", "0", "less", "mik+a,", "seed", "1", "18"]


def test_film_of_agents_with_different_frame_sizes():
    shapes = [{"clean": (2, 3, size, size), "corrupted": (2, 9, size, size), "return": (2,)} for size in (84, 48)]
    films = [{name: np.zeros(shape, np.uint8) for name, shape in one.items()} for one in shapes]
    with Image.open(io.BytesIO(side_by_side(["large", "small"], films))) as moving:
        assert moving.size == (4 * (2 * 84 + 4), 2 * 84 + 26 + 2 * 48 + 26)


def test_only_finished_finetuning_runs_are_exported(tmp_path):
    (tmp_path / "empty").mkdir()
    (whole_run(tmp_path / "cut") / "timing.json").unlink()
    pretraining(tmp_path / "pretrained")
    for name, message in (
        ("cut", "is not a finished fine-tuning run"),
        ("pretrained", "is not a finished"),
        ("empty", "is not a run"),
    ):
        assert message in rejection(["agents", "export", str(tmp_path / name), "--out", str(tmp_path / "new")])
    assert not (tmp_path / "new").exists()


def test_unknown_agent_lists_shipped_ones(tmp_path):
    with pytest.raises(UserError) as message:
        load_agent("walker_walk/medium_expert/patch/mine")
    assert f"or a shipped agent ({', '.join(shipped()) or 'none'})" in str(message.value)


def test_shipped_agents_reproduce_their_first_episode():
    for name in shipped():
        card = load_agent(name).card
        assert name.startswith(f"{card['task']}/{card['quality']}/{card['corruption']['corruption']}/{card['method']}")
        if (card["render"], card["processor"]) == (render_info(card["task"]), machine("cpu")["processor"]):
            assert replay_agent(SHIPPED / name) == card["episodes"][0]


@pytest.mark.parametrize("name", shipped())
def test_batches_of_observations_are_rejected(name):
    agent = load_agent(name)
    obs = np.zeros((agent.encoder.config.channels, agent.picture_size, agent.picture_size), np.uint8)
    with pytest.raises(UserError, match="add or remove leading dimensions"):
        agent.act(obs[None])
    with pytest.raises(UserError, match="agents read uint8 pixels from 0 to 255, not torch"):
        agent.act(obs / np.float32(255))
    assert agent.act(obs).shape == (6,)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("encoder", lambda config: config.update(pretrain="method"), "its files do not match card.json"),
        ("encoder", lambda config: config["pretrain"].update(corruption={}), r"\(config.json: no 'corruption'\)"),
        ("policy", lambda config: config.update(hidden=10**6), "not a policy folder .*loading state_dict for Policy"),
    ],
)
def test_agents_of_odd_configs_are_rejected(tmp_path, name, change, message):
    folder = shutil.copytree(SHIPPED / shipped()[0], tmp_path / "agent")
    config = read_json(folder / name / "config.json")
    change(config)
    write_json(folder / name / "config.json", config)
    card = read_json(folder / "card.json") | {"sha256": checksums(folder)}
    if config.get("pretrain") and "corruption" in config["pretrain"]:
        card["corruption"] = config["pretrain"]["corruption"]
    write_json(folder / "card.json", card)
    with pytest.raises(UserError, match=message):
        load_agent(folder)
