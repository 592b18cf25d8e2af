"""A pretrained encoder is a folder: config.json and model.safetensors, loadable without the code that trained it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import save

from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.errors import UserError, disk_errors
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.frame import STATE
from vd4rl_pomdp.runs.files import write_bytes, write_json
from vd4rl_pomdp.runs.reading import build, parse_json, read_bytes, read_tensors

WEIGHTS, CONFIG = "model.safetensors", "config.json"


@dataclass(frozen=True)
class EncoderCard:
    """Where an encoder comes from."""

    method: str
    task: str
    quality: str
    corruption: dict[str, Any]
    """The corruption it was pretrained under, as the settings of CorruptionConfig."""
    seed: int
    steps: int
    preset: str
    end_to_end: str = ""
    """Fine-tuning algorithm that trains the encoder, too; empty for a frozen encoder."""
    action_loss: float | None = None
    """For methods that predict actions: the mean of the last tenth of the pretraining's rows of metrics.

    Each row is the mean over the steps since the row before; all count the same, also where they are of fewer steps.
    """
    data: str = ""
    """Fingerprint of the set it was pretrained on."""
    settings: dict[str, Any] = field(default_factory=dict)
    """The pretraining's settings without seed, folders, device and logging; empty if they were not recorded."""


def save_encoder(folder: Path, encoder: Encoder, card: EncoderCard) -> None:
    """Write an encoder folder; whole files only, config last."""
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.contiguous().cpu() for name, value in encoder.state_dict().items()}
    write_bytes(folder / WEIGHTS, save(weights))
    write_json(folder / CONFIG, {"encoder": asdict(encoder.config), "pretrain": asdict(card)})


def copy_encoder(source: Path, target: Path, changes: Mapping[str, Any]) -> None:
    """Copy an encoder folder, its config.json last: without it a copy is no encoder folder.

    Args:
        source: an encoder folder.
        target: folder to write.
        changes: fields of the copy's `EncoderConfig` by name.
    """
    with disk_errors(target):
        target.mkdir(parents=True, exist_ok=True)
    write_bytes(target / WEIGHTS, read_bytes(source / WEIGHTS))
    config = parse_json(read_bytes(source / CONFIG))
    write_json(target / CONFIG, config | {"encoder": config["encoder"] | changes})


def encoder_hash(folder: Path) -> str:
    """Name of an encoder folder's content: equal for equal files, wherever they lie."""
    digest = hashlib.blake2b(digest_size=12)
    for name in (WEIGHTS, CONFIG):
        digest.update(hashlib.blake2b(read_bytes(folder / name)).digest())
    return digest.hexdigest()


def load_encoder(
    folder: Path | str, task: str | None = None, action_dim: int | None = None, size: int | None = None
) -> tuple[Encoder, EncoderCard]:
    """Read an encoder folder into a frozen module in eval mode.

    Args:
        folder: written by `save_encoder`.
        task: the task it will be used on, if that is to be checked.
        action_dim: the action dimension it will be used with, if that is to be checked.
        size: height and width of the pictures it will see, if that is to be checked.

    Raises:
        UserError: the folder is missing, damaged, pickled, or of another task or image size.
    """
    folder = Path(folder)
    encoder_config, card = _read_config(folder)
    if action_dim is not None and encoder_config.action_dim != action_dim:
        raise UserError(
            f"{folder}: this encoder was pretrained on {card.task} with {encoder_config.action_dim} action dimensions, "
            f"the data set has {action_dim}; pretrain one on this task"
        )
    trained = encoder_config.size
    if size is not None and encoder_config.frame_encoder != STATE and trained != size:
        raise UserError(
            f"{folder}: this encoder reads pictures of {trained}x{trained} pixels, the data set has {size}x{size}; "
            "pretrain one on this set"
        )
    if task is not None and card.task != task:
        raise UserError(
            f"{folder}: this encoder was pretrained on {card.task}, not on {task}; pretrain one on this task"
        )
    try:
        encoder = Encoder(encoder_config)
        _check_corruption(card)
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise UserError(f"{folder}/config.json: names no encoder ({_first_line(error)}); pretrain it again") from error
    try:
        encoder.load_state_dict(read_tensors(folder / WEIGHTS))
    except (FileNotFoundError, SafetensorError, RuntimeError) as error:
        reason = _first_line(error)
        raise UserError(f"{folder}/model.safetensors: cannot be read ({reason}); pretrain the encoder again") from error
    return encoder.eval().requires_grad_(False), card


def _check_corruption(card: EncoderCard) -> None:
    """Raise KeyError, TypeError or ValueError unless a card names a corruption."""
    config = CorruptionConfig.fill({"corruption": card.corruption["corruption"], **card.corruption})
    build(CorruptionConfig, {"corruption": config.corruption, "corruption_mode": config.corruption_mode})
    for stage in config.stages:
        build(type(stage), asdict(stage))
    config.check()


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]


def _read_config(folder: Path) -> tuple[EncoderConfig, EncoderCard]:
    pickles = [p.name for p in folder.glob("*") if p.suffix in (".pt", ".pth", ".pkl", ".bin", ".ckpt")]
    if pickles and not (folder / "model.safetensors").exists():
        raise UserError(f"{folder}: {pickles[0]} is a pickle, which can run code; only model.safetensors is read")
    try:
        config = parse_json(read_bytes(folder / CONFIG))
        return build(EncoderConfig, config["encoder"]), build(EncoderCard, config["pretrain"])
    except UserError:
        raise
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{folder}: not an encoder folder (config.json: {error}); `vd4rl-pomdp pretrain` writes one as RUN/encoder"
        ) from error
