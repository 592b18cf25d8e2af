"""Frames that no agent sees are not rendered; observations stay bit-identical."""

import numpy as np
import pytest
import torch

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.envs.corrupted import CorruptedEnv, Drawn

ROWS = 40


def episode(
    name: str, draws: Drawn, task: str = "walker_walk", **options
) -> tuple[list[torch.Tensor], list[float], int]:
    """Observations, rewards, and the number of rendered frames."""
    env, rng = (
        CorruptedEnv(TASKS[task], CorruptionConfig.of(name, **options), length=ROWS, draws=draws),
        np.random.default_rng(0),
    )
    shown, drawn = [env.reset(5, 6, 7)], 0
    while not shown[-1].time_step.last:
        drawn += shown[-1].time_step.frame is not None
        shown.append(env.step(rng.uniform(-1, 1, 6).astype(np.float32)))
    drawn += shown[-1].time_step.frame is not None
    return [now.obs for now in shown], [now.time_step.reward for now in shown], drawn


@pytest.mark.parametrize("name", ["none", "patch", "zero_frames", "patch+zero_frames"])
def test_skipping_hidden_frames_does_not_change_observations(name):
    everything, rewards, drawn = episode(name, "all")
    seen, same_rewards, fewer = episode(name, "seen")
    assert torch.equal(torch.stack(seen), torch.stack(everything))
    assert rewards == same_rewards
    assert drawn == ROWS + 1
    assert fewer < 0.85 * drawn if "zero_frames" in name else fewer == drawn, "a third of the stacks show a frame"


@pytest.mark.parametrize("options", [{"kept": "newest"}, {"kept": "oldest"}])
def test_truncated_stacks_show_one_frame(options):
    """The stack's only frame is the newest one or the one of two rows before."""
    everything, seen = (episode("truncate", draws, **options) for draws in ("all", "seen"))
    assert torch.equal(torch.stack(seen[0]), torch.stack(everything[0]))
    assert [int(obs.flatten(1).any(1).view(3, 3).any(1).sum()) for obs in seen[0]] == [1] * (ROWS + 1)
    assert seen[2] <= everything[2]


def test_unobserved_environments_render_nothing():
    shown, rewards, drawn = episode("patch", "nothing")
    assert drawn == 0
    assert {obs.numel() for obs in shown} == {0}
    assert rewards == episode("patch", "all")[1]
