"""The picture at the head of the README shows the rows' returns and the package's own corruptions."""

import importlib
from pathlib import Path

import numpy as np

from tests.helpers_data import write_fake_set
from vd4rl_pomdp.data import open_dataset

TOOLS = Path(__file__).parents[2] / "tools"


def test_bars_are_the_returns_of_the_committed_rows(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    returns = importlib.import_module("hero").returns()
    assert {name: tuple(map(round, numbers)) for name, numbers in returns.items()} == {
        "random": (134, 117, 151),
        "acro": (130, 90, 170),
        "mik": (310, 244, 376),
        "mik+a": (520, 321, 720),
        "supervised+a": (691, 607, 775),
    }


def test_stacks_are_shown_as_the_agent_sees_them(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(TOOLS)
    hero = importlib.import_module("hero")
    write_fake_set(tmp_path / "walker_walk" / "expert", [40])
    data = open_dataset(tmp_path / "walker_walk" / "expert", tmp_path / "cache")
    seen = {name: hero.stack_seen(data, 10, name) for name in hero.SEEN.values()}
    frames = {name: [one[:, 90 * i : 90 * i + 84] for i in range(3)] for name, one in seen.items()}
    assert sum(not frame.any() for frame in frames["zero_frames"]) == 2
    for clean, patched in zip(frames["none"], frames["patch"], strict=True):
        rows, columns = np.nonzero((clean != patched).any(-1))
        assert (np.ptp(rows), np.ptp(columns)) == (15, 15)
        assert not patched[rows, columns].any()
