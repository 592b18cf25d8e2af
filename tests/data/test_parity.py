import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import parity
from vd4rl_pomdp.data.parity import canary_frames, check_parity, compare, golden_tasks, render_info
from vd4rl_pomdp.envs import rendering


@pytest.fixture(scope="module")
def exact():
    return {task: canary_frames(task) for task in golden_tasks()}


@pytest.mark.parametrize("task", golden_tasks())
def test_environment_renders_golden_frames(exact, task):
    if not render_info()["gl_vendor"].startswith("Mesa"):
        pytest.skip("another renderer draws other edges")
    result = compare(exact[task], parity._golden()[f"{task}/frames"])
    assert result["equal"]
    # the smaller copies of a floor's texture, for distant pixels, differ a little from 3.12 on
    rolled = tuple(int(part) for part in rendering.mujoco.__version__.split(".")[:2]) >= (3, 12)
    assert result["mean_difference"] < (0.2 if rolled else 0.05)
    assert result["share_off_by_8"] < 0.002


@pytest.mark.parametrize("task", golden_tasks())
def test_fast_rendering_mean_difference_is_below_a_twentieth(exact, task):
    fast = canary_frames(task, "fast")
    difference = np.abs(fast.astype(int) - exact[task]).mean()
    assert 0 < difference < 0.05


@pytest.fixture
def unrepaired(monkeypatch):
    """Environments with the skybox of the installed mujoco."""
    monkeypatch.setattr(rendering, "prepare", lambda physics, render, size: None)


@pytest.mark.usefixtures("unrepaired")
def test_canary_fails_without_skybox_repair():
    result = check_parity()
    assert not result["equal"]
    assert not result["canary"]["walker_walk"]["equal"]
    assert not result["canary"]["cheetah_run"]["equal"]


def test_render_info_names_versions_and_renderer(exact):
    info = render_info()
    assert info["canary"] == rendering.frames_hash(exact["walker_walk"])
    assert info["gl_vendor"]
    assert info["gl_renderer"]
    assert info["mujoco"].startswith("3.")


class FakeSet:
    """The attributes of a dataset that parity reads."""

    def __init__(self, task, frames):
        self.task, self.num_rows, self.frames, self.frame_size = task, len(frames), self, 84
        self._frames = frames

    def numpy(self):
        return self._frames


@pytest.fixture(scope="module", params=["walker_walk", "cheetah_run"])
def own_frames(request):
    return request.param, parity._wandering_frames(request.param, 84, 40)


def background(monkeypatch, task, data, rendered):
    monkeypatch.setattr(parity, "open_dataset", lambda path: FakeSet(task, data))
    monkeypatch.setattr(parity, "_wandering_frames", lambda task, size: rendered)
    return parity._compare_background("somewhere")


def test_background_of_own_frames_is_equal(monkeypatch, own_frames):
    task, frames = own_frames
    result = background(monkeypatch, task, frames[:30], frames[10:])
    assert result["equal"]
    assert result["static_pixels"] > 1000


def test_background_under_another_sky_differs(monkeypatch, own_frames):
    task, frames = own_frames
    with monkeypatch.context() as patch:
        patch.setattr(rendering, "prepare", lambda physics, render, size: None)
        others = parity._wandering_frames(task, 84, 40)
    assert not background(monkeypatch, task, others, frames)["equal"]


def test_background_of_set_overrides_canaries(monkeypatch):
    """A GPU renders other canaries, but the same pixels as a set rendered on a GPU."""
    for name in ("canary_frames", "render_info"):
        monkeypatch.setattr(parity, name, lambda *task: None)
    for equal in (False, True):
        monkeypatch.setattr(parity, "_compare_background", lambda path, equal=equal: {"equal": equal})
        monkeypatch.setattr(parity, "compare", lambda *frames, equal=equal: {"equal": not equal})
        assert check_parity("somewhere")["equal"] is equal
        assert check_parity()["equal"] is not equal


def test_parity_of_unknown_task_is_rejected(monkeypatch):
    monkeypatch.setattr(parity, "open_dataset", lambda path: FakeSet(None, np.zeros((2, 3, 84, 84), np.uint8)))
    with pytest.raises(UserError, match="cannot determine the task"):
        parity._compare_background("somewhere")
