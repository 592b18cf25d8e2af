"""Certificates use all seeds, the encoders' own corruption, and the returns of the methods that they name."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.helpers_report import write_seeds
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.studies import certify
from vd4rl_pomdp.studies.certify import FLOORS, MEMORY, NEEDS, OPEN, STATE


class StopError(Exception):
    pass


def test_each_method_is_trained_and_judged_with_three_seeds(states, tmp_path, monkeypatch):
    dataset, cells, jobs = certify.planned(states, "patch", tmp_path, True, ["preset=smoke"])
    words = {job.name: " ".join(job.words) for job in jobs}
    for method in (MEMORY, *FLOORS, STATE):
        for seed in (0, 1, 2):
            name = f"{method}/seed{seed}"
            assert f"--method {method} " in words[f"{name}/pretrain"] + " "
            assert f"--encoder {tmp_path}/{name}/pretrain/encoder" in words[f"{name}/finetune"]
            for stage in ("pretrain", "finetune"):
                assert f"--seed {seed} " in words[f"{name}/{stage}"] + " "
            assert ("--hold-out" in words[f"{name}/pretrain"]) == (method != STATE)
    judged = []
    monkeypatch.setattr(certify, "_r2", lambda _, runs: judged.append(runs))
    monkeypatch.setattr(certify, "judge", lambda *_: {})
    monkeypatch.setattr(certify, "_returns", lambda folders: judged.append(folders) or {})
    monkeypatch.setattr(certify, "read_record", lambda *_: (_ for _ in ()).throw(StopError))
    with pytest.raises(StopError):
        certify.certify(dataset, cells, tmp_path, True)
    *runs, policies = judged
    assert runs == [[tmp_path / method / f"seed{seed}" for seed in (0, 1, 2)] for method in (MEMORY, *FLOORS)]
    assert sorted(policies) == sorted(job.folder for job in jobs if job.section == "finetune")


def test_r2_is_of_each_encoder_under_its_corruption_by_held_out_episode(states, tmp_path, monkeypatch):
    dataset, seen = open_dataset(states), []
    corruption = {"corruption": "patch", "patch_size": 24}

    def load(folder, *_):
        return torch.nn.Identity(), SimpleNamespace(
            corruption=corruption, settings={"precision": "bf16"}, seed=int(folder.parts[-3])
        )

    class Frozen:
        def __init__(self, *arguments):
            seen.append(arguments[2:])

        def groups(self):
            return [range(5), range(5, 10)]

        def view(self, number):
            return number

        def frames(self, some, view):
            return dataset.states()[dataset.rows_of(some)]

    monkeypatch.setattr(certify, "load_encoder", load)
    monkeypatch.setattr(certify, "FrozenEncoder", Frozen)
    # the second seed's encoder knows nothing of the last held-out episode
    monkeypatch.setattr(certify, "read_whole", lambda _, frames, __, some: frames * (len(seen) == 1 or some.start == 0))
    runs = [tmp_path / f"{seed}" for seed in (3, 4)]
    for run in runs:
        (run / "pretrain").mkdir(parents=True)
    found = certify._r2(dataset, runs)
    assert found.shape == (2, 2)
    assert found[0].min() > 0.9
    assert found[1, 0] > found[1, 1] + 0.3
    assert seen == [(CorruptionConfig.fill(corruption), 0, "bf16", seed) for seed in (3, 4)]


def scores(**changes: tuple[float, ...]) -> dict[tuple[str, str], tuple[float, ...]]:
    """Scores (return / 10) of three seeds by method; the data's mean return is 800."""
    usual = {MEMORY: (70, 71, 72), FLOORS[0]: (20, 22, 24), FLOORS[1]: (30, 31, 33), STATE: (75, 77, 76)}
    return {(method, "patch"): seeds for method, seeds in (usual | changes).items()}


def returns(folder: Path) -> dict:
    return certify._returns(sorted(folder.iterdir()))


def test_returns_are_judged_by_method_and_in_units_of_the_data(tmp_path):
    row = returns(write_seeds(tmp_path / "good", scores(), 800.0))
    assert (row["verdict"], row["data_return"], row["converged"], row["updates"]) == (NEEDS, 800.0, True, 10)
    assert row["state_share"] == pytest.approx(760 / 800)
    assert row["methods"][MEMORY][0] == pytest.approx(710)
    assert [row["above"][floor][0] for floor in FLOORS] == pytest.approx([710 - 220, 710 - 940 / 3])
    write_seeds(tmp_path / "state", scores(**{STATE: (70, 71, 72)}), 800.0)
    row = returns(tmp_path / "state")
    assert row["verdict"] == OPEN
    assert row["why"].startswith("state returns 0.89 of the data's return, less than 0.9; supervised+a 710 [")
    write_seeds(tmp_path / "weak", scores(**{MEMORY: (39, 39.5, 40), FLOORS[0]: (38, 39, 40)}), 800.0)
    row = returns(tmp_path / "weak")
    assert (row["verdict"], row["why"].endswith("itself too low to judge")) == (OPEN, True), "395 is below half of 800"


@pytest.mark.parametrize("method", [MEMORY, *FLOORS, STATE])
def test_every_critic_must_have_converged(tmp_path, method):
    write_seeds(tmp_path, scores(), 800.0)
    write_json(tmp_path / f"{method}-patch-2-td3_bc" / "critic.json", {"value": 150.0, "moved": 0.05, "data": 160.0})
    row = returns(tmp_path)
    assert (row["converged"], row["verdict"]) == (False, OPEN)
    assert row["why"].startswith("critics are not converged; ")


def test_saved_r2_is_read_again(states, tmp_path):
    for seed in (0, 1):
        (tmp_path / f"{seed}" / "pretrain").mkdir(parents=True)
        write_json(tmp_path / f"{seed}" / "pretrain" / certify.R2_FILE, {"r2": [seed, seed + 0.5]})
    found = certify._r2(open_dataset(states), [tmp_path / "1", tmp_path / "0"])
    np.testing.assert_array_equal(found, [[1, 1.5], [0, 0.5]])
