"""State-based SAC actors as small safetensors files with numpy inference; no deep learning library needed.

An actor maps dm_control's flattened observations to a tanh-squashed Gaussian over actions (Haarnoja et al. 2018,
arXiv 1801.01290), by a ReLU MLP, optionally after standardising the observations. Weights are float32; actions are
computed in float64 and rounded to float32 once, so that they do not depend on the processor.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import parse_json, read_bytes, safetensors_metadata
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.runs.files import write_bytes

LOG_STD_RANGE = (-20.0, 2.0)
OBSERVATION_CLIP = 10.0
"""Standardised observations are clipped to +-10."""
ASSETS = Path(__file__).parent / "assets"
_REMEDY = "use another copy"


@dataclass(frozen=True)
class _Weights:
    """The content of a file of actors."""

    weights: dict[str, np.ndarray]
    card: dict[str, Any]
    sha256: str = ""
    """Hash of the file that it was read from."""

    def save(self, path: Path) -> None:
        arrays = {k: np.ascontiguousarray(v) for k, v in self.weights.items()}
        write_bytes(path, save(arrays, {"card": json.dumps(self.card)}))


class Actor(_Weights):
    """A stochastic policy on simulator states.

    Its weights are float32 matrices (in, out), each with a `.bias`: `hidden.{i}.weight`, `mean.weight` and
    `log_std.weight`; optionally `observation.mean` and `observation.std` (D,). Its card says how it was trained: task,
    quality, training step, mean return of 20 episodes, config, versions.
    """

    def act(self, state: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Action (A,) float32 in [-1, 1] for dm_control's flattened observations (D,); without `rng` its mean."""
        state = state.astype(np.float64)
        if "observation.mean" in self.weights:
            scaled = (state - self._double["observation.mean"]) / self._double["observation.std"]
            state = np.clip(scaled, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        hidden = state
        for layer in itertools.takewhile(lambda i: f"hidden.{i}.weight" in self.weights, itertools.count()):
            hidden = np.maximum(self._linear(f"hidden.{layer}", hidden), 0.0)
        action = self._linear("mean", hidden)
        if rng is not None:
            log_std = np.clip(self._linear("log_std", hidden), *LOG_STD_RANGE)
            action = action + np.exp(log_std) * rng.standard_normal(action.shape, dtype=np.float32)
        return np.tanh(action).astype(np.float32)

    @cached_property
    def _double(self) -> dict[str, np.ndarray]:
        return {name: value.astype(np.float64) for name, value in self.weights.items()}

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self._double[f"{name}.weight"] + self._double[f"{name}.bias"]


class Ladder(_Weights):
    """Checkpoints of an actor along one training run; playing them in turn imitates the run's replay buffer.

    Its weights are those of an `Actor`, but float16 and stacked along a new first axis, one entry per checkpoint
    ("rung"). Its card has the task, `decisions` at each rung, and the return at each, `curve`.
    """

    @classmethod
    def of(cls, actors: list[Actor], card: dict[str, Any]) -> Ladder:
        """Stack actors of the same architecture; their weights are rounded to float16."""
        names = actors[0].weights
        return cls({name: np.stack([a.weights[name] for a in actors]).astype(np.float16) for name in names}, card)

    @cached_property
    def rungs(self) -> list[Actor]:
        """The actors, in order of training."""
        count = len(self.card["decisions"])
        stacked = {name: value.astype(np.float32) for name, value in self.weights.items()}
        return [Actor({name: value[i] for name, value in stacked.items()}, self.card) for i in range(count)]

    def actor_at(self, progress: float) -> Actor | None:
        """The rung nearest, in decisions, to a fraction `progress` of the training run, 1 being the last rung.

        None if step 0 is nearer, which stands for uniformly random actions.
        """
        steps = np.array([0, *self.card["decisions"]])
        nearest = int(np.abs(steps - progress * steps[-1]).argmin())
        return self.rungs[nearest - 1] if nearest else None


def read_actor(path: Path, task: str | None = None) -> Actor:
    """Read an actor file; UserError if it is missing, damaged, or made for another task than `task`."""
    actor = Actor(*_read(path, task))
    _check_weights(path, actor, task)
    return actor


def read_ladder(path: Path, task: str | None = None) -> Ladder:
    """Read a ladder file; errors as `read_actor`, for any of its actors."""
    ladder = Ladder(*_read(path, task))
    steps = ladder.card.get("decisions")
    if not isinstance(steps, list) or any(len(value) != len(steps) for value in ladder.weights.values()):
        raise UserError(f"{path}: contains no actor snapshots; {_REMEDY}")
    for rung in ladder.rungs:
        _check_weights(path, rung, task)
    return ladder


def _read(path: Path, task: str | None) -> tuple[dict[str, np.ndarray], dict[str, Any], str]:
    try:
        content = read_bytes(path)
        weights, card = load(content), dict(parse_json(safetensors_metadata(content).get("card", "none")))
    except UserError:
        raise
    except (FileNotFoundError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path}: not an actor file ({error}); {_REMEDY}") from error
    if task is not None and card.get("task") != task:
        raise UserError(f"{path}: this actor was trained on {card.get('task')}, not on {task}")
    return weights, card, hashlib.sha256(content).hexdigest()


def _check_weights(path: Path, actor: Actor, task: str | None) -> None:
    """Raise UserError unless the weights are finite and fit the task's states and actions; mazes are not checked."""
    name = task or actor.card.get("task", "")
    if name not in TASKS:
        return
    widths = layout_of(TASKS[name])
    try:
        finite = all(np.isfinite(value).all() for value in actor.weights.values())
        shape = actor.act(np.zeros(widths.state_dim, np.float32), np.random.default_rng(0)).shape if finite else None
        if shape != (widths.action_dim,):
            raise ValueError(f"an action of shape {shape}" if finite else "they are not finite")
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: its weights do not fit an actor of {name} ({error}); {_REMEDY}") from error


def load_actor(task: str, quality: str) -> Actor:
    """Load the shipped actor of a task and a quality (`medium` or `expert`)."""
    return read_actor(_shipped(task, quality), task)


def load_ladder(task: str) -> Ladder:
    """Load the shipped ladder of actors that collects a task's medium_replay data set."""
    return read_ladder(_shipped(task, "replay"), task)


def shipped_file(task: str, quality: str, sha256: str) -> Path | None:
    """Path of the shipped actor of a task and quality; None if none ships or its SHA-256 is not `sha256`."""
    path = _asset(task, quality)
    same = path.exists() and hashlib.sha256(read_bytes(path)).hexdigest() == sha256
    return path if same else None


def ships(task: str, quality: str) -> bool:
    """Whether all actors needed to collect a data set ship: random needs none, medium_expert needs two."""
    needed = {"random": (), "medium_replay": ("replay",), "medium_expert": ("medium", "expert")}
    quality = quality.removesuffix("_noisy")
    return all(_asset(task, name).exists() for name in needed.get(quality, (quality,)))


def _asset(task: str, name: str) -> Path:
    TASKS.named(task)
    return ASSETS / f"{task}_{name}.safetensors"


def _shipped(task: str, quality: str) -> Path:
    path = _asset(task, quality)
    if not path.exists():
        have = ", ".join(sorted(p.stem for p in ASSETS.glob("*.safetensors"))) or "none"
        raise UserError(
            f"no {quality} actor ships for {task} (shipped: {have}); "
            f"train one with the repository's `tools/train_actor.py {task}`"
        )
    return path
