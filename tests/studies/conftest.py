from pathlib import Path

import numpy as np
import pytest

from tests.helpers_data import fake_rows, write_rows


@pytest.fixture
def states(tmp_path) -> Path:
    """A dataset of ten episodes with random states, so that two are held out."""
    rows = fake_rows([9] * 10, physics_dim=18)
    rows["physics"] = np.random.default_rng(0).normal(size=(90, 18))
    return write_rows(tmp_path / "walker_walk" / "expert", rows)
