"""Inputs of representations, and stored rows behind predictions: closed forms against changed inputs."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from finetune.histories import read_both_ends, read_whole
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from pretrain.train import build_objective, build_target
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.objective import InverseObjective
from vd4rl_pomdp.testing.methods import ROWS, build_inverse

MEMORIES: list[tuple[str, dict]] = [
    *((name, {}) for name in METHODS if not METHODS.named(name).reads_state),
    *(
        (name, {"history": "gru"})
        for name in ("no_history", "acro", "one_step_inverse", "acdf", "smwm", "curl", "driml", "homer")
    ),
    *((name, {"history": memory}) for name in ("acro", "fj+a", "mik+a") for memory in ("transformer", "lru")),
    *((name, {"m": m}) for name in ("ah+a", "fj", "fj+a", "mik", "mik+a", "supervised+a") for m in (0, 2)),
]
"""All methods that read pixels, memoryless ones also with a GRU, other memories, and bounded pasts."""
ALL = 99
"""m of an unbounded past."""


def states_of(encoder: Encoder, obs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(T, D) representations of a window of o_j and a_j, computed at once and row by row."""
    before = torch.cat([torch.zeros_like(actions[:1]), actions[:-1]])
    whole = encoder.from_features(encoder.frame(obs[None]), before[None])[0]
    state, rows = encoder.initial_state(1), []
    for j in range(len(obs)):
        z, state = encoder.step(obs[None, j], before[None, j], state)
        rows.append(z[0])
    return whole, torch.stack(rows)


@torch.no_grad()
def read_by(encoder: Encoder) -> list[tuple[set[int], set[int]]]:
    """For each row, the observations and actions that change its representation, at once and streamed."""
    shape, g = encoder.config, torch.Generator().manual_seed(0)
    obs = torch.rand(2, ROWS, shape.channels, shape.size, shape.size, generator=g, dtype=torch.float64) * 255
    actions = torch.rand(2, ROWS, shape.action_dim, generator=g, dtype=torch.float64) - 0.5
    plain = states_of(encoder, obs[0], actions[0])
    found: list = []
    for kind in (0, 1):
        touched = [set() for _ in range(ROWS)]
        for j in range(ROWS):
            inputs = [obs[0].clone(), actions[0].clone()]
            inputs[kind][j] = (obs, actions)[kind][1, j]
            both = [(new != old).any(-1) for new, old in zip(states_of(encoder, *inputs), plain, strict=True)]
            assert torch.equal(*both), "streaming depends on other rows"
            for t in torch.nonzero(both[0])[:, 0].tolist():
                touched[t].add(j)
        found.append(touched)
    return list(zip(*found, strict=True))


def past(t: int, method: str, settings: dict) -> tuple[set[int], set[int]]:
    """Inputs of s_t: o_t, or the last m+1 rows, with the actions between them if the method reads actions."""
    if method == "integrator":
        return {0}, set(range(t))
    remembers = method.removesuffix("+a") in ("ah", "fj", "mik", "supervised") or "history" in settings
    if not remembers:
        return {t}, set()
    m = settings.get("m", 8 if method.startswith("fj") else ALL)
    rows = {j for j in range(ROWS) if t - m <= j <= t}
    return rows, {j for j in rows if j < t and method.endswith("+a")}


@pytest.mark.parametrize(("method", "settings"), MEMORIES, ids=str)
def test_representations_depend_only_on_their_past(method: str, settings: dict):
    encoder = build_inverse(method, **settings).encoder.eval()
    assert read_by(encoder) == [past(t, method, settings) for t in range(ROWS)]


@pytest.mark.parametrize("method", ["mik+a", "fj", "supervised", "acro"])
def test_readouts_depend_on_frame_or_state(method: str):
    encoder = build_inverse(method).encoder.eval()
    widths = {"state": encoder.dim, "frame": encoder.config.feature_dim}
    for readout in ("state", "frame", "frame+state"):
        other = Encoder(replace(encoder.config, readout=readout)).double().eval()
        other.load_state_dict(encoder.state_dict())
        assert read_by(other) == [({t}, set()) if readout == "frame" else past(t, method, {}) for t in range(ROWS)]
        parts = readout.split("+") if encoder.memory else ["frame"]
        assert other.dim == sum(widths[part] for part in parts)


EPISODES, SPAN = (7, 6), 4
"""Rows of the dataset's episodes, and of windows."""
STORED = {
    "mik+a": lambda j, t, u, first: (first <= j <= t or u <= j, first <= j < t or u <= j),
    "ah+a": lambda j, t, u, first: (first <= j <= u, first <= j < u),
    "fj+a": lambda j, t, u, first: (
        first <= j and (t - 1 <= j <= t or u - 1 <= j <= u),
        first <= j and (j == t - 1 or j == u - 1),
    ),
    "acro": lambda j, t, u, first: (j in (t, u), False),
}
"""Whether a window that begins at row `first` shows o_j and a_j of the episode; m = 1 for FJ+A."""


@pytest.fixture
def dataset(tmp_path) -> Dataset:
    found = open_dataset(write_fake_set(tmp_path / "set", EPISODES, action_dim=2), tmp_path / "cache")
    g = torch.Generator().manual_seed(0)
    found.frames = torch.randint(0, 256, (*found.frames.shape[:2], 6, 6), dtype=torch.uint8, generator=g)
    return found


def changed_rows(dataset: Dataset, name: str, stored: torch.Tensor, logits: Callable[[], torch.Tensor]) -> list:
    """For each row of the dataset, the (B, P) predictions that differ after a change of its stored value."""
    plain, found = logits(), []
    for row in range(dataset.num_rows):
        other = stored.clone()
        other[row] = 255 - other[row] if other.dtype == torch.uint8 else other[row] + 0.3
        setattr(dataset, name, other)
        found.append((logits() != plain).any(-1))
    setattr(dataset, name, stored)
    return found


def on_frames(dataset: Dataset, method: str, stack: int) -> InverseObjective:
    """A small float64 objective on stacks of the dataset's frames."""
    torch.manual_seed(0)
    changes = {"max_k": SPAN - 1, "feature_dim": 6, "hidden_dim": 5, "head_dim": 32}
    changes |= {"m": 1} if method == "fj+a" else {}
    config = PretrainConfig.of("smoke", method=method, frame_encoder="flat").with_known(**changes)
    target = build_target(config, dataset.action.numpy())
    objective = build_objective(config, 2, target, observation=(3 * stack, dataset.frame_size)).double().eval()
    assert isinstance(objective, InverseObjective)
    return objective


@pytest.mark.parametrize("stack", [1, 3])
@pytest.mark.parametrize("method", STORED)
@torch.no_grad()
def test_predictions_depend_only_on_their_episodes_rows(dataset: Dataset, method: str, stack: int):
    """Frames of visible stacks, which may begin before the window, and a_j, which row j+1 stores."""
    objective = on_frames(dataset, method, stack)
    starts = [(e, first) for e, rows in enumerate(EPISODES) for first in range(rows - SPAN + 1)]

    def logits() -> torch.Tensor:
        return objective.action_logits(View(dataset, frame_stack=stack).windows(list(range(len(starts))), SPAN))

    by_frame = changed_rows(dataset, "frames", dataset.frames, logits)
    by_action = changed_rows(dataset, "action", dataset.action, logits)
    for b, (episode, first) in enumerate(starts):
        begin, rows = sum(EPISODES[:episode]), EPISODES[episode]
        for p, (t, k) in enumerate(objective.pairs(SPAN).tolist()):
            seen = [STORED[method](j, first + t, first + t + k, first) for j in range(first + SPAN)]
            frames = {begin + max(0, j - back) for j, (row, _) in enumerate(seen) if row for back in range(stack)}
            actions = {begin + j + 1 for j, (_, action) in enumerate(seen) if action and j + 1 < rows}
            assert {row for row, touched in enumerate(by_frame) if touched[b, p]} == frames
            assert {row for row, touched in enumerate(by_action) if touched[b, p]} == actions


GIVEN = {
    ("whole", "state", 0): (range(7, 11), range(8, 11)),
    ("whole", "state", 2): (range(9, 11), range(10, 11)),
    ("whole", "frame", 0): (range(10, 11), range(0)),
    ("whole", "frame+state", 2): (range(9, 11), range(10, 11)),
    ("first end", "state", 0): (range(8, 11), range(9, 11)),
    ("first end", "frame", 0): (range(10, 11), range(0)),
    ("last end", "state", 0): (range(8, 13), range(9, 13)),
    ("last end", "state", 2): (range(11, 13), range(12, 13)),
    ("last end", "frame+state", 0): (range(8, 13), range(9, 13)),
}
"""Rows whose frames and stored actions are inputs of a mik+a policy at row 10, or at 12 for the last end.

The second episode is rows 7 to 12. Its whole history begins at row 7, the random one of both ends at row 8. The first
row of a history contributes only its frame.
"""


@pytest.mark.parametrize(("end", "readout", "window"), GIVEN, ids=str)
@torch.no_grad()
def test_policy_input_depends_only_on_its_history(dataset: Dataset, end: str, readout: str, window: int):
    trained = build_inverse("mik+a").encoder
    encoder = Encoder(replace(trained.config, readout=readout, history_window=window)).double().eval()
    encoder.load_state_dict(trained.state_dict())
    g = torch.Generator().manual_seed(0)
    features = torch.rand(2, dataset.num_rows, trained.config.feature_dim, generator=g, dtype=torch.float64)

    def given(frames: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        dataset.action = actions
        if end == "whole":
            return read_whole(encoder, frames[7:], dataset, range(1, 2))[10 - 7]
        rows = [torch.tensor([row]) for row in (8, 10, 12)]
        return read_both_ends(encoder, lambda rows: frames[rows], dataset, *rows)[end == "last end"][0]

    def touched(exchanged: Callable[[torch.Tensor], torch.Tensor]) -> set[int]:
        return {row for row in range(len(stored)) if (exchanged(torch.tensor([row])) != plain).any()}

    (frames, others), stored = features, dataset.action
    plain = given(frames, stored)
    by_frame = touched(lambda row: given(frames.index_copy(0, row, others[row]), stored))
    by_action = touched(lambda row: given(frames, stored.index_fill(0, row, 0.5)))
    assert (by_frame, by_action) == tuple(map(set, GIVEN[end, readout, window]))
