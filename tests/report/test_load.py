"""Loading runs for a report: pooling, gaps and damaged files."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers_report import collected, describe, pooled, write_run
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.report.load import find_gaps, load_runs
from vd4rl_pomdp.report.page import unlike, write_report
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import find_results, write_results


def test_invalid_runs_are_rejected(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        write_report([tmp_path / "nowhere"], tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="contains no runs"):
        write_report([tmp_path / "empty"], tmp_path / "out")
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    write_run(tmp_path / "b", "acro", 0, {10: [2.0]})
    with pytest.raises(UserError, match="two runs with the same method"):
        write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    (tmp_path / "a" / "metrics.jsonl").write_text("{\n")
    with pytest.raises(UserError, match="a line is not JSON of numbers"):
        write_report([tmp_path / "a"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_duplicate_run_in_a_results_folder_is_rejected(tmp_path):
    (run,) = find_results([write_run(tmp_path / "a", "acro", 0, {10: [1.0, 3.0]})])
    write_results(tmp_path / "results", [run, replace(run, id="another")])
    with pytest.raises(UserError, match=f"run another and .*run {run.id}: two runs with the same method"):
        load_runs([tmp_path / "results"])


def test_damaged_film_is_rejected(tmp_path):
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    film = tmp_path / "a" / "film.npz"
    np.savez_compressed(film, clean=np.arange(999))
    packed = film.read_bytes()
    for damaged in (b"cut", packed[:100] + b"\xff" * 99 + packed[199:]):
        film.write_bytes(damaged)
        with pytest.raises(UserError, match=r"film\.npz: cannot be read"):
            write_report([tmp_path / "a"], tmp_path / "out")


def test_incomplete_labels_and_cards_are_rejected(tmp_path):
    run = describe(write_run(tmp_path / "runs/a", "acro", 0, {10: [2.0]}), {})
    (tmp_path / "runs" / "b").mkdir()
    for name in ("config.json", "metrics.jsonl"):
        (tmp_path / "runs" / "b" / name).write_bytes((run / name).read_bytes())
    (tmp_path / "runs" / "b" / "labels.json").write_text("{}")
    with pytest.raises(UserError, match=r"b/labels\.json: has no 'method'"):
        write_report([tmp_path / "runs"], tmp_path / "out")
    for card, words in (("{}", "does not say how"), ('{"pretrain": {"corruption": ["patch"]}}', "files are damaged")):
        (run / "encoder" / "config.json").write_text(card)
        with pytest.raises(UserError, match=words):
            write_report([run], tmp_path / "out")


def test_runs_pool_over_seed_folder_device_and_logging(tmp_path):
    for seed in (0, 1):
        run = write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]})
        noise = {"out": str(run), "encoder": str(seed), "device": str(seed), "log_every": seed, "workers": seed}
        describe(run, {}, data="f00", **noise)
    assert pooled(tmp_path / "runs") == {"acro": 2}


A, B = "a" * 24, "b" * 24
DIFFERENT = {
    # encoder and policy settings of two groups of runs, and their variants
    "steps": ({"steps": 20}, {}, {"steps": 60}, {}, ["steps 20", "steps 60"]),
    "updates": ({}, {"updates": 5}, {}, {"updates": 9}, ["updates 5", "updates 9"]),
    "same name": ({"batch_size": 8}, {}, {"batch_size": 16}, {}, [f"pretraining batch_size {n}" for n in (8, 16)]),
    "data": ({"data": A}, {"data": A}, {"data": B}, {"data": B}, ["data aaaaaaaa", "data bbbbbbbb"]),
    "data before": (
        {"data": A},
        {"data": A},
        {"data": B},
        {"data": A},
        [f"pretraining data {x}" for x in ("the same", B[:8])],
    ),
    "new option": ({"m": 8}, {}, {}, {}, ["m 8", "m unset"]),
    "plain": ({"history": "method"}, {}, {"history": "gru"}, {}, ["", "history gru"]),
    "later": ({"m": 8}, {}, {"m": 8, "future_frames": "newest"}, {}, ["", "future_frames newest"]),
    "views": ({}, {}, {}, {"view_seed": 0}, ["", "view_seed 0"]),
    "two": (
        {},
        {"random_histories": 0.0},
        {},
        {"random_histories": 0.5, "views": 8},
        ["views 4", "views 8, random_histories 0.5"],
    ),
    "preset": (
        *({"preset": "cpu", "steps": 20}, {"preset": "cpu", "views": 4}),
        *({"preset": "smoke", "steps": 60}, {"preset": "smoke", "views": 1}, ["preset cpu", "preset smoke"]),
    ),
}


@pytest.mark.parametrize(("card", "config", "other_card", "other", "words"), DIFFERENT.values(), ids=DIFFERENT)
def test_runs_with_different_settings_are_separate_rows(tmp_path, card, config, other_card, other, words):
    for seed in (0, 1):
        for folder, before, own in (("one", card, config), ("other", other_card, other)):
            describe(write_run(tmp_path / f"runs/{folder}{seed}", "acro", seed, {10: [1.0]}), before, **own)
    write_run(tmp_path / "runs/random", "random", 0, {10: [1.0]})
    names = [", ".join(filter(None, ("acro", word))) for word in words]
    assert pooled(tmp_path / "runs") == dict.fromkeys(names, 2) | {"random": 1}


def test_runs_of_two_formats_do_not_pool(tmp_path):
    for seed in (0, 1):
        run = describe(write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]}), {})
        write_json(run / "config.json", read_json(run / "config.json") | {"format": 3 + seed})
    assert pooled(tmp_path / "runs") == {"acro, format 3": 1, "acro, format 4": 1}


def corruptions_of(runs):
    """Corruption labels by method."""
    found = {}
    for run in load_runs([runs]):
        found.setdefault(run.method, set()).add(run.labels["corruption"])
    return found


def test_corruption_options_define_settings(tmp_path):
    for method, size in (("acro", 16), ("mik+a", 48), ("mik", 48)):
        for seed in (0, 1):
            run = write_run(tmp_path / f"{method}{seed}", method, seed, {10: [1.0 + seed + size]})
            describe(run, {"patch_size": size}, data="f00")
    write_run(tmp_path / "early", "random", 0, {10: [1.0]})
    few, many = "patch, patch_size 16", "patch, patch_size 48"
    assert corruptions_of(tmp_path) == {"acro": {few}, "mik+a": {many}, "mik": {many}, "random": {"patch"}}


def test_policy_options_with_corruption_option_names_are_variants(tmp_path):
    for gamma, discount in ((1, 0.9), (1, 0.99), (2, 0.99)):
        options = {"gamma": gamma}
        run = describe(write_run(tmp_path / f"acro{gamma}{discount}", "acro", 0, {10: [1.0]}), options, gamma=discount)
        card = read_json(run / "encoder" / "config.json")
        card["pretrain"]["corruption"] = {"corruption": "patch"} | options
        write_json(run / "encoder" / "config.json", card)
    assert {(run.labels["corruption"], run.variant) for run in load_runs([tmp_path])} == {
        ("patch, gamma 1", "gamma 0.9"),
        ("patch, gamma 1", "gamma 0.99"),
        ("patch, gamma 2", "gamma 0.99"),
    }


def test_corruption_options_are_ignored_without_corruption(tmp_path):
    for size in (16, 48):
        run = write_run(tmp_path / f"acro{size}", "acro", size, {10: [1.0]}, labels={"corruption": "none"})
        describe(run, {"patch_size": size})
    assert corruptions_of(tmp_path) == {"acro": {"none"}}


def by_set(tmp_path, budgets):
    """Write runs with `updates` by (method, "task quality")."""
    for (method, name), updates in budgets.items():
        labels = dict(zip(("task", "quality"), name.split(), strict=True))
        run = write_run(tmp_path / f"runs/{method}-{name}", method, 0, {10: [1.0]}, labels=labels)
        describe(run, {}, updates=updates)
    return tmp_path / "runs"


def test_budgets_make_variants_only_if_they_differ_within_a_set(tmp_path):
    sets = {"walker_walk expert": 20, "cheetah_run expert": 60, "cheetah_run medium": 20}
    runs = by_set(tmp_path / "sets", {(method, name): sets[name] for method in ("acro", "mik+a") for name in sets})
    assert pooled(runs) == {"acro": 3, "mik+a": 3}
    expert, medium = "walker_walk expert", "walker_walk medium"
    runs = by_set(tmp_path / "methods", {("acro", expert): 20, ("acro", medium): 60, ("mik+a", medium): 20})
    assert pooled(runs) == {"acro, updates 20": 1, "acro, updates 60": 1, "mik+a": 1}


def test_preset_label_replaces_its_settings(tmp_path):
    for preset, k in (("cpu", 15), ("cpu", 1), ("smoke", 3)):
        run = write_run(tmp_path / f"runs/{preset}{k}", "acro", 0, {10: [1.0]})
        describe(run, {"max_k": k, "preset": preset, "steps": len(preset)}, preset=preset)
    labels = {"acro, preset cpu, max_k 15", "acro, preset cpu, max_k 1", "acro, preset smoke, max_k 3"}
    assert set(pooled(tmp_path / "runs")) == labels


def on_set(folder, method, seed, content, collection_seed, updates=10, **collection):
    """Write a run on a dataset with fingerprint `content`, collected with a seed."""
    run = write_run(folder / f"{method}-{seed}-{content}-{updates}", method, seed, {10: [1.0]})
    describe(run, {"data": content}, seed=seed, updates=updates)
    collected(run, content, collection_seed, **collection)


def test_one_set_per_seed_pools_seeds(tmp_path):
    for method, seeds in (("acro", 3), ("mik+a", 2)):
        for seed in range(seeds):
            on_set(tmp_path / "runs", method, seed, f"{seed}" * 24, 100 + seed, rendered_by={"canary": "c", "gl": seed})
    runs = load_runs([tmp_path / "runs"])
    assert pooled(tmp_path / "runs") == {"acro": 3, "mik+a": 2}
    assert unlike(runs) == []
    for seed in range(3):
        on_set(tmp_path / "runs", "acro", seed, "a" * 24, 0, updates=20)
    one, own = "acro, updates 20, data aaaaaaaa", "acro, updates 10, data one a seed"
    assert pooled(tmp_path / "runs") == {one: 3, own: 3, "mik+a": 2}, "next to one set for all seeds"


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1, "content": "0" * 24, "collection_seed": 101},
        {"seed": 1, "content": "1" * 24, "collection_seed": 100},
        {"seed": 0, "content": "1" * 24, "collection_seed": 101},
        {"seed": 1, "content": "1" * 24, "collection_seed": 101, "episodes": 200},
        {"seed": 1, "content": "1" * 24, "collection_seed": 101, "rendered_by": {"canary": "another"}},
    ],
    ids=["same content", "same collection seed", "same seed", "other collection", "other renderer"],
)
def test_other_dataset_contents_are_variants(tmp_path, other):
    on_set(tmp_path, "acro", 0, "0" * 24, 100)
    on_set(tmp_path, "acro", 2, "2" * 24, 102)
    on_set(tmp_path, "acro", **other)
    words = {f"acro, data {content * 8}" for content in ("0", "2", other["content"][0])}
    assert set(pooled(tmp_path)) == words


def on_encoder(folder, seed, encoder, quality="expert"):
    """Write a run of acro on an encoder pretrained with the seed `encoder`."""
    run = write_run(folder / f"{quality}-{encoder}-{seed}", "acro", seed, {10: [1.0]}, labels={"quality": quality})
    return describe(run, {}, encoder_seed=encoder)


def test_seeds_on_one_encoder_do_not_pool(tmp_path):
    for seed in (0, 1, 2):
        on_encoder(tmp_path / "one", seed, encoder=0)
        on_encoder(tmp_path / "own", seed, encoder=seed)
    assert pooled(tmp_path / "own") == {"acro": 3}
    assert pooled(tmp_path / "one") == {"acro": 1, "acro, pretraining seed 0": 2}
    gaps = [(row["variant"], row["seed"]) for row in find_gaps(load_runs([tmp_path / "one"]))]
    assert gaps == [("", 1), ("", 2)], "runs that share the encoder of seed 0 do not lack seed 0"
    for seed, quality in enumerate(("expert", "medium")):
        for own in (2, 3):
            on_encoder(tmp_path / "runs", own, encoder=seed, quality=quality)
    assert pooled(tmp_path / "runs") == {"acro, pretraining seed 0": 2, "acro, pretraining seed 1": 2}
    assert pooled(tmp_path / "runs" / "expert-0-2") == {"acro, pretraining seed 0": 1}


def test_gaps_are_seeds_that_other_conditions_of_the_setting_have(tmp_path):
    made = [
        ("mik+a", 15, "expert", 0),
        ("mik+a", 15, "expert", 1),
        ("mik+a", 1, "expert", 1),
        ("acro", 15, "expert", 2),
    ]
    made += [("mik+a", 15, "medium", 0), ("acro", 15, "medium", 0), ("random", 15, "mixed", 0)]
    for method, k, quality, seed in made:
        run = write_run(
            tmp_path / f"{method}{k}{quality}{seed}", method, seed, {10: [1.0]}, labels={"quality": quality}
        )
        describe(run, {"max_k": k})
    names = ("quality", "method", "variant", "seed", "state")
    assert {tuple(row[name] for name in names) for row in find_gaps(load_runs([tmp_path]))} == {
        ("expert", "mik+a", "max_k 15", 2, "missing"),
        *(("expert", "mik+a", "max_k 1", seed, "missing") for seed in (0, 2)),
        *(("expert", "acro", "", seed, "missing") for seed in (0, 1)),
    }
