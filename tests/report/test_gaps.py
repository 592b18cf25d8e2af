"""Which runs are missing."""

from tests.helpers_report import describe, write_run
from vd4rl_pomdp.report.gaps import find_gaps, never_begun
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.runs.files import read_json, write_json


def test_an_ablation_is_missing_elsewhere_but_a_budget_for_every_task_is_not(tmp_path):
    runs = tmp_path / "runs"
    for k in (1, 15):
        describe(write_run(runs / f"expert{k}", "mik+a", 0, {10: [1.0]}), {"max_k": k})
    describe(write_run(runs / "medium", "mik+a", 0, {10: [1.0]}, labels={"quality": "medium"}), {"max_k": 15})
    for quality, steps in (("expert", 20), ("medium", 60)):
        run = write_run(runs / f"{quality}-acro", "acro", 0, {10: [1.0]}, labels={"quality": quality})
        describe(run, {"steps": steps})
    describe(write_run(runs / "none", "random", 0, {10: [1.0]}, labels={"corruption": "none"}), {"steps": 20})
    for size in (16, 48):
        run = write_run(runs / f"patch{size}", "random", 0, {10: [1.0]})
        describe(run, {"patch_size": size}, data=f"f{size}")
    names = ("quality", "corruption", "method", "variant")
    variants = [("mik+a", "max_k 1"), ("mik+a", "max_k 15"), ("acro", "steps 20"), ("acro", "steps 60")]
    assert {tuple(row[name] for name in names) for row in find_gaps(load_runs([runs]))} == {
        ("medium", "patch, patch_size 16", "mik+a", "max_k 1"),
        ("medium", "patch, patch_size 16", "random", ""),
        *(("expert", "patch, patch_size 48", *variant) for variant in variants),
        *(("expert", "none", *variant) for variant in variants),
    }


def test_the_state_is_not_missing_where_other_pixels_of_the_same_set_are_hidden(tmp_path):
    runs = tmp_path / "runs"
    for method, quality, corruption in (
        *(("acro", quality, corruption) for quality in ("expert", "medium") for corruption in ("none", "patch")),
        ("state", "expert", "none"),
    ):
        labels = {"quality": quality, "corruption": corruption}
        describe(write_run(runs / f"{method}-{quality}-{corruption}", method, 0, {10: [1.0]}, labels=labels), {})
    names = ("quality", "corruption", "method")
    assert {tuple(row[name] for name in names) for row in find_gaps(load_runs([runs]))} == {
        ("medium", "none", "state"),
        ("medium", "patch", "state"),
    }


def test_a_finished_seed_is_no_gap_whatever_else_was_begun(tmp_path):
    runs = tmp_path / "runs"
    describe(write_run(runs / "a", "acro", 0, {10: [1.0]}), {})
    begun = describe(write_run(runs / "b", "acro", 0, {}), {})
    (begun / "timing.json").unlink()
    card = read_json(begun / "encoder" / "config.json")
    write_json(begun / "encoder" / "config.json", {"pretrain": card["pretrain"] | {"frames": 7}})
    loaded = load_runs([runs])
    assert [run.finished for run in loaded] == [True, False]
    assert find_gaps(loaded) == []


def test_policies_that_are_wanted_are_missed_where_anything_of_their_setting_is_there(tmp_path):
    runs = tmp_path / "runs"
    labels = {"task": "walker_walk", "quality": "expert", "corruption": "patch", "algorithm": "td3_bc"}
    for size in (16, 48):
        describe(write_run(runs / str(size), "acro", 0, {10: [1.0]}), {"patch_size": size}, data=f"f{size}")
    wanted = [labels | {"method": method, "seed": seed} for method, seed in (("acro", 0), ("acro", 1), ("mik", 4))]
    loaded = load_runs([runs])
    found = never_begun(loaded, [], [*wanted, wanted[2] | {"quality": "medium"}])
    assert [(row["method"], row["seed"], row["state"]) for row in found] == [
        ("acro", 1, "missing"),
        ("mik", 4, "missing"),
    ]
    assert {row["corruption"] for row in found} <= {"patch, patch_size 16", "patch, patch_size 48"}
    assert never_begun(loaded, found, wanted) == []


def test_a_seed_on_the_encoder_of_its_own_is_no_gap_of_those_that_share_it(tmp_path):
    runs = tmp_path / "runs"
    for seed in (0, 1, 2):
        run = describe(write_run(runs / str(seed), "acro", seed, {10: [1.0]}), {})
        card = read_json(run / "encoder" / "config.json")
        write_json(run / "encoder" / "config.json", {"pretrain": card["pretrain"] | {"seed": 0}})
    gaps = [(row["variant"], row["seed"]) for row in find_gaps(load_runs([runs]))]
    assert gaps == [("", 1), ("", 2)]
