"""Runs pool under one label unless their settings differ."""

import pytest

from tests.helpers_report import describe, pooled, write_run
from vd4rl_pomdp.report import write_report
from vd4rl_pomdp.report.claims import judge_claims
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.runs.files import read_json, write_json


def test_runs_pool_whatever_their_seed_folder_device_and_logging(tmp_path):
    for seed in (0, 1):
        run = write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]})
        noise = {"out": str(run), "encoder": str(seed), "device": str(seed), "log_every": seed, "workers": seed}
        describe(run, {"seed": seed} if seed > 5 else {}, data="f00", **noise)
    assert pooled(tmp_path / "runs") == {"acro": 2}


@pytest.mark.parametrize(
    ("one", "other", "names"),
    [
        ({"card": {"steps": 20}}, {"card": {"steps": 60}}, ["acro, steps 20", "acro, steps 60"]),
        ({"card": {}, "updates": 5}, {"card": {}, "updates": 9}, ["acro, updates 5", "acro, updates 9"]),
        (
            {"card": {"batch_size": 8}},
            {"card": {"batch_size": 16}},
            ["acro, pretraining batch_size 8", "acro, pretraining batch_size 16"],
        ),
        (
            {"card": {"data": "a" * 24}, "data": "a" * 24},
            {"card": {"data": "b" * 24}, "data": "b" * 24},
            ["acro, data aaaaaaaa", "acro, data bbbbbbbb"],
        ),
        (
            {"card": {"data": "a" * 24}, "data": "a" * 24},
            {"card": {"data": "b" * 24}, "data": "a" * 24},
            ["acro, pretraining data the same", "acro, pretraining data bbbbbbbb"],
        ),
        ({"card": {}}, {"card": {}, "data": "f00"}, ["acro, data not recorded", "acro, data f00"]),
        ({"card": {}, "views": 4}, {"card": {}, "views": None}, ["acro, views 4", "acro, views none"]),
        ({"card": {"m": 8}}, {"card": {}}, ["acro, m 8", "acro, m unset"]),
        ({"card": {"history": "method"}}, {"card": {"history": "gru"}}, ["acro", "acro, history gru"]),
        ({"card": {"m": 8}}, {"card": {"m": 8, "future_frames": "newest"}}, ["acro", "acro, future_frames newest"]),
        (
            {"card": {}, "random_histories": 0.0, "views": 4},
            {"card": {}, "random_histories": 0.5, "views": 8},
            ["acro, views 4", "acro, views 8, random_histories 0.5"],
        ),
        ({"card": {}}, {}, ["acro", "acro, pretraining not recorded"]),
        (
            {"card": {"preset": "cpu", "steps": 20}, "preset": "cpu", "views": 4},
            {"card": {"preset": "smoke", "steps": 60}, "preset": "smoke", "views": 1},
            ["acro, preset cpu", "acro, preset smoke"],
        ),
    ],
    ids=[
        "steps",
        "updates",
        "same name",
        "data",
        "data before",
        "old",
        "none",
        "new",
        "plain",
        "later",
        "two",
        "no card",
        "preset",
    ],
)
def test_runs_that_differ_are_rows_of_their_own(tmp_path, one, other, names):
    for seed in (0, 1):
        for folder, settings in (("one", one), ("other", other)):
            describe(write_run(tmp_path / f"runs/{folder}{seed}", "acro", seed, {10: [1.0]}), **settings)
    write_run(tmp_path / "runs/random", "random", 0, {10: [1.0]})
    assert pooled(tmp_path / "runs") == dict.fromkeys(names, 2) | {"random": 1}


def settings_of(runs):
    """By method, the corruptions that a report tells apart."""
    found = {}
    for run in load_runs([runs]):
        found.setdefault(run.labels["method"], set()).add(run.labels["corruption"])
    return found


def test_runs_of_two_formats_do_not_pool(tmp_path):
    for seed in (0, 1):
        run = describe(write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]}), {})
        record = read_json(run / "config.json")
        write_json(run / "config.json", record | {"format": 3 + seed})
    assert pooled(tmp_path / "runs") == {"acro, format 3": 1, "acro, format 4": 1}


def test_a_corruption_of_other_options_is_another_setting_whatever_the_method(tmp_path):
    runs = tmp_path / "runs"
    for method, size in (("acro", 16), ("mik+a", 48), ("mik", 48)):
        for seed in (0, 1):
            run = write_run(runs / f"{method}{seed}", method, seed, {10: [1.0 + seed + size]})
            describe(run, {"patch_size": size}, data="f00")
    write_run(runs / "early", "random", 0, {10: [1.0]})
    few, many = "patch, patch_size 16", "patch, patch_size 48"
    assert settings_of(runs) == {"acro": {few}, "mik+a": {many}, "mik": {many}, "random": {"patch"}}
    claims = judge_claims(load_runs([runs]))
    assert {(row["corruption"], row["left"], row["right"]) for row in claims} == {(many, "mik+a", "mik")}
    page = write_report([runs], tmp_path / "report")[0].read_text()
    assert f"walker_walk expert, {few}" in page


def under_own_corruption(run, options, **config):
    """Give a run an encoder that was trained under a corruption with options of its own, and settings."""
    describe(run, options, **config)
    card = read_json(run / "encoder" / "config.json")
    card["pretrain"]["corruption"] = {"corruption": "patch"} | options
    write_json(run / "encoder" / "config.json", card)


def test_options_are_a_corruptions_whether_or_not_its_file_was_run(tmp_path):
    runs = tmp_path / "runs"
    for height in (8, 24):
        under_own_corruption(write_run(runs / f"acro{height}", "acro", 0, {10: [1.0]}), {"bar_height": height})
    assert settings_of(runs) == {"acro": {"patch, bar_height 8", "patch, bar_height 24"}}


def test_an_option_is_not_a_corruptions_because_it_is_called_like_one_of_it(tmp_path):
    runs = tmp_path / "runs"
    for gamma, discount in ((1, 0.9), (1, 0.99), (2, 0.99)):
        run = write_run(runs / f"acro{gamma}{discount}", "acro", 0, {10: [1.0]})
        under_own_corruption(run, {"gamma": gamma}, gamma=discount)
    found = {(run.labels["corruption"], run.variant) for run in load_runs([runs])}
    assert found == {
        ("patch, gamma 1", "gamma 0.9"),
        ("patch, gamma 1", "gamma 0.99"),
        ("patch, gamma 2", "gamma 0.99"),
    }


def test_where_nothing_is_hidden_no_option_counts(tmp_path):
    runs = tmp_path / "runs"
    for size in (16, 48):
        run = write_run(runs / f"acro{size}", "acro", size, {10: [1.0]}, labels={"corruption": "none"})
        describe(run, {"patch_size": size})
    assert settings_of(runs) == {"acro": {"none"}}


def by_set(tmp_path, budgets):
    """Runs of two methods on several sets, with budgets by method and set."""
    for (method, name), updates in budgets.items():
        labels = dict(zip(("task", "quality"), name.split(), strict=True))
        run = write_run(tmp_path / f"runs/{method}-{name}", method, 0, {10: [1.0]}, labels=labels)
        describe(run, {}, data=name, updates=updates)
    return tmp_path / "runs"


def test_a_setting_that_goes_by_the_set_makes_no_variants_and_the_page_tells_it(tmp_path):
    sets = {"walker_walk expert": 20, "cheetah_run expert": 60, "cheetah_run medium": 20}
    runs = by_set(tmp_path, {(method, name): sets[name] for method in ("acro", "mik+a") for name in sets})
    assert pooled(runs) == {"acro": 3, "mik+a": 3}
    page = write_report([runs], tmp_path / "report")[0].read_text()
    for name, updates in sets.items():
        assert f"<td>{name}</td><td>updates {updates}</td>" in page


def test_a_budget_of_one_method_alone_is_no_sets_own(tmp_path):
    expert, medium = "walker_walk expert", "walker_walk medium"
    runs = by_set(tmp_path, {("acro", expert): 20, ("acro", medium): 60, ("mik+a", medium): 20})
    assert pooled(runs) == {"acro, updates 20": 1, "acro, updates 60": 1, "mik+a": 1}


def test_a_preset_stands_for_what_it_decides_and_the_page_says_all(tmp_path):
    for preset, k in (("cpu", 15), ("cpu", 1), ("smoke", 3)):
        run = write_run(tmp_path / f"runs/{preset}{k}", "acro", 0, {10: [1.0]})
        describe(run, {"max_k": k, "preset": preset, "steps": len(preset)}, preset=preset)
    labels = {"acro, preset cpu, max_k 15", "acro, preset cpu, max_k 1", "acro, preset smoke, max_k 3"}
    assert set(pooled(tmp_path / "runs")) == labels
    page = write_report([tmp_path / "runs"], tmp_path / "out")[0].read_text()
    assert "<td>preset smoke, steps 5, pretraining preset smoke, max_k 3</td>" in page


def on_encoder(folder, seed, encoder, quality="expert"):
    """A run of acro whose encoder was pretrained with a seed of its own."""
    run = write_run(folder / f"{quality}-{encoder}-{seed}", "acro", seed, {10: [1.0]}, labels={"quality": quality})
    card = read_json(describe(run, {}) / "encoder" / "config.json")
    write_json(run / "encoder" / "config.json", {"pretrain": card["pretrain"] | {"seed": encoder}})
    return run


def test_seeds_on_one_encoder_are_no_replicates_of_the_method(tmp_path):
    for seed in (0, 1, 2):
        on_encoder(tmp_path / "one", seed, encoder=0)
        on_encoder(tmp_path / "own", seed, encoder=seed)
        on_encoder(tmp_path / "others", 0, encoder=seed)
    assert pooled(tmp_path / "own") == {"acro": 3}
    assert pooled(tmp_path / "one") == {"acro": 1, "acro, pretraining seed 0": 2}
    assert pooled(tmp_path / "others") == {"acro": 1, "acro, pretraining seed 1": 1, "acro, pretraining seed 2": 1}


def test_what_seeds_share_is_told_whatever_other_runs_there_are(tmp_path):
    for seed, quality in enumerate(("expert", "medium")):
        for own in (2, 3):
            on_encoder(tmp_path / "runs", own, encoder=seed, quality=quality)
    assert pooled(tmp_path / "runs") == {"acro, pretraining seed 0": 2, "acro, pretraining seed 1": 2}
    assert pooled(tmp_path / "runs" / "expert-0-2") == {"acro, pretraining seed 0": 1}


def test_a_corruption_has_one_name_whatever_learns_under_it(tmp_path):
    runs = tmp_path / "runs"
    for algorithm, task, size in (
        *(("td3_bc", "walker_walk", 16), ("td3_bc", "cheetah_run", 48)),
        *(("bc", "walker_walk", 16), ("bc", "walker_walk", 48)),
    ):
        labels = {"algorithm": algorithm, "task": task}
        describe(write_run(runs / f"{labels}{size}", "acro", 0, {10: [1.0]}, labels=labels), {"patch_size": size})
    found = {(run.labels["algorithm"], run.labels["task"], run.labels["corruption"]) for run in load_runs([runs])}
    assert found == {
        *(("td3_bc", "walker_walk", "patch, patch_size 16"), ("td3_bc", "cheetah_run", "patch, patch_size 48")),
        *(("bc", "walker_walk", "patch, patch_size 16"), ("bc", "walker_walk", "patch, patch_size 48")),
    }
