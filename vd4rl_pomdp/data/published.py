"""What has been published about V-D4RL's sets."""

from __future__ import annotations

import csv
from importlib.resources import files


def published_scores() -> list[dict[str, str]]:
    """Scores (return / 10) of methods trained on each published set, fully observed, one row a set.

    Columns: `env`, `dataset`, then methods. Sources: V-D4RL (Lu et al. 2022, arXiv 2206.04779), and for `rebrac`
    Tarasov et al. 2023 (arXiv 2305.09836).
    """
    with files("vd4rl_pomdp.data").joinpath("published_scores.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))
