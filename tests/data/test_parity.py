import numpy as np
import pytest

from tests.helpers_data import fake_rows, write_fake_set, write_rows
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


def test_canary_fails_without_skybox_repair(monkeypatch):
    monkeypatch.setattr(rendering, "prepare", lambda physics, render, size: None)
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


@pytest.mark.parametrize("task", ["walker_walk", "cheetah_run"])
def test_background_of_a_set_decides(tmp_path, monkeypatch, task):
    """A GPU renders other canaries, but the same pixels as a set rendered on a GPU."""
    sets = {}
    for name in ("ours", "other sky"):
        with monkeypatch.context() as patch:
            if name == "other sky":
                patch.setattr(rendering, "prepare", lambda physics, render, size: None)
            frames = parity._wandering_frames(task, 84, 40)
        sets[name] = write_rows(tmp_path / task / name, fake_rows([40]) | {"observation": frames})
    canaries = {name: value for name, value in parity._golden().items() if name.endswith("/frames")}
    monkeypatch.setattr(parity, "canary_frames", lambda name, env=None: canaries[f"{name}/frames"] // 2)
    result = check_parity(sets["ours"])
    assert result["equal"]
    assert result["background"]["static_pixels"] > 1000
    assert not check_parity()["equal"]
    monkeypatch.setattr(parity, "canary_frames", lambda name, env=None: canaries[f"{name}/frames"])
    assert not check_parity(sets["other sky"])["equal"]
    assert check_parity()["equal"]


def test_parity_of_unknown_task_is_rejected(tmp_path):
    with pytest.raises(UserError, match="cannot determine the task"):
        check_parity(write_fake_set(tmp_path / "set"))
