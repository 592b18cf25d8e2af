"""A pretrained encoder is a folder: config.json and model.safetensors, loadable without the code that trained it.

README.md beside them says what config.json says, for readers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import save
from torch.random import fork_rng

from vd4rl_pomdp import __version__
from vd4rl_pomdp.core.errors import UserError, disk_errors, first_line, in_one_line
from vd4rl_pomdp.core.options import flat, option_names
from vd4rl_pomdp.core.reading import build, parse_json, read_bytes, read_tensors
from vd4rl_pomdp.core.registry import origins, sources
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.encoder_card import EncoderCard, EncoderOrigin, EncoderRecord
from vd4rl_pomdp.nn.frame import STATE
from vd4rl_pomdp.nn.model_card import CARD, model_card
from vd4rl_pomdp.runs.files import json_text, write_bytes, write_json
from vd4rl_pomdp.runs.provenance import git_commit

WEIGHTS, CONFIG = "model.safetensors", "config.json"
FILES_OF_RUN = (f"encoder/{CONFIG}", f"encoder/{WEIGHTS}")
"""An encoder's files, below the folder of the run that made it."""


def save_encoder(folder: Path | str, encoder: Encoder, card: EncoderCard, frames: int | None = None) -> None:
    """Write an encoder folder; whole files only, config last.

    Args:
        folder: where.
        encoder: its weights and config.
        card: where it comes from.
        frames: how many frames the batches of its pretraining held, if that is known.
    """
    weights = {name: value.cpu().contiguous().clone() for name, value in encoder.state_dict().items()}
    record = EncoderRecord(encoder.config, card)
    parts = record.parts
    origin = EncoderOrigin(__version__, git_commit(), frames, plugins=origins(parts), sources=sources(parts))
    _write(Path(folder), save(weights), replace(record, origin=origin))


def _write(folder: Path, weights: bytes, record: EncoderRecord) -> None:
    """Write all files, config.json last: without it the folder is no encoder folder."""
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / WEIGHTS, weights)
    _write_record(folder, record)


def _write_record(folder: Path, record: EncoderRecord) -> None:
    write_bytes(folder / CARD, model_card(record).encode())
    write_json(folder / CONFIG, asdict(record))


def copy_encoder(source: Path, target: Path, changes: Mapping[str, Any]) -> None:
    """Copy an encoder folder.

    Args:
        source: an encoder folder.
        target: folder to write.
        changes: fields of the copy's `EncoderConfig` by name.
    """
    record = read_record(source)
    _write(target, read_bytes(source / WEIGHTS), replace(record, encoder=replace(record.encoder, **changes)))


def tell_probe(folder: Path, errors: Mapping[str, float]) -> None:
    """Add the errors of linear probes, as `EncoderOrigin.probe` has them, to what an encoder folder says of itself."""
    record = read_record(folder)
    _write_record(folder, replace(record, origin=replace(record.origin, probe=dict(errors))))


def encoder_hash(folder: Path) -> str:
    """Name of an encoder: equal for equal weights and configs, wherever they lie and whenever they were written."""
    digest = hashlib.blake2b(digest_size=12)
    for content in (read_bytes(folder / WEIGHTS), _without_origin(read_bytes(folder / CONFIG))):
        digest.update(hashlib.blake2b(content).digest())
    return digest.hexdigest()


def _without_origin(config: bytes) -> bytes:
    """A config.json as it is without its origin; one of an earlier version, or a damaged one, as it is."""
    try:
        told = parse_json(config)
    except ValueError:
        return config
    if not isinstance(told, dict) or "origin" not in told:
        return config
    return json_text({name: value for name, value in told.items() if name != "origin"}).encode()


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
    record = read_record(folder)
    encoder_config, card = record.encoder, record.pretrain
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
        with fork_rng(devices=[]):  # weights that are drawn here are read over
            encoder = Encoder(encoder_config)
        _check_corruption(card)
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise UserError(
            f"{folder}/config.json: names no encoder ({first_line(error)}); mend that, or pretrain it again"
        ) from error
    try:
        encoder.load_state_dict(read_tensors(folder / WEIGHTS))
    except RuntimeError as error:
        raise UserError(
            f"{folder}/model.safetensors: does not fit the network that config.json beside it names, whose code may "
            f"have changed ({in_one_line(error)}); take the code it was pretrained with, or pretrain the encoder again"
        ) from error
    except (FileNotFoundError, SafetensorError) as error:
        reason = first_line(error)
        raise UserError(f"{folder}/model.safetensors: cannot be read ({reason}); pretrain the encoder again") from error
    return encoder.eval().requires_grad_(False), card


def _check_corruption(card: EncoderCard) -> None:
    """Raise KeyError, TypeError or ValueError unless a card names a corruption, and options that some part has."""
    config = CorruptionConfig.fill({"corruption": card.corruption["corruption"], **card.corruption})
    if unknown := card.corruption.keys() - flat(config).keys() - option_names():  # early ones tell of unused ones, too
        raise TypeError(f"corruption {config.corruption} has no option {min(unknown)!r} by now")
    build(CorruptionConfig, {"corruption": config.corruption, "corruption_mode": config.corruption_mode})
    for stage in config.stages:
        build(type(stage), asdict(stage))
    config.check()


def read_record(folder: Path) -> EncoderRecord:
    """An encoder folder's config.json; raises UserError if there is none, a damaged one, or a pickle in its place."""
    with disk_errors(folder):
        pickles = [p.name for p in folder.glob("*") if p.suffix in (".pt", ".pth", ".pkl", ".bin", ".ckpt")]
    if pickles and not (folder / WEIGHTS).exists():
        raise UserError(f"{folder}: {pickles[0]} is a pickle, which can run code; only {WEIGHTS} is read")
    try:
        config = parse_json(read_bytes(folder / CONFIG))
        origin = build(EncoderOrigin, config.get("origin", {}))
        return EncoderRecord(build(EncoderConfig, config["encoder"]), build(EncoderCard, config["pretrain"]), origin)
    except UserError:
        raise
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError) as error:
        inner = folder / "encoder"
        hint = f"name {inner}" if (inner / CONFIG).is_file() else "`vd4rl-pomdp pretrain` writes one as RUN/encoder"
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise UserError(f"{folder}: not an encoder folder (config.json: {reason}); {hint}") from error
