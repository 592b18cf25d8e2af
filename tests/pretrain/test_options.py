"""Options belong to the plug-ins that read them; options that no selected plug-in reads are rejected."""

import pytest

from finetune.config import FinetuneConfig, as_trained
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from tests.helpers_stages import option_names
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import NO_OPTIONS, flat
from vd4rl_pomdp.runs.files import content_hash, jsonable
from vd4rl_pomdp.studies.navigation.config import NavigationConfig


@pytest.mark.parametrize(
    ("settings", "reader"),
    [
        ({"method": "acro", "literal_future": True}, "the method acro"),
        ({"method": "acro", "m": 3}, "the method acro, .*the history method, the corruption none"),
        ({"method": "ah", "n": 3}, "the method ah"),
        ({"method": "one_step_inverse", "max_k": 2}, "the method one_step_inverse"),
        ({"method": "curl", "action_target": "mse"}, "the method curl"),
        ({"method": "state", "feature_dim": 3}, "the method state"),
        ({"method": "supervised+a", "pose_noise": 3.0}, "the method supervised.a"),
        ({"method": "mik+a", "codes": 7, "action_target": "mse"}, "the action target mse"),
        ({"history": "lru", "gru_layers": 2}, "the history lru"),
        ({"patch_size": 8}, "the corruption none"),
        ({"corruption": "patch", "zeroed_frames": 1}, "the corruption patch"),
        ({"no_such_setting": 1}, "the method"),
    ],
)
def test_unread_options_are_rejected(settings, reader):
    name = next(name for name in settings if name not in PretrainConfig.choosers or name == "action_target")
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is not read by .*{reader}.*: leave it out"):
        PretrainConfig.of("smoke", **settings).check()


def test_integer_for_a_float_setting_is_recorded_as_a_float():
    settings = [jsonable(flat(FinetuneConfig.of("smoke", alpha=alpha, learning_rate=1))) for alpha in (5, 5.0)]
    assert content_hash(settings[0]) == content_hash(settings[1])
    assert type(settings[0]["updates"]) is int


def test_state_frame_encoder_is_limited_to_some_methods():
    for method in ("mik+a", "acro", "random"):
        PretrainConfig.of("smoke", method=method, frame_encoder="state", hidden_share=0.5).check()
    for method in ("curl", "bc", "supervised"):
        with pytest.raises(UserError, match=f"--frame-encoder state is for .*, not {method}"):
            PretrainConfig.of("smoke", method=method, frame_encoder="state").check()


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "mik+a", "literal_future": True, "n": 2, "m": 3, "gru_layers": 2, "codes": 7},
        {"method": "acro", "history": "gru", "m": 3, "hidden_dim": 16},
        {"method": "fj", "m": 3},
        {"method": "homer", "homer_codes": 8},
        {"method": "driml", "max_k": 2},
        {"method": "curl", "window": 3},  # shorter than the default max_k of other methods
        {"method": "random", "steps": 7, "batch_size": 3, "corruption": "patch", "patch_size": 8},
        {"method": "bc", "feature_dim": 16},
        {"method": "supervised+a", "head_dim": 16, "m": 3, "gru_layers": 2, "frame_encoder": "drq"},
        {"method": "state", "pose_noise": 25.0, "velocity_noise": 33.0},
        {"corruption": "patch+zero_frames", "corruption_mode": "emission", "patch_shared": True, "zeroed_frames": 1},
    ],
)
def test_read_options_are_accepted(settings):
    config = PretrainConfig.of("smoke", **settings)
    config.check()
    assert flat(config) | settings == flat(config)


@pytest.mark.parametrize("preset", PretrainConfig.presets)
@pytest.mark.parametrize("method", METHODS)
def test_preset_defaults_are_valid_for_all_methods(method, preset):
    PretrainConfig.of(preset, method=method).check()


def test_presets_set_options_of_selected_plugins():
    smoke, paper = (PretrainConfig.of(preset, method="driml") for preset in ("smoke", "paper"))
    assert (smoke.options.max_k, paper.options.max_k) == (3, 2)
    assert set(PretrainConfig.presets["smoke"]) <= {*flat(PretrainConfig()), *option_names()}


@pytest.mark.parametrize("kind", [PretrainConfig, NavigationConfig, FinetuneConfig])
def test_unknown_preset_lists_the_choices(kind):
    with pytest.raises(UserError, match="unknown preset 'large': choose one of paper, cpu, smoke"):
        kind.of("large")


@pytest.mark.parametrize(("max_k", "window"), [(8, 8), (31, 8)])
def test_max_k_beyond_the_window_is_rejected(max_k, window):
    with pytest.raises(UserError, match=f"--max-k {max_k} needs windows of more"):
        PretrainConfig.of("smoke", max_k=max_k, window=window).check()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action_target": "ordinal"}, "unknown action target 'ordinal'"),
        ({"frame_encoder": "vit"}, "unknown frame encoder 'vit'"),
        ({"method": "mik", "history": "none"}, "unknown --history 'none': choose one of method, gru"),
        ({"method": "bc", "history": "gru"}, "bc has no memory"),
        ({"method": "integrator", "history": "gru"}, "integrator implies its memory"),
        ({"method": "integrator", "m": 2}, "--m is not for integrator, which trains on whole histories"),
        ({"method": "curl", "shift": 0}, "--shift is not read by the method curl"),
        ({"method": "state", "shift": 2}, "--shift is not read by the method state"),
        ({"method": "state", "frame_encoder": "drq"}, "--frame-encoder is not read by the method state"),
    ],
)
def test_invalid_option_values_are_rejected(settings, message):
    with pytest.raises(UserError, match=message):
        PretrainConfig.of("smoke", **settings).check()


@pytest.mark.parametrize(
    ("settings", "flag"),
    [
        ({"method": "ah+a", "literal_future": True}, "literal-future"),
        ({"method": "no_history", "m": 3}, "m"),
        ({"exogenous_weight": 0.2}, "exogenous-weight"),
        ({"history_window": 3}, "history-window"),
    ],
)
def test_navigation_rejects_unread_options(settings, flag):
    with pytest.raises(UserError, match=f"--{flag} is not read by"):
        NavigationConfig.of("smoke", **settings)


@pytest.mark.parametrize("method", ["random", "supervised+a", "mik+a", "fj", "no_history"])
def test_navigation_accepts_grid_settings(method):
    NavigationConfig.of("smoke", method=method, max_k=15).check()


def test_end_to_end_encoder_determines_algorithm_and_options():
    config = FinetuneConfig.of("smoke", views=3, alpha=5.0, n_step=2)
    trained = as_trained(config, "drqv2_bc", False, "walker_walk")
    assert trained == as_trained(
        FinetuneConfig.of("smoke", algorithm="drqv2_bc", views=0, alpha=5.0, n_step=2), "", False, "walker_walk"
    )
    assert trained.memory == NO_OPTIONS
    assert not {"alpha", "n_step"} & flat(as_trained(config, "bc", False, "walker_walk")).keys(), (
        "bc does not read them"
    )
