import numpy as np
import pytest

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.policies import load_actor, read_actor
from vd4rl_pomdp.policies.train import episode_returns
from vd4rl_pomdp.tasks import get_task

SHIPPED = {
    ("walker_walk", "expert"): 900,
    ("walker_walk", "medium"): 400,
    ("cheetah_run", "expert"): 750,
    ("cheetah_run", "medium"): 300,
}


@pytest.mark.parametrize(("task", "quality"), SHIPPED)
def test_shipped_actors_are_what_their_cards_say(task, quality):
    actor = load_actor(task, quality)
    assert actor.card["return_mean"] >= SHIPPED[task, quality]
    returns = episode_returns(actor, get_task(task), 2)
    assert actor.card["return_min"] - 1 <= min(returns)
    assert max(returns) <= actor.card["return_max"] + 1


def test_sampled_actions_scatter_around_the_mean_action():
    actor = load_actor("walker_walk", "expert")
    state, rng = np.zeros(24, np.float32), np.random.default_rng(0)
    sampled = np.stack([actor.act(state, rng) for _ in range(500)])
    assert sampled.dtype == np.float32
    assert (np.abs(sampled) <= 1).all()
    assert sampled.std(0).min() > 0.01
    below = (sampled < actor.act(state)).mean(0)  # tanh keeps the median
    assert np.allclose(below, 0.5, atol=0.08)


def test_bad_actors_are_refused(tmp_path):
    with pytest.raises(UserError, match="no expert actor ships for humanoid_walk"):
        load_actor("humanoid_walk", "expert")
    path = tmp_path / "actor.safetensors"
    path.write_bytes(b"\x80\x04 a pickle")
    with pytest.raises(UserError, match="not an actor file"):
        read_actor(path)
    load_actor("walker_walk", "medium").save(path)
    with pytest.raises(UserError, match="trained on walker_walk, not on cheetah_run"):
        read_actor(path, get_task("cheetah_run"))
