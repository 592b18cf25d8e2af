"""References for a policy: its data set's mean return, and the actor that collected the data, if it ships."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vd4rl_pomdp.core.reading import build, damaged
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.data.dataset import Dataset
from vd4rl_pomdp.policies.actor import shipped_file
from vd4rl_pomdp.runs import REFERENCE_FILE
from vd4rl_pomdp.runs.files import read_json, write_json

REACHED = 0.8
"""An episode with more than this share of the data's mean return counts as reaching the data's performance."""


@dataclass(frozen=True)
class Reference:
    """Facts about a run's data, and its policy's error on them; None if unknown."""

    data_return: float | None = None
    """Mean undiscounted return of the data's episodes."""
    actor: dict[str, str] | None = None
    """`task`, `quality` and `sha256` of the actor that collected all of the data, if exactly that file ships."""
    path_error: float | None = None
    """Mean squared difference between the trained policy's action and the actor's mean action on rows of the data."""
    mean_reward: float | None = None
    """Mean reward per decision in the data."""

    @classmethod
    def of(cls, dataset: Dataset) -> Self:
        """Reference of a data set; the path error is added after training."""
        rewards = float(dataset.returns.sum()) / dataset.num_transitions
        hashes = {one.get("actor_sha256") for one in dataset.store.meta["attributes"]}
        actor = None
        if len(hashes) == 1 and dataset.task is not None and dataset.task in TASKS:
            known = {"task": dataset.task, "quality": "", "sha256": str(hashes.pop())}
            candidates = (known | {"quality": quality} for quality in ("medium", "expert"))
            actor = next((one for one in candidates if shipped_file(**one)), None)
        played = dataset.returns[dataset.episode_end - dataset.episode_start > 1]  # a single row has no step
        return cls(round(float(played.mean()), 4), actor, mean_reward=round(rewards, 6))

    @classmethod
    def read(cls, run: Path) -> Self:
        """Read a run's reference; all None for runs from before it was stored. UserError for a damaged file."""
        path = run / REFERENCE_FILE
        return cls.parse(path, read_json(path)) if path.exists() else cls()

    @classmethod
    def parse(cls, path: Path, stored: dict[str, Any]) -> Self:
        with damaged(path, "is damaged", "remove it to compare the run with no data"):
            values = {"mean_reward": None} | stored  # missing in earlier runs
            reference = build(cls, {field.name: values[field.name] for field in fields(cls)})
            if reference.actor is not None and reference.actor.keys() != {"task", "quality", "sha256"}:
                raise ValueError(f"{reference.actor!r} names no actor")
            return reference

    def with_path_error(self, error: float | None) -> Reference:
        return replace(self, path_error=None if error is None else round(error, 6))

    def write(self, run: Path) -> None:
        write_json(run / REFERENCE_FILE, asdict(self))

    @property
    def actor_file(self) -> Path | None:
        """The shipped actor's file; None if the actor is unknown, or this version ships a different one."""
        return shipped_file(**self.actor) if self.actor else None

    def share_above_80(self, returns: Sequence[float]) -> float | None:
        """Share of episodes with a return above REACHED times the data's; None if the latter is not positive."""
        if self.data_return is None or self.data_return <= 0:
            return None
        return float(np.mean(np.array(returns) > REACHED * self.data_return))


def action_error(action: np.ndarray, actors: np.ndarray) -> np.floating:
    """Mean squared difference between (..., A) actions and the actor's, in their precision."""
    return np.square(action - actors).mean()


def summarise(rows: list[dict[str, Any]], reference: Reference) -> dict[str, float | None]:
    """Summary of one policy's episodes under one corruption: scores, returns, `share_above_80`; None if unknown."""
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
