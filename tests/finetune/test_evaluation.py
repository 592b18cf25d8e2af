"""Evaluation episodes on a scripted environment: observations, memory, rewards and rows."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from finetune import evaluation
from finetune.evaluation import Episode, EpisodeJob, by_part, episode_rows, evaluate, evaluate_run
from tests.helpers_bad_input import rejection
from tests.nn.test_encoder import CARD
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.types import StepType, Windows
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.envs.corrupted import Observation
from vd4rl_pomdp.envs.pixels import TimeStep
from vd4rl_pomdp.nn import Encoder, EncoderConfig, save_encoder
from vd4rl_pomdp.nn.policy import Policy, load_policy
from vd4rl_pomdp.policies.actor import ASSETS, load_actor
from vd4rl_pomdp.report import tables
from vd4rl_pomdp.report.load import episodes_frame, load_runs
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
from vd4rl_pomdp.runs.files import read_json, write_json

LENGTH, REWARDS = 5, (1.0, 0.5, 0.25, 2.0, 8.0)


class ScriptedEnv:
    """Random images by seed, independent of actions; clean images are white."""

    def __init__(self, *arguments: object) -> None:
        self.seeds: list[tuple[int, int, int]] = []
        self.seen: list[list[torch.Tensor]] = []
        self.done: list[list[np.ndarray]] = []

    def reset(self, environment_seed: int, corruption_seed: int, episode: int) -> Observation:
        self.seeds.append((environment_seed, corruption_seed, episode))
        self._random = torch.Generator().manual_seed(environment_seed)
        self.seen.append([])
        self.done.append([])
        return self._show(0.0, StepType.FIRST)

    def step(self, action: np.ndarray) -> Observation:
        self.done[-1].append(action.copy())
        t = len(self.done[-1])
        return self._show(REWARDS[t - 1], StepType.LAST if t == LENGTH else StepType.MID)

    def _show(self, reward: float, step_type: StepType) -> Observation:
        obs = torch.randint(0, 256, (9, 84, 84), generator=self._random, dtype=torch.uint8)
        self.seen[-1].append(obs)
        state = np.full(24, len(self.done[-1]) / 10, np.float32)
        time_step = TimeStep(None, state, np.zeros(18), reward, 1.0, step_type)
        key = torch.tensor([len(self.done[-1])])
        return Observation(obs, torch.full_like(obs, 255), time_step, key)


@pytest.fixture
def world(monkeypatch) -> list[ScriptedEnv]:
    """Replaces the environments, and lists those that were made."""
    made: list[ScriptedEnv] = []
    monkeypatch.setattr(evaluation, "_environment", cache(lambda *a: (made.append(ScriptedEnv()), made[-1])[1]))
    return made


@pytest.fixture
def agent(tmp_path) -> tuple[Encoder, Policy]:
    torch.manual_seed(0)
    encoder = Encoder(EncoderConfig(6, "nature", 16, "gru", use_actions=True, hidden_dim=8)).eval()
    policy = Policy(8, 6, 8).eval()
    with torch.no_grad():
        policy.net[-1].weight.mul_(5)
    save_encoder(tmp_path / "encoder", encoder, CARD)
    policy.save(tmp_path / "policy")
    return encoder, policy


def play(folder: Path, *episodes: int, actor: Path | None = None) -> list[evaluation.Episode]:
    job = EpisodeJob(
        folder / "encoder", folder / "policy", TASKS["walker_walk"], CorruptionConfig.of("patch"), 0, film=False
    )
    return evaluate([replace(job, episode=episode, actor=actor) for episode in episodes], workers=1)


def test_evaluation_actions_match_window_encoding(world, agent, tmp_path):
    """Streamed encoding equals training's encoding of the whole window."""
    play(tmp_path, 0, 1)
    encoder, policy = agent
    for seen, done in zip(world[0].seen, world[0].done, strict=True):
        action = torch.from_numpy(np.stack(done))[None]
        window = Windows(
            obs=torch.stack(seen[:LENGTH])[None],
            prev_action=torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], 1),
            action=action,
            has_action=torch.ones(1, LENGTH, dtype=torch.bool),
            length=torch.tensor([LENGTH]),
            key=torch.zeros(1, LENGTH, dtype=torch.int64),
        )
        with torch.no_grad():
            torch.testing.assert_close(policy(encoder.encode(window)), action, atol=1e-5, rtol=1e-4)
    assert np.abs(np.diff(world[0].done, axis=1)).max() > 1e-3, "actions depend on the observations"


def test_evaluation_reloads_a_changed_policy(world, agent, tmp_path):
    play(tmp_path, 0)
    torch.manual_seed(1)
    Policy(8, 6, 8).save(tmp_path / "policy")
    play(tmp_path, 0)
    assert not np.allclose(world[0].done[0], world[0].done[1])
    (tmp_path / "policy" / "config.json").unlink()
    with pytest.raises(UserError, match=r"policy.config\.json: cannot be read as JSON"):
        play(tmp_path, 0)


def test_return_is_the_sum_of_rewards_and_score_a_tenth(world, agent, tmp_path):
    episodes = play(tmp_path, 0, 3)
    assert world[0].seeds == [(20_000, 20_000, 0), (20_003, 20_000, 3)]
    assert (episodes[0].total, len(episodes[0].rewards)) == (sum(REWARDS), LENGTH)
    for row, number in zip(episode_rows(episodes, {"task": "walker_walk"}), (0, 3), strict=True):
        assert (row["return"], row["score"], row["length"]) == (11.75, 1.175, LENGTH)
        assert (row["episode"], row["episode_seed"]) == (number, 20_000 + number)


def test_action_error_compares_with_actor_at_visited_states(world, agent, tmp_path):
    (without,) = play(tmp_path, 0)
    assert without.action_error is None
    (episode,) = play(tmp_path, 0, actor=ASSETS / "walker_walk_expert.safetensors")
    expert = load_actor("walker_walk", "expert")
    shown = [expert.act(np.full(24, t / 10, np.float32)) for t in range(LENGTH)]
    assert episode.action_error == pytest.approx(np.square(np.array(world[0].done[-1]) - shown).mean())
    assert np.abs(np.diff(shown, axis=0)).max() > 0.1, "states differ between rows"
    (row,) = episode_rows([episode], {"task": "walker_walk"})
    assert (row["evaluated_under"], row["action_error"]) == ("patch", round(episode.action_error, 6))


def test_reward_and_error_by_part_of_episode():
    whole = Episode("none", 0, [0.0, 1.0, 2.0, 3.0, 4.0], None, [0.1, 0.2, 0.3, 0.4, 0.5])
    short = Episode("none", 1, [6.0], None, [0.5])
    assert by_part([whole, short], 2) == {
        "0-1": {"reward": pytest.approx(7 / 3), "action_error": pytest.approx(0.8 / 3)},
        "2-4": {"reward": pytest.approx(3.0), "action_error": pytest.approx(0.4)},
    }
    assert list(by_part([whole], 99)) == ["0-0", "1-1", "2-2", "3-3", "4-4"], "no part is empty"
    assert by_part([Episode("none", 0, [1.0], None)], 1) == {"0-0": {"reward": 1.0, "action_error": None}}


def test_evaluate_uses_training_corruption_and_none_by_default(world, run, data, tmp_path, capsys):
    for asked, expected in ((None, ["patch+zero_frames", "none"]), ("patch", ["patch"])):
        rows, _ = evaluate_run(run, asked, 1, 1)
        assert [row["evaluated_under"] for row in rows] == expected
        assert {row["corruption"] for row in rows} == {"patch+zero_frames"}, "the training corruption"
    rest = ["--parts", "2", "--out", str(tmp_path / "rows.csv")]
    main(["evaluate", str(run), "--episodes", "1", "--workers", "1", *rest])
    shown = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert shown["data_return"] == f"{open_dataset(data).returns.mean():.6g}"
    assert (shown["path_error"], shown["under.none.action_error"]) == ("unknown", "unknown")
    halves = [float(shown[f"under.none.parts.{part}.reward"]) for part in ("0-1", "2-4")]
    assert halves == pytest.approx([np.mean(REWARDS[:2]), np.mean(REWARDS[2:])], rel=1e-5)
    written = read_episodes(tmp_path / "rows.csv")
    for row in written:
        assert shown[f"under.{row['evaluated_under']}.return_mean"] == f"{row['return']:.6g}"
        assert shown[f"under.{row['evaluated_under']}.share_above_80"] == "0"
    main(["evaluate", str(run), "--episodes", "1", "--workers", "1", "--corruption", "none", "--json"])
    (only,) = json.loads(capsys.readouterr().out)["under"].items()
    assert (only[0], only[1]["episodes"]) == ("none", written[1:])


def test_evaluate_accepts_corruption_options(world, run, tmp_path, monkeypatch):
    """The run was trained under patch+zero_frames, patches of 16 pixels."""
    jobs, play_all = [], evaluation.evaluate
    monkeypatch.setattr(evaluation, "evaluate", lambda given, workers: jobs.extend(given) or play_all(given, workers))
    played = {
        "patch": "patch",
        "patch --patch-size 24": "patch, patch_size 24",
        "patch --patch-size 16": "patch",
        "patch --patch-count 2 --patch-shared": "patch, patch_count 2, patch_shared yes",
        "patch+zero_frames --keep-newest": "patch+zero_frames, keep_newest yes",
        "truncate --kept oldest": "truncate, kept oldest",
        "patch+truncate": "patch+truncate",
    }
    rest = ["--episodes", "1", "--workers", "1", "--out", str(tmp_path / "rows.csv")]
    for words in played:
        main(["evaluate", str(run), "--corruption", *words.split(), *rest])
    rows = read_episodes(tmp_path / "rows.csv")
    assert [row["evaluated_under"] for row in rows] == list(played.values())
    assert {row["corruption"] for row in rows} == {"patch+zero_frames"}, "the training corruption"
    assert (jobs[1].corruption.stages[0].patch_size, jobs[5].corruption.stages[0].kept) == (24, "oldest")
    for words, message in (
        ("patch --kept oldest", "Unrecognized options: --kept"),
        ("patch --patch-size 85", "patch size 85 exceeds the image"),
        ("patch --patch-size 0", "--patch-size is 0"),
        ("truncate --kept middle", "--kept"),
    ):
        assert message in rejection(["evaluate", str(run), "--corruption", *words.split()])
    with pytest.raises(UserError, match="--patch-sise is not read by the corruption patch"):
        evaluate_run(run, "patch", 1, 1, patch_sise=3)


def test_keep_stores_rows_under_another_corruption_once(world, run, tmp_path, monkeypatch):
    before = read_episodes(run / "episodes.csv")
    words = ["evaluate", str(run), "--episodes", "2", "--workers", "1", "--keep"]
    for option in ([], ["--patch-size", "24"]):
        main([*words, "--corruption", "patch", *option])
    rows = read_episodes(run / "episodes.csv")
    assert rows[: len(before)] == before
    assert [row["evaluated_under"] for row in rows[len(before) :]] == ["patch"] * 2 + ["patch, patch_size 24"] * 2
    for wrong, message in (
        (["--corruption", "patch"], "episodes.csv already has 2 episodes under patch; leave --keep out"),
        ([], "--keep needs --corruption"),
    ):
        assert message in rejection([*words, *wrong])
    found = tables.elsewhere(episodes_frame(load_runs([run])))
    assert found["evaluated_under"].tolist() == ["patch", "patch, patch_size 24"]
    assert found["score"].tolist() == pytest.approx([1.175, 1.175])
    play_all = evaluation.evaluate

    def meanwhile(*jobs):  # another process stores rows of the same corruption
        append_episodes(run / "episodes.csv", [rows[-1] | {"evaluated_under": "truncate"}])
        return play_all(*jobs)

    monkeypatch.setattr(evaluation, "evaluate", meanwhile)
    rejection([*words, "--corruption", "truncate"])
    assert [row["evaluated_under"] for row in read_episodes(run / "episodes.csv")].count("truncate") == 1
    (run / "timing.json").unlink()
    with pytest.raises(UserError, match="is not finished"):
        evaluation.refuse_kept(run, "truncate")


def test_other_corruption_inherits_options_and_length_of_the_run(world, run, monkeypatch):
    card = read_json(run / "encoder" / "config.json")
    card["pretrain"]["corruption"] |= {"patch_size": 40, "corruption_mode": "emission"}
    write_json(run / "encoder" / "config.json", card)
    jobs = []
    monkeypatch.setattr(evaluation, "evaluate", lambda given, workers: jobs.extend(given) or [])
    evaluate_run(run, "patch", 1, 1)
    assert [job.corruption for job in jobs] == [CorruptionConfig.of("patch", "emission", patch_size=40)]
    assert [job.length for job in jobs] == [2]


def test_evaluation_step_is_that_of_the_policy(world, run):
    """A run cut in its evaluation has a policy without rows."""
    load_policy(run / "policy").save(run / "policy", step=7)
    assert [row["step"] for row in evaluate_run(run, None, 1, 1)[0]] == [7, 7]


def test_invalid_evaluations_change_no_file(world, run, encoder, tmp_path):
    with pytest.raises(UserError, match="unknown corruption 'fog'"):
        evaluate_run(run, "fog", 1, 1)
    with pytest.raises(UserError, match="holds no evaluated run"):
        evaluate_run(encoder.parent, None, 1, 1)
    thesis = tmp_path / "thesis.csv"
    thesis.write_text("a,b\n1,2\n")
    with pytest.raises(UserError, match="has no column 'method'"):
        append_episodes(thesis, [])
    assert thesis.read_text() == "a,b\n1,2\n"
