"""Objectives trained on exact sequences reach the exact conditional entropies.

The loss of any predictor is at least H(a_t | inputs), so tests are two-sided: a loss above the bound means that an
objective does not use all its inputs, a loss below it that it sees more than declared.
"""

from itertools import product

import numpy as np
import pytest
import torch

from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from vd4rl_pomdp.nn.action_target import make_action_target
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.heads import all_pairs
from vd4rl_pomdp.nn.objective import InverseObjective
from vd4rl_pomdp.studies.theory.classifiers import VIEWS
from vd4rl_pomdp.studies.theory.env import ExactWindows, exact_windows
from vd4rl_pomdp.studies.theory.law import joint_law
from vd4rl_pomdp.studies.theory.world import BLANK, World, biased, counterexample, noisy, tiny

MAX_K, M = 2, 1
ABOVE, BELOW = 0.02, 1e-4
"""Tolerances in nats; the second allows float32 rounding."""


WORLDS = {"shorter counter": lambda: counterexample(every=2), "ladder": lambda: biased(noisy(tiny("ladder")))}
ROWS = {"shorter counter": 5, "ladder": 4}


def build(world: World, method: str, max_k: int, m: int = M, hidden: int = 32) -> InverseObjective:
    torch.manual_seed(0)
    name, count = method.removesuffix(" literal"), len(world.actions)
    spec = METHODS[name]
    shape = EncoderConfig(
        action_dim=count,
        frame_encoder="flat",
        feature_dim=16,
        history=spec.history,
        use_actions=spec.use_actions,
        hidden_dim=hidden,
        history_window=0 if spec.past is None else m + 1,
        channels=len(world.symbols),
        size=1,
    )
    literal = method.endswith("literal")
    config = PretrainConfig.of("smoke", method=name, max_k=max_k, head_dim=max(48, hidden))
    options = config.with_known(literal_future=literal).options
    target = make_action_target("kmeans", np.eye(count, dtype=np.float32), count, 0)
    objective = spec.build(Encoder(shape), target, options, 0)
    assert isinstance(objective, InverseObjective)
    return objective


def train(objective: InverseObjective, data: ExactWindows, steps: int, exactly: bool = False) -> None:
    """Minimise the loss on sampled batches or, if `exactly`, the expected loss over all sequences."""
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(objective.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-2 if exactly else 8e-3, steps)
    for step in range(steps):
        drawn = None if exactly else data.draw(128, generator)
        loss = expected_loss(objective, data) if drawn is None else objective.loss(drawn, step / steps)[0]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def exact_loss(world: World, method: str, max_k: int, rows: int) -> float:
    """Mean of H(a_t | what is visible) over all pairs of a window."""
    view = VIEWS[method]
    m = rows if view.masked else M
    entropies = []
    for t, k in all_pairs(rows, max_k).tolist():
        visible = view.visible(t, k, m, rows, rows)
        entropies.append(joint_law(world, visible | {("a", t)}).given(visible, ("a", t)).entropy())
    return sum(entropies) / len(entropies)


def losses(objective: InverseObjective, data: ExactWindows, source: torch.Tensor | None = None) -> torch.Tensor:
    """(N, P) losses of every window; with `source`, past states come from these windows instead of their own."""
    past, future = objective.representations(data.windows)
    pairs = objective.pairs(data.state.shape[1])
    logits = objective.head(past if source is None else past[source], future, pairs)
    return objective.target.loss(logits, data.windows.action[:, pairs[:, 0]])


def expected_loss(objective: InverseObjective, data: ExactWindows) -> torch.Tensor:
    """The expected loss over all sequences of the world."""
    return (losses(objective, data).mean(1).double() * data.probability).sum()


CASES = [("shorter counter", name) for name in ("mik+a", "mik+a literal", "fj+a")] + [("ladder", "mik+a")]
"""`test_visible_sets` proves the inputs of all methods exactly."""


@pytest.mark.parametrize(("world_name", "method"), CASES)
def test_losses_reach_the_exact_conditional_entropy(world_name, method):
    world, rows = WORLDS[world_name](), ROWS[world_name]
    data = exact_windows(world, rows)
    objective = build(world, method, MAX_K)
    train(objective, data, 800 if "mik+a" in method else 400)
    exact = exact_loss(world, method, MAX_K, rows)
    with torch.no_grad():
        assert exact - BELOW < expected_loss(objective, data) < exact + ABOVE


@pytest.fixture(scope="module")
def papers_world():
    """The paper's counterexample, windows from one visible state to the next, and MIK+A trained on them.

    At k = 1 the target is the parity of both visible states and the three moves between them, and no subset is
    informative. Training on sampled batches stays at MIK's loss, so the exact gradient is used.
    """
    world = counterexample()
    data = exact_windows(world, 5)
    objective = build(world, "mik+a", 1, hidden=64)
    train(objective, data, 1000, exactly=True)
    return world, data, objective


def test_mik_a_reaches_the_exact_entropy_of_the_papers_world(papers_world):
    world, data, objective = papers_world
    exact = exact_loss(world, "mik+a", 1, 5)
    with torch.no_grad():
        assert exact - BELOW < expected_loss(objective, data) < exact + ABOVE
    assert exact + 5 * ABOVE < exact_loss(world, "mik", 1, 5), "the tolerance must separate MIK+A from MIK"


@torch.no_grad()
def losses_after_swaps(objective: InverseObjective, data: ExactWindows, world: World, t: int) -> dict:
    """Pair of states -> mean loss at (t, 1) after exchanging past states at t between windows in the two states.

    Uses windows whose first row shows the state.
    """
    blank = world.symbols.index(BLANK)
    shown = (data.windows.obs[:, 0].flatten(1).argmax(1) != blank).nonzero()[:, 0]
    here = {s: shown[data.state[shown, t] == i] for i, s in enumerate(world.states)}
    column = objective.pairs(data.state.shape[1]).tolist().index([t, 1])
    result = {}
    for (one, mine), (other, theirs) in product(here.items(), repeat=2):
        source = torch.arange(len(data.state))
        source[mine] = theirs[0]
        result[one, other] = float(losses(objective, data, source)[mine, column].mean())
    return result


def test_learned_encoders_merge_states_as_predicted(papers_world):
    """Exchanging past states between states affects predictions only where theory separates the states.

    With k = 1 <= m, FJ+A may merge all states. MIK+A must separate x from x+2 and may merge (x, -1) with (x, +1).
    Theory makes no statement on states of different parity, which never compete for one future.
    """
    world, data, mik_a = papers_world
    fj_a = build(world, "fj+a", 1, m=3)
    train(fj_a, data, 300)
    minds = losses_after_swaps(mik_a, data, world, 2)
    indifferent = losses_after_swaps(fj_a, data, world, 2)
    for one, other in product(world.states, repeat=2):
        if (one[0] - other[0]) % 2 == 0:
            assert indifferent[one, other] < 0.1
            assert (minds[one, other] > 1) is (one[0] != other[0])
