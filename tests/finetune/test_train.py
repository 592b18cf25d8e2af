"""Fine-tuning: resumption, results and metrics of a run."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from finetune import trainer
from finetune.algorithms.td3_bc import TD3BC
from finetune.features import FrozenEncoder
from finetune.train import finetune as run_finetune
from finetune.trainer import RESULTS
from pretrain.train import pretrain as run_pretrain
from tests.finetune.conftest import BRIEF
from tests.helpers_data import write_fake_set
from tests.helpers_stages import CutError, contents, run_until_cut, smoke_finetune, smoke_pretrain
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.results import find_results

CORRUPTION = "patch+zero_frames"
"""The pretraining corruption of `encoder`."""


def finetune_cut_and_whole(monkeypatch, encoder: Path, data: Path, out: Path, **changes: object) -> Path:
    """Fine-tune uninterrupted, and again with a cut at the second checkpoint; assert equality; return the first run."""
    whole = run_finetune(smoke_finetune(encoder, data, out / "whole", **changes))
    cut = smoke_finetune(encoder, data, out / "cut", **changes)
    run_until_cut(monkeypatch, 2, run_finetune, cut)
    run_finetune(cut)
    assert contents(out / "cut") == contents(whole.path)
    return whole.path


def test_exact_batches_resume_bit_exactly(encoder, data, tmp_path, monkeypatch):
    """`test_interruptions.py` covers cached features, `check_algorithm` the updates of every algorithm."""
    changes = {"views": 0, "eval_length": 2, "updates": 12, "eval_every": 6}
    changes |= {"checkpoint_every": 4, "batch_size": 4}
    monkeypatch.setattr(trainer, "STANDARDISED_BY", 16)
    whole = finetune_cut_and_whole(monkeypatch, encoder, data, tmp_path, **changes)
    rows = list(csv.DictReader((whole / "episodes.csv").open()))
    assert [(row["step"], row["evaluated_under"]) for row in rows] == [
        ("6", "patch+zero_frames"),
        ("12", "patch+zero_frames"),
        ("12", "none"),
    ]
    assert {row["corruption"] for row in rows} == {"patch+zero_frames"}
    assert {row["method"] for row in rows} == {"mik+a"}
    assert not (whole / "features.npy").exists()


def test_precision_holds_while_views_are_encoded(encoder, data, tmp_path, monkeypatch):
    order = []
    encode = trainer.encode_views
    monkeypatch.setattr(trainer, "set_products", lambda device, precision: order.append(precision))
    monkeypatch.setattr(trainer, "encode_views", lambda *given: order.append("encode") or encode(*given))
    run_finetune(smoke_finetune(encoder, data, tmp_path / "run", **BRIEF, precision="tf32"))
    assert order == ["tf32", "encode"]


def test_view_seed_fixes_features_but_not_networks(encoder, data, tmp_path):
    def trained(name: str, **seeds: int) -> dict[str, torch.Tensor]:
        run = run_finetune(smoke_finetune(encoder, data, tmp_path / name, **BRIEF, **seeds))
        assert run.config["view_seed"] == seeds.get("view_seed")
        return load_file(run.path / "policy" / "model.safetensors")

    plain, explicit = trained("plain", seed=0), trained("explicit", seed=0, view_seed=0)
    assert all(torch.equal(plain[name], explicit[name]) for name in plain), "the default is the run's seed"
    other, own = trained("other", seed=1, view_seed=0), trained("own", seed=1)
    for name in ("standardise.mean", "standardise.std"):  # feature statistics
        assert torch.equal(other[name], plain[name])
        assert not torch.equal(own[name], plain[name])
    assert not torch.equal(other["net.0.weight"], plain["net.0.weight"])


@pytest.fixture
def with_states(tmp_path) -> Path:
    return write_fake_set(tmp_path / "own" / "walker_walk" / "expert", [20, 25, 30], physics_dim=18)


HIDDEN = {"method": "mik+a", "frame_encoder": "state", "hidden_share": 0.5, "corruption": "none"}


@pytest.mark.parametrize("settings", [{"method": "drq_bc"}, HIDDEN], ids=["drq_bc", "hidden"])
def test_end_to_end_and_state_encoders_resume_bit_exactly(with_states, tmp_path, monkeypatch, settings):
    made = run_pretrain(smoke_pretrain(with_states, tmp_path / "made", **settings)).path / "encoder"
    changes = {"updates": 12, "eval_every": 6, "checkpoint_every": 4, "batch_size": 4, "eval_length": 2}
    whole = finetune_cut_and_whole(monkeypatch, made, with_states, tmp_path, **changes)
    trained = (whole / "encoder" / "model.safetensors").read_bytes()
    along = settings["method"] == "drq_bc"
    assert (trained != (made / "model.safetensors").read_bytes()) == along
    rows = list(csv.DictReader((whole / "episodes.csv").open()))
    assert {row["algorithm"] for row in rows} == {"drqv2_bc" if along else "td3_bc"}
    critic = json.loads((whole / "critic.json").read_text())
    assert (critic["value"] != 0, critic["moved"]) == (True, None), "two rows of metrics are too few for a slope"


def test_state_encoder_reads_pose_and_velocity(with_states, tmp_path):
    encoder, _ = load_encoder(
        run_pretrain(smoke_pretrain(with_states, tmp_path / "s", method="state")).path / "encoder"
    )
    dataset = open_dataset(with_states)
    frozen = FrozenEncoder(encoder, dataset, CorruptionConfig.of("patch"), 4, "fp32", 0)
    z = frozen.episode(1, frozen.view(0)).numpy()
    rows = slice(int(dataset.episode_start[1]), int(dataset.episode_end[1]))
    assert z.shape == (25, 18)
    hinges, angle = np.delete(dataset.physics[rows], [1, 2], axis=1), dataset.physics[rows, 2:3]
    expected = np.concatenate([hinges[:, :7], np.sin(angle), np.cos(angle), hinges[:, 7:]], axis=1)
    np.testing.assert_allclose(z, expected, atol=1e-6)


def test_unfit_datasets_and_missing_gpus_leave_no_run(encoder, data, tmp_path):
    other = write_fake_set(tmp_path / "humanoid_walk" / "expert", [20, 20], action_dim=21)
    single = write_fake_set(tmp_path / "single" / "walker_walk", [1, 1])
    for given, message in ((other, "6 action dimensions"), (single, "holds no transition")):
        with pytest.raises(UserError, match=message):
            run_finetune(smoke_finetune(encoder, given, tmp_path / "out"))
    shutil.copytree(encoder, tmp_path / "small")
    config = json.loads((tmp_path / "small" / "config.json").read_text())
    config["encoder"]["size"] = 64
    (tmp_path / "small" / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"small: this encoder reads images of 64x64 pixels, the dataset has 84x84"):
        run_finetune(smoke_finetune(tmp_path / "small", data, tmp_path / "out"))
    with pytest.raises(UserError, match="no such GPU"):
        run_finetune(smoke_finetune(encoder, data, tmp_path / "out", device="cuda:99"))
    assert not (tmp_path / "out").exists()


def test_missing_result_of_finished_run_is_reported_and_rewritten(run, finished, encoder, data):
    config = smoke_finetune(encoder, data, run, **BRIEF)
    for name in RESULTS:
        kept = (run / name).rename(run / "kept")
        before = contents(run)
        with pytest.raises(UserError, match=r"or remove .*timing\.json and re-run its command"):
            run_finetune(config)
        assert contents(run) == before
        kept.rename(run / name)
    for name in RESULTS:
        (run / name).unlink()
    (run / "timing.json").unlink()
    assert contents(run_finetune(config).path) == contents(finished)


@pytest.mark.parametrize(
    ("folder", "lengths", "quality"),
    [("medium", [20, 25], "medium"), (".", [20, 25], "unknown"), (".", [20, 25, 30], "expert")],
)
def test_quality_label_comes_from_policy_dataset_or_encoder(encoder, tmp_path, monkeypatch, folder, lengths, quality):
    other = write_fake_set(tmp_path / "walker_walk" / folder, lengths)
    monkeypatch.setattr(trainer, "encode_views", lambda *_: (_ for _ in ()).throw(CutError))  # the names come before
    with pytest.raises(CutError):
        run_finetune(smoke_finetune(encoder, other, tmp_path / "out", **BRIEF))
    assert json.loads((tmp_path / "out" / "labels.json").read_text())["quality"] == quality


def test_diverged_policy_is_marked_and_not_saved(encoder, data, tmp_path):
    config = smoke_finetune(
        encoder, data, tmp_path / "out", updates=20, eval_every=10, log_every=20, batch_size=4, learning_rate=1e9
    )
    with pytest.raises(FloatingPointError, match="weights are not finite after step 10"):
        run_finetune(config)
    assert json.loads((config.out / "diverged.json").read_text())["step"] == 10
    assert not (config.out / "policy").exists()


def test_metrics_contain_scores(encoder, data, tmp_path):
    """`test_interruptions.py` covers cuts within and after an evaluation."""
    changes = {"updates": 4, "eval_every": 2, "batch_size": 4, "eval_length": 2}
    whole = run_finetune(smoke_finetune(encoder, data, tmp_path / "whole", **changes, eval_episodes=2)).path
    episodes = list(csv.DictReader((whole / "episodes.csv").open()))
    rows = [row for row in read_metrics(whole / "metrics.jsonl") if any("eval/" in name for name in row)]
    assert [row["step"] for row in rows] == [2, 4]
    for row in rows:
        for under in (CORRUPTION, "none")[: row["step"] // 2]:
            mine = [e for e in episodes if (int(e["step"]), e["evaluated_under"]) == (row["step"], under)]
            assert len(mine) == 2
            for measure in ("return", "score"):
                expected = np.mean([float(episode[measure]) for episode in mine])
                assert row[f"eval/{measure}/{under}"] == pytest.approx(expected, abs=1e-12)
    assert "eval/score/none" not in rows[0]


@pytest.mark.parametrize("algorithm", ["td3_bc", "drqv2_bc", "iql", "bc"])
def test_run_stores_critic_summary(encoder, data, tmp_path, algorithm):
    """Computed from the rows of metrics.jsonl."""
    changes = {"updates": 15, "log_every": 1, "batch_size": 4, "eval_length": 2, "eval_every": 15, "eval_clean": False}
    changes |= {} if algorithm == "bc" else {"gamma": 0.9, "n_step": 2}
    run = run_finetune(smoke_finetune(encoder, data, tmp_path / "run", algorithm=algorithm, **changes))
    assert {row["evaluated_under"] for row in csv.DictReader((run.path / "episodes.csv").open())} == {CORRUPTION}
    critic = json.loads((run.path / "critic.json").read_text())
    if algorithm == "bc":
        assert critic == {}
        return
    q = [row["q"] for row in read_metrics(run.path / "metrics.jsonl") if row["step"] > 12 and "q" in row]
    assert critic["value"] == pytest.approx(np.mean(q), abs=1e-4)
    assert critic["moved"] == pytest.approx((q[2] - q[0]) / 2 * 3 / np.mean(q), rel=1e-3)
    dataset = open_dataset(data)
    earned = dataset.reward[dataset.t > 0].double().mean()
    assert critic["data"] == pytest.approx(float(earned) / (1 - 0.9), abs=1e-3)


def test_clean_evaluation_has_its_own_episode_count_and_is_completed(encoder, data, tmp_path):
    """Shared episodes have equal rows; a run cut within its last evaluation completes it."""
    few = {"updates": 4, "eval_every": 2, "batch_size": 4, "eval_length": 2, "eval_episodes": 3}
    run = run_finetune(smoke_finetune(encoder, data, tmp_path / "out", **few, eval_clean_episodes=2)).path
    rows = [(row["step"], row["evaluated_under"]) for row in csv.DictReader((run / "episodes.csv").open())]
    assert rows == [("2", CORRUPTION)] * 3 + [("4", CORRUPTION)] * 3 + [("4", "none")] * 2
    whole = run_finetune(smoke_finetune(encoder, data, tmp_path / "whole", **few)).path
    lines = (whole / "episodes.csv").read_text().splitlines()
    assert (run / "episodes.csv").read_text().splitlines() == lines[:-1]
    before = contents(run)
    (run / "episodes.csv").write_text("\n".join(lines[:-2]) + "\n")  # a clean episode is missing
    (run / "timing.json").unlink()
    run_finetune(smoke_finetune(encoder, data, run, **few, eval_clean_episodes=2))
    assert contents(run) == before
    assert find_results([run])[0].id == find_results([whole])[0].id


def test_pretraining_time_is_copied_with_the_encoder(run, encoder, data, tmp_path):
    few = {"updates": 2, "batch_size": 4, "eval_episodes": 0}
    again = run_finetune(smoke_finetune(run / "encoder", data, tmp_path / "again", **few)).path
    timings = (encoder.parent / "timing.json", again / "pretrain_timing.json")
    first_timing, copied_timing = (json.loads(path.read_text()) for path in timings)
    assert first_timing == copied_timing


@pytest.mark.parametrize(("views", "hidden_dim", "threads"), [(1, 32, 1), (0, 32, 2), (1, 513, 2)])
def test_small_networks_use_one_thread(encoder, data, tmp_path, monkeypatch, views, hidden_dim, threads):
    """Several threads would stall between small matrix products."""
    seen, loss, before = set(), TD3BC.critic_loss, torch.get_num_threads()

    def watched(self, *arguments):
        seen.add(torch.get_num_threads())
        return loss(self, *arguments)

    monkeypatch.setattr(TD3BC, "critic_loss", watched)
    monkeypatch.setattr(trainer, "STANDARDISED_BY", 16)
    torch.set_num_threads(2)
    try:
        changes = BRIEF | {"views": views, "hidden_dim": hidden_dim, "batch_size": 4}
        run_finetune(smoke_finetune(encoder, data, tmp_path / "run", **changes))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert seen == {threads}
