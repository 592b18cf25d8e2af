"""State-based SAC actors as small files: safetensors weights, numpy inference, no learning library needed.

An actor maps dm_control's flattened observations to a squashed Gaussian over actions (Haarnoja et al. 2018,
arXiv 1801.01290): two hidden layers of rectified units, then a mean and a log standard deviation, tanh at the end.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.tasks import Task, get_task

LOG_STD_RANGE = (-20.0, 2.0)
ASSETS = Path(__file__).parent / "assets"
SHIPPED = ("medium", "expert")


@dataclass(frozen=True)
class Actor:
    """A stochastic policy on simulator states."""

    weights: dict[str, np.ndarray]
    """float32 matrices `hidden.{i}.weight` (in, out), `mean.weight`, `log_std.weight`, and their `.bias`."""
    card: dict[str, Any]
    """Where the actor comes from: task, quality, training step, mean return of 20 episodes, config, versions."""
    sha256: str = ""
    """Hash of the file the actor was read from."""

    def act(self, state: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Action for one state.

        Args:
            state: (D,) float32, dm_control's observations flattened in order.
            rng: source of the Gaussian sample; None gives the mean action.

        Returns:
            (A,) float32 in [-1, 1].
        """
        hidden = state.astype(np.float32)
        layer = 0
        while f"hidden.{layer}.weight" in self.weights:
            hidden = np.maximum(self._linear(f"hidden.{layer}", hidden), 0.0)
            layer += 1
        action = self._linear("mean", hidden)
        if rng is not None:
            log_std = np.clip(self._linear("log_std", hidden), *LOG_STD_RANGE)
            action = action + np.exp(log_std) * rng.standard_normal(action.shape, dtype=np.float32)
        return np.tanh(action)

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"]

    def save(self, path: Path) -> None:
        """Write the actor to one safetensors file, its card as JSON in the header."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.tmp")
        save_file(
            {k: np.ascontiguousarray(v) for k, v in self.weights.items()}, temporary, {"card": json.dumps(self.card)}
        )
        temporary.replace(path)


def read_actor(path: Path, task: Task | None = None) -> Actor:
    """Read an actor file; raises UserError if it is missing, damaged, or made for another task than `task`."""
    try:
        with safe_open(path, framework="np") as file:
            card = json.loads((file.metadata() or {})["card"])
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise UserError(f"{path}: not an actor file ({error}); make one with `vd4rl-pomdp policy train`") from error
    if task is not None and card.get("task") != task.name:
        raise UserError(f"{path}: this actor was trained on {card.get('task')}, not on {task.name}")
    return Actor(weights, card, hashlib.sha256(path.read_bytes()).hexdigest())


def load_actor(task: str, quality: str) -> Actor:
    """Load the actor that ships for a task and a quality (`medium` or `expert`)."""
    path = ASSETS / f"{get_task(task).name}_{quality}.safetensors"
    if not path.exists():
        have = ", ".join(sorted(p.stem for p in ASSETS.glob("*.safetensors"))) or "none"
        raise UserError(
            f"no {quality} actor ships for {task} (shipped: {have}); "
            f"train one with `vd4rl-pomdp policy train --task {task}` and pass it as --actor"
        )
    return read_actor(path, get_task(task))
