"""Agents: an encoder and a policy in one folder, in half precision, with a card that reports their returns.

    FOLDER/  encoder/  policy/  card.json

The card holds the data set's task, quality and fingerprint, the corruption, method, algorithm, seed, budget, run id and
commit, the episodes played with the rounded weights and on which renderer and processor (only the same ones reproduce
all digits), and the SHA-256 of the other files. Shipped agents are named by their path below this package's folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import save

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.reading import damaged, fits, read_bytes, read_tensors, safetensors_metadata
from vd4rl_pomdp.core.tasks import FRAME_SIZE, Task
from vd4rl_pomdp.envs.corrupted import Observation
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.envs.pixels import checked_action
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.encoder_folder import load_encoder
from vd4rl_pomdp.nn.frame import StateFrame
from vd4rl_pomdp.nn.policy import Policy, load_policy
from vd4rl_pomdp.runs.files import read_json, sha256, write_bytes

CARD = "card.json"
FILES = tuple(f"{part}/{name}" for part in ("encoder", "policy") for name in ("config.json", "model.safetensors"))
"""An agent's files other than its card."""
SHIPPED = Path(__file__).parent
_KINDS = {
    **dict.fromkeys(("method", "task", "quality", "algorithm", "data"), str),
    **{"corruption": dict, "seed": int, "budget": dict, "length": int},
}
"""Types of entries that every card has."""


class Agent:
    """Encoder and policy that act one row at a time; the agent remembers the history, its own actions included."""

    def __init__(self, encoder: Encoder, policy: Policy, card: dict[str, Any] | None = None) -> None:
        self.encoder, self.policy, self.card = encoder, policy, card or {}
        self.reset()

    def reset(self) -> None:
        self._state = self.encoder.initial_state(1)
        self._action = torch.zeros(1, self.encoder.config.action_dim)  # as at first rows in training

    @property
    def picture_size(self) -> int:
        """Image size to render at: the encoder's, or the benchmark's frame size (for videos) if it reads states."""
        return FRAME_SIZE if self.encoder.reads_state else self.encoder.config.size

    def encoder_input(self, now: Observation, task: Task) -> torch.Tensor:
        """The encoder's input: the corrupted stack, or the simulator state for the `state` reference."""
        if not isinstance(self.encoder.frame, StateFrame):
            return now.obs
        state = torch.from_numpy(layout_of(task).visible_state(now.time_step.physics))
        return self.encoder.frame.observe(state[None], now.key)[0]

    @torch.no_grad()
    def act(self, obs: torch.Tensor | np.ndarray) -> np.ndarray:
        """Mean action (A,) float32 for a (C, S, S) uint8 observation; UserError for another shape or scaled pixels."""
        obs = torch.as_tensor(obs)
        if not self.encoder.reads_state and obs.dtype != torch.uint8:
            raise UserError(f"agents read uint8 pixels from 0 to 255, not {obs.dtype}: do not scale them")
        # step() gives the same states that training computed with encode() on whole windows
        z, self._state = self.encoder.step(obs[None], self._action, self._state)
        self._action = self.policy(z)
        return self._action[0].numpy().copy()  # a caller's `action += noise` must not change the history

    def set_last_action(self, action: np.ndarray) -> None:
        """Replace the last action in the history, if the executed (A,) action was not the one `act` returned.

        UserError unless it is A finite numbers.
        """
        executed = checked_action(action, self.encoder.config.action_dim)
        self._action = torch.tensor(executed, dtype=torch.float32)[None]  # a copy: the caller may reuse the array


def load_agent(name: Path | str) -> Agent:
    """Load a shipped agent by name, or any agent by folder; UserError if there is none or its files are damaged."""
    folder, card = find_agent(name)
    return Agent(load_encoder(folder / "encoder", card["task"])[0], load_policy(folder / "policy"), card)


def find_agent(name: Path | str) -> tuple[Path, dict[str, Any]]:
    """Folder and card of an agent, after checking its files' SHA-256; errors as `load_agent`."""
    folder = next((place for place in (SHIPPED / name, Path(name)) if (place / CARD).exists()), None)
    if folder is None:
        raise UserError(
            f"unknown agent {str(name)!r}: name a folder written by `agents export` or `hub pull`, or a shipped "
            f"agent ({', '.join(shipped()) or 'none'})"
        )
    card = read_json(folder / CARD)
    for name, kind in _KINDS.items():
        if not fits(card.get(name), kind):
            raise UserError(f"{folder / CARD}: its {name} is {card.get(name)!r}; use another copy")
    # if the policy was trained on other data than the encoder, the budget names the encoder's
    own = {name: card[name] for name in ("task", "method", "corruption", "data", "quality")}
    with damaged(folder / CARD, "its budget has no pretraining", "use another copy"):
        own |= {"seed": None} | card["budget"]["pretraining"]
    about = read_json(folder / FILES[0]).get("pretrain", {}) if card.get("sha256") == checksums(folder) else {}
    if not (about and isinstance(about, dict)) or any(
        about[name] not in ("", value) for name, value in own.items() if name in about
    ):
        raise UserError(f"{folder}: its files do not match {CARD}; use another copy")
    return folder, card


def shipped() -> list[str]:
    """Names of the shipped agents."""
    return sorted(card.parent.relative_to(SHIPPED).as_posix() for card in SHIPPED.rglob(CARD))


def checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of an agent's FILES, by name; raises UserError if one is missing."""
    with disk_errors(folder):
        return {name: sha256(folder / name) for name in FILES}


def write_rounded(run: Path, folder: Path) -> None:
    """Write a run's encoder and policy with weights rounded to float16; they are loaded and computed as float32.

    UserError for a missing or damaged file, or a weight that overflows float16.
    """
    for name in FILES:
        try:
            content = read_bytes(run / name)
            if name.endswith(".safetensors"):
                weights = read_tensors(run / name)
                rounded = {key: value.half() if value.is_floating_point() else value for key, value in weights.items()}
                if large := [key for key, value in rounded.items() if not value.isfinite().all()]:
                    raise UserError(f"{run / name}: {large[0]} is too large for half precision")
                content = save(rounded, safetensors_metadata(content) or None)
        except (FileNotFoundError, SafetensorError) as error:
            raise UserError(f"{run / name}: cannot be read; name the folder of a finished fine-tuning") from error
        write_bytes(folder / name, content)
