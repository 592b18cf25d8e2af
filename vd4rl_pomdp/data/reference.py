"""What a policy is held against: the return of the data it learned from, and the actor that made them if it ships."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import build
from vd4rl_pomdp.data.dataset import Dataset
from vd4rl_pomdp.policies.actor import shipped_file
from vd4rl_pomdp.runs import REFERENCE_FILE
from vd4rl_pomdp.runs.files import read_json, write_json

REACHED = 0.8
"""An episode above this share of the data's mean return counts as one that does what the data do."""


@dataclass(frozen=True)
class Reference:
    """What is known of the data behind a run, and of the run's policy on them; None is unknown."""

    data_return: float | None = None
    """Mean undiscounted return of the data's episodes."""
    actor: dict[str, str] | None = None
    """`task`, `quality` and `sha256` of the one actor that made all of the data, if its very file ships."""
    path_error: float | None = None
    """The trained policy's mean squared difference from the actor's mean action on rows of the data, as it saw them."""
    mean_reward: float | None = None
    """Of the data's decisions."""

    @classmethod
    def of(cls, dataset: Dataset) -> Self:
        """What a set tells; the path error is for later."""
        rewards = float(dataset.returns.sum()) / dataset.num_transitions
        return cls(round(float(dataset.returns.mean()), 4), _sole_actor(dataset), mean_reward=round(rewards, 6))

    @classmethod
    def read(cls, run: Path) -> Self:
        """What a run keeps, nothing known if it began before runs kept any; raises UserError for a damaged file."""
        path = run / REFERENCE_FILE
        return cls.parse(path, read_json(path)) if path.exists() else cls()

    @classmethod
    def parse(cls, path: Path, stored: dict[str, Any]) -> Self:
        """What a file's content tells; raises UserError, naming the file, if it is damaged."""
        try:
            told = {"mean_reward": None} | stored  # which earlier runs do not tell
            made = build(cls, {field.name: told[field.name] for field in fields(cls)})
            if made.actor is not None and made.actor.keys() != {"task", "quality", "sha256"}:
                raise ValueError(f"{made.actor!r} names no actor")
            return made
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path}: is damaged ({error}); remove it, and the run is compared with no data") from error

    def with_path_error(self, error: float | None) -> Reference:
        """The same with the path error of a trained policy."""
        return replace(self, path_error=None if error is None else round(error, 6))

    def write(self, run: Path) -> None:
        """Keep it in a run's folder."""
        write_json(run / REFERENCE_FILE, asdict(self))

    @property
    def actor_file(self) -> Path | None:
        """The actor's file; None if it is unknown, or this version ships another."""
        return shipped_file(**self.actor) if self.actor else None

    def share_above_80(self, returns: Sequence[float]) -> float | None:
        """Share of episodes whose return is above REACHED of the data's; unknown where that is not positive."""
        if self.data_return is None or self.data_return <= 0:
            return None
        return float(np.mean(np.array(returns) > REACHED * self.data_return))


def action_error(action: np.ndarray, shown: np.ndarray) -> np.floating:
    """Mean squared difference of (..., A) actions from those that the actor shows, in their precision."""
    return np.square(action - shown).mean()


def _sole_actor(dataset: Dataset) -> dict[str, str] | None:
    """The actor of all shards, if it is one and ships."""
    hashes = {one.get("actor_sha256") for one in dataset.store.meta["attributes"]}
    if len(hashes) != 1 or dataset.task is None:
        return None
    sha256 = str(hashes.pop())
    for quality in ("medium", "expert"):
        if shipped_file(dataset.task, quality, sha256):
            return {"task": dataset.task, "quality": quality, "sha256": sha256}
    return None


def summarise(rows: list[dict[str, Any]], reference: Reference) -> dict[str, float | None]:
    """What the episodes of one policy under one corruption come to; None is unknown.

    Returns:
        `score_mean`, `score_min`, `score_max`, `return_mean`, `share_above_80` (see `Reference`), `action_error`.
    """
    scores, returns = ([row[name] for row in rows] for name in ("score", "return"))
    errors = [row["action_error"] for row in rows if row["action_error"] is not None]
    return {
        "score_mean": float(np.mean(scores)),
        "score_min": min(scores),
        "score_max": max(scores),
        "return_mean": float(np.mean(returns)),
        "share_above_80": reference.share_above_80(returns),
        "action_error": float(np.mean(errors)) if errors else None,
    }
