"""Equal names for equal results: settings, seed, data and format count; folder, machine and logging do not."""

import copy

import pytest

from vd4rl_pomdp.runs.run import identity, recipe

RECORD = {
    "format": 3,
    "stage": "finetune",
    "config": {"seed": 0, "updates": 40, "out": "a", "data": "d", "encoder": "e", "device": "auto", "log_every": 5},
    "inputs": {"data": "f00d", "encoder": "beef"},
}
CARD = {"settings": {"steps": 20, "method": "acro"}, "seed": 0, "data": "f00d"}
SAME = (("config", "out", "b"), ("config", "device", "cuda"), ("config", "log_every", 9), ("inputs", "encoder", "x"))
OTHER = (("config", "seed", 1), ("config", "updates", 41), ("format", None, 4), ("stage", None, "pretrain"))


def _changed(value, key, inner, new):
    value = copy.deepcopy(value)
    if inner is None:
        value[key] = new
    else:
        value[key][inner] = new
    return value


@pytest.mark.parametrize("change", SAME)
def test_place_and_logging_do_not_count(change):
    assert identity(_changed(RECORD, *change), CARD) == identity(RECORD, CARD)


@pytest.mark.parametrize("change", OTHER)
def test_settings_count(change):
    record = _changed(RECORD, *change)
    assert recipe(record, CARD) != recipe(RECORD, CARD)
    assert identity(record, CARD) != identity(RECORD, CARD)


def test_a_setting_of_a_later_version_counts_where_it_changes_what_all_did_before():
    def names(value):
        told = ("config", "future_frames", value), ("settings", "future_frames", value)
        return recipe(_changed(RECORD, *told[0]), {}), recipe(RECORD, _changed(CARD, *told[1]))

    assert names("all")[0] == recipe(RECORD, {})
    assert names("newest")[0] != recipe(RECORD, {})
    assert names("newest")[1] != recipe(RECORD, CARD)


@pytest.mark.parametrize("change", [("seed", None, 1), ("settings", "steps", 21)])
def test_how_the_encoder_was_pretrained_counts(change):
    assert recipe(RECORD, _changed(CARD, *change)) != recipe(RECORD, CARD)


def test_the_content_of_both_sets_counts_for_the_identity_alone():
    own, before = _changed(RECORD, "inputs", "data", "0ff"), _changed(CARD, "data", None, "0ff")
    names = {identity(RECORD, CARD), identity(own, CARD), identity(RECORD, before), identity(own, before)}
    assert len(names) == 4
    assert recipe(own, before) == recipe(RECORD, CARD)


def test_images_of_a_folder_are_told_by_their_content_and_made_ones_by_their_name():
    def named(exogenous, content):
        record = _changed(RECORD, "config", "exogenous", exogenous)
        return identity(_changed(record, "inputs", "exogenous", content), {})

    assert named("cifar", "f1") == named("cifar", "f1") != named("cifar", "f2")
    assert named("textures", "textures") == identity(_changed(RECORD, "config", "exogenous", "textures"), {})
