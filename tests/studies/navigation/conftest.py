from pathlib import Path

import pytest

from vd4rl_pomdp.studies.navigation.collect import MazeCollectConfig, collect


@pytest.fixture(scope="session")
def maze_set(tmp_path_factory) -> Path:
    """Twelve short trajectories of three_curtains."""
    out = tmp_path_factory.mktemp("maze") / "three_curtains"
    shape = {"trajectories": 12, "trajectory_rows": 40, "trajectories_per_shard": 6, "workers": 1}
    collect(MazeCollectConfig.of("smoke", maze="three_curtains", out=out, **shape))
    return out
