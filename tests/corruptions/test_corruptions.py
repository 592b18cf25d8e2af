import re

import pytest
import torch

from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import flat, settings_of
from vd4rl_pomdp.corruptions import (
    CORRUPTIONS,
    STAGES,
    BatchCorruption,
    CorruptionConfig,
    KeyStream,
    Patch,
    augmentation,
    check_corruption_fits,
    draw_integers,
    make_corruption,
)
from vd4rl_pomdp.corruptions.augmentation import random_shift, shift_by_index
from vd4rl_pomdp.data import Dataset, View, open_dataset


def stacks(n: int = 64) -> torch.Tensor:
    return torch.randint(1, 256, (n, 9, 84, 84), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (CorruptionConfig(corruption="patch+zero_frames"), r"create it with CorruptionConfig.of\('patch\+zero_frames'"),
        (CorruptionConfig("patch", "emision", (Patch(),)), "unknown corruption mode 'emision': choose one of resample"),
    ],
)
def test_inconsistent_configs_are_rejected(dataset, config, message):
    for make in (make_corruption, lambda config: BatchCorruption(config, 0), lambda config: View(dataset, config)):
        with pytest.raises(UserError, match=message):
            make(config)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("fog", {}, "unknown corruption 'fog': choose one of patch, zero_frames"),
        ("zero_frames+patch", {}, r"unknown corruption .*: join stages with \+, each at most once, with zero_frames"),
        ("patch+patch", {}, "each at most once"),
        ("zero_frames+truncate", {}, "zero_frames or truncate only at the end"),
        ("patch", {"patch_size": 85}, "choose a smaller --patch-size"),
        ("zero_frames", {"zeroed_frames": 4}, "cannot zero 4 of 3 stacked frames: choose a smaller --zeroed-frames"),
        ("zero_frames", {"zeroed_frames": 3, "keep_newest": True}, "3 of 3 stacked frames and keep the newest"),
        ("truncate", {"kept": "middle"}, "--kept 'middle': choose one of newest, oldest"),
    ],
)
def test_invalid_corruptions_are_rejected(name, options, message):
    with pytest.raises(UserError, match=message):
        check_corruption_fits(CorruptionConfig.of(name, **options))


@pytest.mark.parametrize("key", [torch.arange(1), torch.arange(5), torch.arange(12).int(), torch.arange(12.0)])
def test_keys_must_match_stacks(key):
    with pytest.raises(UserError, match=r"need int64 ones of shape \(12,\), one a stack"):
        make_corruption("patch")(stacks(12), key)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    """Three short episodes of random pixels."""
    return open_dataset(write_fake_set(tmp_path_factory.mktemp("noise"), [7, 5, 12], noise=84))


def test_draws_are_uniform_and_depend_on_every_key():
    draws = draw_integers(torch.arange(20_000), 69, 3)
    counts = torch.stack([draws[:, i].bincount(minlength=69) for i in range(3)])
    expected = 20_000 / 69
    chi_square = ((counts - expected) ** 2 / expected).sum(1)
    assert (chi_square < 125).all()  # 68 degrees of freedom: 99.99% quantile is 119
    correlation = torch.corrcoef(draws.T.double())
    assert (correlation - torch.eye(3)).abs().max() < 0.03


def test_patch_zeroes_one_square_per_frame():
    obs = stacks()
    out = make_corruption("patch")(obs, torch.arange(64))
    frames = out.view(64 * 3, 3, 84, 84)
    hidden = (frames == 0).all(1)
    assert (hidden.sum((1, 2)) == 16 * 16).all()
    rows, columns = hidden.any(2).sum(1), hidden.any(1).sum(1)
    assert (rows == 16).all()
    assert (columns == 16).all()
    assert torch.equal(out[out != 0], obs[out != 0])
    assert len(torch.unique(hidden.view(64 * 3, -1).int().argmax(1))) > 100


@pytest.mark.parametrize("name", ["patch", "patch+zero_frames"])
def test_patch_position_is_uniform(name):
    """With 5 vertical and 5 horizontal positions all 25 squares are equally likely, whichever frames are zeroed."""
    frames = torch.full((2000, 9, 20, 20), 255, dtype=torch.uint8)
    hidden = (make_corruption(name)(frames, torch.arange(2000)).view(6000, 3, 20, 20) == 0).all(1)
    hidden = hidden[~hidden.all((1, 2))]
    top, left = hidden.any(2).int().argmax(1), hidden.any(1).int().argmax(1)
    counts = (5 * top + left).bincount(minlength=25)
    assert len(counts) == 25
    expected = len(hidden) / 25
    assert ((counts - expected) ** 2 / expected).sum() < 60  # chi-square, 24 degrees of freedom: 99.99% quantile is 58


@pytest.mark.parametrize("shared", [True, False])
def test_patches_of_a_stack_may_share_a_position(shared):
    config = CorruptionConfig.of("patch", patch_shared=shared, patch_count=2)
    out = make_corruption(config)(stacks(), torch.arange(64))
    hidden = (out.view(64, 3, 3, 84, 84) == 0).all(2)
    assert torch.equal(hidden[:, 0], hidden[:, 1]) == shared
    assert (hidden[:, 0] & hidden[:, 1]).flatten(1).any(1).all() == shared, "no patch of the next frame"


def test_zero_frames_blanks_two_of_three_uniformly():
    out = make_corruption("zero_frames")(stacks(1).expand(3000, -1, -1, -1), torch.arange(3000))
    blank = (out.view(3000, 3, -1) == 0).all(2)
    assert (blank.sum(1) == 2).all()
    assert ((blank.float().mean(0) - 2 / 3).abs() < 0.03).all()


def test_resample_redraws_and_emission_does_not():
    obs, row_key = stacks(4), torch.arange(4)
    for mode, same in (("resample", False), ("emission", True)):
        corruption, other = (BatchCorruption(CorruptionConfig.of("patch", mode), seed) for seed in range(2))
        assert not torch.equal(corruption(obs.clone(), row_key), other(obs.clone(), row_key))
        assert torch.equal(corruption(obs.clone(), row_key), corruption(obs.clone(), row_key)) == same
    a, b = (BatchCorruption(CorruptionConfig.of("patch"), seed=3) for _ in range(2))
    assert torch.equal(a(obs.clone(), row_key), b(obs.clone(), row_key))


def test_key_stream_continues_from_its_position():
    whole = KeyStream(1).take((10,))
    stream = KeyStream(1, position=4)
    assert torch.equal(stream.take((6,)), whole[4:])
    assert stream.position == 10
    assert not torch.equal(KeyStream(2).take((10,)), whole)


def test_random_shift_equals_padding_and_cropping():
    obs, key = stacks(32), torch.arange(32)
    shifted = random_shift(obs, key, pad=4)
    padded = torch.nn.functional.pad(obs.float(), (4, 4, 4, 4), mode="replicate").to(torch.uint8)
    offset = draw_integers(key, 9, 2)
    for i in range(32):
        y, x = offset[i].tolist()
        assert torch.equal(shifted[i], padded[i, :, y : y + 84, x : x + 84])
    assert len(torch.unique(offset, dim=0)) > 15
    windows = random_shift(obs.view(4, 8, 9, 84, 84), key[:4])
    assert torch.equal(windows[0, 3], random_shift(obs[3:4], key[:1])[0])
    assert random_shift(obs, key, pad=0) is obs


def test_random_shift_matches_drq_interpolation():
    """DrQ-v2's code with given shifts: at integer shifts its weights are 0 and 1 up to float32 precision."""
    obs, key, pad = stacks(32), torch.arange(32), 4
    padded = torch.nn.functional.pad(obs.float(), (pad,) * 4, mode="replicate")
    side = 84 + 2 * pad
    places = torch.linspace(-1 + 1 / side, 1 - 1 / side, side)[:84].repeat(84, 1)[..., None]
    grid = torch.cat([places, places.transpose(0, 1)], 2).repeat(32, 1, 1, 1)
    chosen = draw_integers(key, 2 * pad + 1, 2).flip(1).view(32, 1, 1, 2) * (2.0 / side)
    theirs = torch.nn.functional.grid_sample(padded, grid + chosen, padding_mode="zeros", align_corners=False)
    difference = (theirs - random_shift(obs, key, pad)).abs()
    assert difference.max() < 0.004
    assert 0.5 < (difference == 0).float().mean() < 0.7


@pytest.mark.parametrize("shape", [(1, 3, 20, 30), (7, 2, 3, 12, 12), (64, 9, 84, 84)])
@pytest.mark.parametrize("pad", [1, 4])
def test_shift_implementations_agree(shape, pad):
    obs = torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    offset = draw_integers(torch.arange(shape[0]), 2 * pad + 1, 2) - pad
    expected = shift_by_index(obs, offset)
    assert torch.equal(random_shift(obs, torch.arange(shape[0]), pad), expected)


@pytest.mark.parametrize("name", ["none", "bars+wide", "patch+"])
def test_reserved_stage_names_are_rejected(name):
    with (
        STAGES.isolated(),
        pytest.raises(UserError, match=re.escape(f"corruption '{name}': 'none' and names with '+'")),
    ):
        STAGES.register(name, type("Bars", (Patch,), {}))


@pytest.mark.parametrize(("zeroed", "older"), [(1, 1 / 2), (2, 1)])
def test_zero_frames_can_keep_the_newest_frame(zeroed, older):
    config = CorruptionConfig.of("zero_frames", zeroed_frames=zeroed, keep_newest=True)
    out = make_corruption(config)(stacks(1).expand(3000, -1, -1, -1), torch.arange(3000))
    blank = (out.view(3000, 3, -1) == 0).all(2).float()
    assert (blank.sum(1) == zeroed).all()
    assert blank.mean(0).tolist() == pytest.approx([older, older, 0], abs=0.03)


@pytest.mark.parametrize(("kept", "age"), [("newest", 0), ("oldest", 2)])
@pytest.mark.parametrize("name", ["truncate", "patch+truncate"])
def test_truncated_rows_show_the_newest_or_oldest_frame(dataset, name, kept, age):
    """Row t shows only frame t or t - 2; an episode's first frame replaces missing ones."""
    view = View(dataset, CorruptionConfig.of(name, "emission", kept=kept))
    rows, plain = torch.arange(dataset.num_rows), dataset.frames
    before = view.observe(rows).clone()
    first = dataset.episode_start[dataset.episode]
    for frame in rows.tolist():
        dataset.frames = plain.clone()
        dataset.frames[frame] = 255 - plain[frame]
        changed = (view.observe(rows) != before).flatten(1).any(1)
        assert torch.equal(changed, torch.maximum(rows - age, first) == frame), frame
    dataset.frames = plain


def test_keep_newest_default_is_not_recorded():
    old = {"corruption": "zero_frames", "corruption_mode": "resample", "zeroed_frames": 2}
    assert settings_of(flat(CorruptionConfig.of("zero_frames"))) == old
    assert settings_of(flat(CorruptionConfig.of("zero_frames", keep_newest=True))) == old | {"keep_newest": True}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_shift_by_index_gives_the_same_observations(dataset, monkeypatch, name):
    """A GPU shifts whole stacks by index."""
    rows, seen = torch.arange(dataset.num_rows).view(2, -1), []
    for by_lines in (True, False):
        if not by_lines:
            monkeypatch.setattr(augmentation, "by_lines", lambda images, pad: False)
        seen.append(View(dataset, CorruptionConfig.of(name), 4).observe(rows).clone())
    assert torch.equal(*seen)
