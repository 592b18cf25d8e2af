import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import append_rows
from vd4rl_pomdp.report import stats, write_report


def write_run(folder: Path, method: str, seed: int, scores: dict[int, list[float]], film: bool = False) -> Path:
    """A fine-tuning run with the given scores of its episodes by step."""
    folder.mkdir(parents=True)
    record = {
        "stage": "finetune",
        "config": {"seed": seed},
        "versions": {},
        "git_commit": "abc",
        "command": "vd4rl-pomdp",
    }
    (folder / "config.json").write_text(json.dumps(record))
    (folder / "metrics.jsonl").write_text('{"step": 10, "bc_loss": 0.5}\n')
    labels = {"method": method, "task": "walker_walk", "quality": "expert", "corruption": "patch"}
    for step, values in scores.items():
        rows = [
            labels
            | {"algorithm": "td3_bc", "seed": seed, "step": step, "episode": i, "episode_seed": i}
            | {"return": value * 10, "length": 500, "score": value}
            for i, value in enumerate(values)
        ]
        append_rows(folder / "episodes.csv", rows)
    (folder / "timing.json").write_text('{"seconds": 3.0}')
    if film:
        pictures = np.random.default_rng(0).integers(0, 256, (4, 12, 84, 84), dtype=np.uint8)
        np.savez(
            folder / "film.npz", **{"clean": pictures[:, :3], "corrupted": pictures[:, 3:], "return": np.arange(4.0)}
        )
    return folder


def test_iqm_drops_the_outer_quarters():
    assert stats.iqm(np.array([0.0, 1.0, 2.0, 100.0])) == pytest.approx(1.5)
    # five runs: the middle 2.5 are 0.75 of the 2nd, the 3rd, 0.75 of the 4th
    assert stats.iqm(np.array([10.0, 1.0, 2.0, 3.0, -50.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 3) / 2.5)
    assert stats.iqm(np.array([[1.0], [2.0]])).tolist() == [1.0, 2.0]


def test_other_statistics_on_known_values():
    assert stats.optimality_gap(np.array([50.0, 150.0])) == pytest.approx(25.0)
    assert stats.probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0])) == pytest.approx(0.875)
    assert stats.performance_profile(np.array([1.0, 3.0]), np.array([0.0, 2.0, 4.0])).tolist() == [1.0, 0.5, 0.0]


def test_the_bootstrap_covers_a_known_mean_and_keeps_tasks_apart():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = stats.bootstrap_interval([rng.normal(5, 1, 30)], stats.mean, rng, 500)
        hits += low <= 5 <= high
    assert 0.88 <= hits / 200 <= 0.99
    # tasks far apart, no spread within: drawing across tasks would give an interval, drawing within gives none
    low, high = stats.bootstrap_interval([np.full(4, 0.0), np.full(4, 100.0)], stats.mean, rng, 500)
    assert low == high == 50.0
    assert stats.bootstrap_interval([np.array([1.0])], stats.mean, rng) is None


def test_a_report_counts_seeds_not_episodes(tmp_path):
    for seed, scores in enumerate([[10.0, 30.0], [40.0, 40.0]]):
        write_run(tmp_path / f"runs/acro/{seed}", "acro", seed, {5: [90.0, 90.0], 10: scores}, film=seed == 0)
    write_run(tmp_path / "runs/random/0", "random", 0, {10: [95.0]})
    page, summary = write_report([tmp_path / "runs"], tmp_path / "out")
    assert [row["method"] for row in summary] == ["acro", "random"], "references come last, whatever their score"
    acro = summary[0]
    assert acro["score"] == pytest.approx(30.0)
    assert (acro["seeds"], acro["episodes"], acro["best_step"]) == (2, 4, 5)
    assert (acro["low"], acro["high"]) == (20.0, 40.0)
    assert summary[1]["low"] is None
    with (tmp_path / "out" / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 9
    text = page.read_text()
    assert "data:image/webp;base64" in text
    assert "30.0" in text
    assert not re.search(r'(src|href)="?(https?:)?//', text), "the page must not need a network"


def test_references_with_their_own_algorithm_stand_in_the_same_table(tmp_path):
    write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    end_to_end = write_run(tmp_path / "runs/bc", "bc", 0, {10: [20.0]})
    rows = (end_to_end / "episodes.csv").read_text()
    (end_to_end / "episodes.csv").write_text(rows.replace("td3_bc", "bc"))
    (end_to_end / "probe.json").write_text('{"probe_pose": 12.5, "probe_velocity": 34.5}')
    (end_to_end / "pretrain_timing.json").write_text('{"seconds": 7.0}')
    page, _ = write_report([tmp_path / "runs"], tmp_path / "out")
    text = page.read_text()
    assert text.count("<h3>walker_walk expert, patch</h3>") == 1
    with (tmp_path / "out" / "runs.csv").open() as file:
        acro, bc = csv.DictReader(file)
    assert (acro["method"], acro["return"], acro["probe_pose"]) == ("acro", "500.0", "")
    assert (bc["method"], bc["probe_pose"], bc["probe_velocity"]) == ("bc", "12.5", "34.5")
    assert (bc["pretrain_seconds"], bc["finetune_seconds"]) == ("7.0", "3.0")
    with (tmp_path / "out" / "improvement.csv").open() as file:
        chances = {(row["method"], row["other"]): float(row["probability"]) for row in csv.DictReader(file)}
    assert chances == {("acro", "bc"): 1.0, ("bc", "acro"): 0.0}


def test_bad_input_is_one_line(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        write_report([tmp_path / "nowhere"], tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="contains no runs"):
        write_report([tmp_path / "empty"], tmp_path / "out")
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    write_run(tmp_path / "b", "acro", 0, {10: [2.0]})
    with pytest.raises(UserError, match="two runs of one method"):
        write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    (tmp_path / "a" / "metrics.jsonl").write_text("{\n")
    with pytest.raises(UserError, match="not JSON"):
        write_report([tmp_path / "a"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_cut_rows_and_films_are_named(tmp_path):
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    rows = tmp_path / "a" / "episodes.csv"
    whole = rows.read_text()
    rows.write_text(whole + "acro,walker_w")
    with pytest.raises(UserError, match=r"episodes\.csv: a row is not whole"):
        write_report([tmp_path / "a"], tmp_path / "out")
    rows.write_text(whole)
    (tmp_path / "a" / "film.npz").write_bytes(b"cut")
    with pytest.raises(UserError, match=r"film\.npz: cannot be read"):
        write_report([tmp_path / "a"], tmp_path / "out")
