"""A setting that a method does not read is refused: a run must not claim what it did not do."""

from dataclasses import fields, replace

import pytest

import finetune.config
import pretrain.navigation.config
from finetune.train import check as check_finetuning
from pretrain.config import PRESETS, PretrainConfig
from pretrain.navigation.train import _check as check_navigation
from pretrain.objectives import METHODS, OPTIONS, unread_options
from pretrain.train import check
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.objective import InverseConfig

SMOKE, NAVIGATION = PRESETS["smoke"], pretrain.navigation.config.PRESETS["smoke"]
FINETUNING = finetune.config.PRESETS["smoke"]


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("acro", {"literal_future": True}),
        ("mik", {"literal_future": True}),
        ("acro", {"m": 3}),
        ("acro", {"gru_layers": 2}),
        ("ah", {"n": 3}),
        ("mik+a", {"homer_codes": 8}),
        ("one_step_inverse", {"max_k": 2}),
        ("curl", {"action_target": "mse"}),
        ("driml", {"self_prediction": 1.0}),
        ("bc", {"k_embedding": False}),
        ("state", {"frame_encoder": "drq"}),
        ("mik+a", {"action_target": "mse", "codes": 7}),
    ],
)
def test_what_a_method_does_not_read_is_refused(method, changes):
    flag = max(changes).replace("_", "-")
    with pytest.raises(UserError, match=rf"--{flag} is not read by {method.replace('+', '.')}: leave it out"):
        check(replace(SMOKE, method=method, **changes))


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("mik+a", {"literal_future": True, "n": 2, "m": 3, "gru_layers": 2, "codes": 7}),
        ("acro", {"history": "gru", "m": 3, "hidden_dim": 16}),
        ("fj", {"m": 3, "history_window": 2}),
        ("homer", {"homer_codes": 8}),
        ("driml", {"max_k": 2}),
        ("curl", {"window": 3}),  # which is shorter than the default K that it does not read
        ("random", {"steps": 7, "batch_size": 3, "corruption": "patch", "patch_size": 8}),
        ("bc", {"feature_dim": 16}),
    ],
)
def test_what_a_method_reads_is_taken(method, changes):
    check(replace(SMOKE, method=method, **changes))


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_a_presets_own_defaults_are_never_refused(method, preset):
    check(replace(PRESETS[preset], method=method))


def test_options_are_settings_and_every_inverse_setting_is_one():
    assert (
        {field.name for field in fields(InverseConfig)} <= OPTIONS <= {field.name for field in fields(PretrainConfig)}
    )
    read = {name for method in METHODS for name in OPTIONS - unread_options(replace(SMOKE, method=method))}
    assert read == OPTIONS, "an option that no method reads"


@pytest.mark.parametrize(("max_k", "window"), [(8, 8), (31, 8)])
def test_a_gap_beyond_the_window_is_refused(max_k, window):
    with pytest.raises(UserError, match=f"--max-k {max_k} needs windows of more"):
        check(replace(SMOKE, max_k=max_k, window=window))


@pytest.mark.parametrize(
    ("changes", "flag"),
    [
        ({"method": "ah+a", "literal_future": True}, "literal-future"),
        ({"method": "no_history", "m": 3}, "m"),
        ({"method": "supervised", "self_prediction": 1.0}, "self-prediction"),
        ({"method": "random", "n": 3}, "n"),
        ({"exogenous_weight": 0.2}, "exogenous-weight"),
    ],
)
def test_what_a_navigation_run_does_not_read_is_refused(changes, flag):
    with pytest.raises(UserError, match=f"--{flag} is not read by"):
        check_navigation(replace(NAVIGATION, **changes))


@pytest.mark.parametrize("method", ["random", "supervised+a", "mik+a", "fj", "no_history"])
def test_the_grids_settings_are_read(method):
    check_navigation(replace(NAVIGATION, method=method, max_k=15))


@pytest.mark.parametrize("name", ["alpha", "gamma", "n_step"])
def test_cloning_reads_no_option_of_the_critic(name):
    changed = replace(FINETUNING, **{name: 1})
    check_finetuning(changed)
    check_finetuning(replace(changed, algorithm="drqv2_bc"))
    for config, end_to_end in ((replace(changed, algorithm="bc"), ""), (changed, "bc")):
        with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is not read by the algorithm bc"):
            check_finetuning(config, end_to_end)


@pytest.mark.parametrize(
    ("algorithm", "reads"),
    [("td3_bc", ["alpha"]), ("drqv2_bc", ["alpha"]), ("iql", ["expectile", "temperature"]), ("bc", [])],
)
def test_an_algorithm_reads_its_own_options_only(algorithm, reads):
    for name in ("alpha", "expectile", "temperature"):
        changed = replace(FINETUNING, algorithm=algorithm, **{name: 0.5})
        if name in reads:
            check_finetuning(changed)
        else:
            with pytest.raises(UserError, match=f"--{name} is not read by the algorithm {algorithm}"):
                check_finetuning(changed)


def test_an_encoder_that_is_trained_has_no_views():
    with pytest.raises(UserError, match="--views is not read by the algorithm drqv2_bc"):
        check_finetuning(replace(FINETUNING, views=3), "drqv2_bc")
