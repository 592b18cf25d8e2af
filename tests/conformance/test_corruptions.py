"""All corruptions satisfy the contract of corruptions; violations are caught."""

from dataclasses import dataclass

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.corruptions import CORRUPTIONS, STAGES, Corruption, FrameDrop, Patch
from vd4rl_pomdp.testing import check_corruption
from vd4rl_pomdp.testing import corruptions as checks
from vd4rl_pomdp.testing.contract import run_check


@pytest.mark.parametrize("check", checks.CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", dict.fromkeys([*CORRUPTIONS, *STAGES]))
def test_corruption_conforms(name, check):
    run_check("corruption", check, name)


@pytest.mark.parametrize("zeroed", [1, 2, 3])
@pytest.mark.parametrize(
    "options", [{}, {"patch_fill": 7, "patch_count": 2}, {"patch_shared": True}], ids=["", "two grey ones", "shared"]
)
def test_patch_and_zero_frames_conform_with_options(options, zeroed):
    check_corruption("patch+zero_frames", zeroed_frames=zeroed, **options)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("zero_frames", {"keep_newest": True, "zeroed_frames": 1}),
        ("patch+zero_frames", {"keep_newest": True}),
        ("truncate", {"kept": "oldest"}),
        ("patch+truncate", {"kept": "newest"}),
    ],
)
def test_frame_drops_conform_with_options(name, options):
    check_corruption(name, **options)


@dataclass(frozen=True)
class Alternating(FrameDrop):
    """Drops one frame: the newest for even keys, the oldest for odd ones."""

    def dropped(self, stack):
        return 1

    def order(self, key, stack):
        return torch.arange(stack) * torch.where(key % 2 == 0, -1, 1)[:, None]


def test_user_defined_frame_drop_conforms():
    STAGES.register("mine", Alternating)
    for name in ("mine", "patch+mine"):
        check_corruption(name)
    with pytest.raises(UserError, match="zero_frames or truncate or mine only at the end"):
        check_corruption("mine+patch")


@dataclass(frozen=True)
class Nothing(Options):
    def __call__(self, frames, key, number):
        pass


@dataclass(frozen=True)
class Batchwise(Options):
    """Draws one position for the whole batch."""

    def __call__(self, frames, key, number):
        frames[..., int(key.sum() % 80) :, :] = 0


@dataclass(frozen=True)
class Exposing(Options):
    """Stretches contrast to the brightest pixel of the batch."""

    def __call__(self, frames, key, number):
        frames.copy_((frames * (255 / frames.amax())).to(torch.uint8))


@dataclass(frozen=True)
class Drawing(Options):
    def __call__(self, frames, key, number):
        frames[..., int(torch.randint(80, ())) :, :] = 0


@dataclass(frozen=True)
class Counting(Options):
    """Hides another column in every call."""

    def __call__(self, frames, key, number):
        CALLS.append(1)
        frames[..., len(CALLS) % 80, :] = 0


CALLS: list[int] = []


@dataclass(frozen=True)
class Elsewhere(Patch):
    """Hides other pixels on a GPU."""

    def hides(self, places, y, x):
        return super().hides(places, y + 1, x)


@dataclass(frozen=True)
class Inheriting(Patch):
    """Overrides `__call__`, so the inherited description of hidden pixels is wrong."""

    def __call__(self, frames, key, number):
        frames[..., 0, :] = 0


@dataclass(frozen=True)
class Failing(Options):
    def __call__(self, frames, key, number):
        raise IndexError("no such column")


@dataclass(frozen=True)
class Wavering(Alternating):
    """Drops another frame in every call."""

    def order(self, key, stack):
        CALLS.append(1)
        return (torch.arange(stack) + len(CALLS)).remainder(stack).expand(len(key), -1)


MUTANTS = [
    (Nothing, checks.something_changes, "none differs"),
    (Batchwise, checks.equal_keys_give_equal_masks, "a stack looks different in a batch than by itself"),
    (Exposing, checks.equal_keys_give_equal_masks, "a stack looks different in a batch than by itself"),
    (Drawing, checks.draws_depend_only_on_keys, "equal keys gave different pixels"),
    (Counting, checks.emission_never_changes_a_row, "a row looked different the second time"),
    (Counting, checks.a_view_shows_shifted_then_corrupted_stacks, "they differ under resample with a shift of 0"),
    (Elsewhere, checks.a_view_shows_shifted_then_corrupted_stacks, "a GPU would hide other pixels"),
    (Wavering, checks.dropped_frames_stay_dropped, "a dropped frame is not black"),
    (Failing, checks.pixels_stay_pixels, "IndexError: no such column"),
]


def test_overridden_call_of_a_subclass_is_used():
    STAGES.register("mine", Inheriting)
    run_check("corruption", checks.a_view_shows_shifted_then_corrupted_stacks, "mine")


@pytest.mark.parametrize(("kind", "check", "reason"), MUTANTS, ids=lambda value: getattr(value, "__name__", ""))
def test_nonconforming_corruptions_are_caught(kind, check, reason):
    STAGES.register("mine", kind)
    with pytest.raises(AssertionError, match=f"corruption 'mine' violates its contract(.|\n)*{reason}"):
        run_check("corruption", check, "mine")


def test_modified_input_is_caught(monkeypatch):
    monkeypatch.setattr(Corruption, "__call__", Corruption.apply_)
    with pytest.raises(AssertionError, match="the input was changed"):
        run_check("corruption", checks.pixels_stay_pixels, "patch")


def test_check_corruption_accepts_options():
    STAGES.register("larger", type("Larger", (Patch,), {}))
    check_corruption("larger", patch_size=20)
    with pytest.raises(UserError, match="--zeroed-frames is not read by the corruption patch"):
        check_corruption("patch", zeroed_frames=1)
    with pytest.raises(UserError, match="unknown corruption 'fog'"):
        check_corruption("fog")
