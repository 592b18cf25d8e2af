import pytest
import torch

from finetune.algorithms import TD3BC
from finetune.algorithms.td3_bc import TD3BCOptions
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.policy import Policy

jax = pytest.importorskip("jax", reason="JAX comes with the extra `policy`")


def test_jax_peer_matches_td3_bc_updates():
    from vd4rl_pomdp.bench import jax_peer

    torch.manual_seed(0)
    views, rows, dim, actions, size, updates = 2, 50, 12, 3, 16, 20
    table = {
        "features": torch.randn(views, rows, dim).half(),
        "first": torch.randint(rows, (views, rows)),
        "last": torch.randint(rows, (views, rows)),
        "action": torch.rand(rows, actions) * 2 - 1,
        "reward": torch.rand(rows),
        "discount": (torch.rand(rows) > 0.1).float() * 0.9,
    }
    policy = Policy(dim, actions, 24)
    policy.standardise.fit(table["features"])
    algorithm = TD3BC(policy, TD3BCOptions(), 3e-4, updates, RandomStream(torch.Generator().manual_seed(1)))
    learnt = jax_peer.learnt_by(algorithm)
    index, view = torch.randint(rows, (updates, size)), torch.randint(views, (updates, size))
    noise = torch.randn(updates, size, actions, generator=torch.Generator().manual_seed(1))
    ours = []
    for i, v in zip(index, view, strict=True):
        ends = [table["features"][v, table[end][v, i]].float() for end in ("first", "last")]
        taken = [table[name][i] for name in ("action", "reward", "discount")]
        ours.append(algorithm.update(FeatureBatch(ends[0], *taken, ends[1], taken[0])))
    arrays = {name: jax_peer.as_jax(tensor) for name, tensor in table.items()}
    arrays |= {name: jax_peer.as_jax(getattr(policy.standardise, name)) for name in ("mean", "std")}
    draws = jax_peer.BatchDraws(*map(jax_peer.as_jax, (index, view, noise)))
    learnt, losses = jax.jit(jax_peer.make_updates(algorithm))(learnt, jax_peer.Table(**arrays), draws)
    critic = torch.stack([logs["critic_loss"] for logs in ours]).view(-1, 2)
    actor = torch.stack([logs["actor_loss"] for logs in ours[1::2]])
    torch.testing.assert_close(torch.tensor(losses["critic_loss"].tolist()), critic, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(torch.tensor(losses["actor_loss"].tolist()), actor, rtol=1e-5, atol=1e-5)
    for theirs, mine in (
        (learnt.policy, policy.net),
        (learnt.target_policy, algorithm.target_policy.net),
        (learnt.target_critics[1], algorithm.target_critic.second),
    ):
        for (weight, bias), (w, b) in zip(theirs, jax_peer.net(mine), strict=True):
            assert float(abs(weight - w).max()) < 1e-5
            assert float(abs(bias - b).max()) < 1e-5
