import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings

from pretrain.config import PretrainConfig
from pretrain.train import build_objective
from tests.studies.theory.random_worlds import worlds
from vd4rl_pomdp.nn.action_target import make_action_target
from vd4rl_pomdp.studies.theory.classifiers import VIEWS, MemoryLengths, compare
from vd4rl_pomdp.studies.theory.world import counterexample, future_memory, past_memory

MANY = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
LIMIT = 2


@MANY
@given(worlds())
def test_mik_a_equals_multi_step_inverse_if_states_are_decodable(world):
    m, n = past_memory(world, actions=True), future_memory(world, actions=True)
    assume(m is not None and n is not None and max(m, n) <= LIMIT)
    for k in (1, 2, 3):
        found = compare(world, VIEWS["mik+a"], MemoryLengths(m, n), k)
        assert found.multi_step
        assert found.entropy == pytest.approx(found.multi_step_entropy)


@MANY
@given(worlds())
def test_ah_equals_one_step_inverse_if_observations_decode(world):
    m = past_memory(world, actions=False)
    assume(m is not None and m <= LIMIT)
    assert all(compare(world, VIEWS["ah"], MemoryLengths(m, 0), k).one_step for k in (1, 2, 3))


@settings(max_examples=25, deadline=None)
@given(worlds())
def test_ah_a_has_zero_entropy(world):
    assert all(compare(world, VIEWS["ah+a"], MemoryLengths(1, 0), k).certain for k in (1, 2))


@settings(max_examples=25, deadline=None)
@given(worlds())
def test_more_visible_variables_never_increase_entropy(world):
    memory = MemoryLengths(1, 1)
    for k in (1, 2):
        h = {name: compare(world, VIEWS[name], memory, k).entropy for name in VIEWS if "literal" not in name}
        assert h["ah+a"] <= h["ah"] + 1e-12 <= h["fj"] + 2e-12
        assert h["fj+a"] <= h["fj"] + 1e-12 <= h["no_history"] + 2e-12
        assert h["mik+a"] <= h["mik"] + 1e-12 <= h["no_history"] + 2e-12


def test_mik_a_differs_from_multi_step_inverse_on_the_counterexample():
    """Where the future is not decodable, MIK+A's classifier is not the multi-step inverse."""
    row = compare(counterexample(), VIEWS["mik+a"], MemoryLengths(3, 3), 2)
    assert not row.decodes_end
    assert not row.multi_step
    assert row.entropy == pytest.approx(0.75 * 0.6931471805599453)
    assert row.multi_step_entropy == 0
    literal = compare(counterexample(), VIEWS["mik+a literal"], MemoryLengths(3, 3), 2)
    assert literal.multi_step
    assert literal.decodes_end


def test_fj_a_sees_actions_up_to_m():
    """FJ+A determines a_t up to k = m+1, because its later window begins at t+k-m."""
    rows = [compare(counterexample(), VIEWS["fj+a"], MemoryLengths(3, 3), k) for k in range(1, 7)]
    assert [row.certain for row in rows] == [True] * 4 + [False] * 2
    assert [row.sees_action for row in rows] == [True] * 3 + [False] * 3
    assert [row.multi_step for row in rows] == [True, True, False, False, False, True]
    literal = [compare(counterexample(), VIEWS["fj+a literal"], MemoryLengths(3, 3), k) for k in range(1, 6)]
    assert [row.sees_action for row in literal] == [True] * 4 + [False]
    assert [row.certain for row in literal] == [True] * 5


@pytest.mark.parametrize("name", [name for name in VIEWS if name != "fj+a literal"])
def test_views_match_declared_visible_sets(name):
    method, literal = name.removesuffix(" literal"), name.endswith(" literal")
    m, n, rows = 2, 1, 7
    actions = torch.rand(30, 2)
    config = PretrainConfig.of("smoke", method=method, max_k=4).with_known(n=n, literal_future=literal)
    config = config if method.startswith("ah") else config.with_known(m=m)
    objective = build_objective(config, actions.shape[1], make_action_target("kmeans", actions.numpy(), 3, 0))
    for t, k in objective.pairs(rows).tolist():
        observations, acted = objective.visible(t, k, rows)
        declared = {("o", j) for j in observations} | {("a", j) for j in acted}
        assert VIEWS[name].visible(t, k, m, n, rows) == declared, (t, k)
