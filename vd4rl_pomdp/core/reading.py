"""Read files without trusting their content: damage raises an error with a message, and no file makes a reader hang."""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints
from zipfile import BadZipFile

from vd4rl_pomdp.core.errors import UserError, disk_error

if TYPE_CHECKING:
    from PIL import Image
    from torch import Tensor

T = TypeVar("T")
PICTURES = ("PNG", "JPEG", "WEBP")
"""Formats in which Pillow opens pictures: some of its others run programs, such as Ghostscript for EPS."""
_PARSING = (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, csv.Error, BadZipFile, zlib.error)
"""Exceptions that parsers raise on damaged files."""


def regular(path: Path) -> Path:
    """Return `path`; UserError for a folder, or for a pipe or device, which may never end."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: is a folder, a pipe or a device, not a regular file; remove it or name another")
    return path


def inside(folder: Path, path: Path) -> Path:
    """Return `path`, a file to copy from `folder`; UserError if it links to a file outside, which must not leak."""
    if not path.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{path}: links to a file outside {folder}; replace it by a copy, or remove it")
    return path


def read_bytes(path: Path) -> bytes:
    """A file's content; FileNotFoundError if it is missing, UserError if it cannot be read.

    Any later error while parsing the content thus means that the file is damaged.
    """
    try:
        return regular(path).read_bytes()
    except FileNotFoundError:
        raise
    except NotADirectoryError as error:
        raise FileNotFoundError(error.errno, error.strerror, str(path)) from error
    except OSError as error:
        raise disk_error(path, error) from error


def parse_json(text: str | bytes) -> Any:
    """`json.loads` that raises ValueError for every failure."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


@contextmanager
def damaged(where: Path | str, what: str, remedy: str = "") -> Iterator[None]:
    """Turn parsing errors within the block into UserError "where: what (error); remedy"."""
    try:
        yield
    except UserError:
        raise
    except _PARSING as error:
        raise UserError(f"{where}: {what} ({error})" + (f"; {remedy}" if remedy else "")) from error


def build(kind: type[T], values: Any) -> T:
    """Build a dataclass from JSON values; TypeError for unknown names or wrong types."""
    made, hints = kind(**values), get_type_hints(kind)
    for field in fields(made):  # type: ignore[arg-type]
        if not fits(getattr(made, field.name), hints[field.name]):
            raise TypeError(f"{field.name} is {getattr(made, field.name)!r}")
    return made


def fits(value: Any, hint: Any) -> bool:
    """Whether a value matches a type annotation. An int counts as float; a bool does not count as int."""
    if hint is Any:
        return True
    if get_origin(hint) in (Union, UnionType):
        return any(fits(value, part) for part in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, int | float) if hint is float else isinstance(value, get_origin(hint) or hint)


def safetensors_metadata(content: bytes) -> dict[str, str]:
    """Metadata in the header of a safetensors file; ValueError if it is not one.

    The library only reads metadata of files that it opens itself, and reports every one it cannot open as missing.
    """
    header = parse_json(content[8 : 8 + int.from_bytes(content[:8], "little")])
    metadata = header.get("__metadata__", {}) if isinstance(header, dict) else None
    if not isinstance(metadata, dict):
        raise ValueError("its header is not a JSON object")
    return metadata


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors of a safetensors file; UserError if a number is not finite.

    Raises:
        FileNotFoundError, SafetensorError: the file is missing, or is no safetensors file.
    """
    from safetensors.torch import load  # loads torch, which commands that read no tensors do not

    tensors = load(read_bytes(path))
    bad = next((n for n, v in tensors.items() if v.is_floating_point() and not v.isfinite().all()), None)
    if bad is not None:
        raise UserError(f"{path}: {bad!r} is not finite, so the file is damaged; use another copy or train again")
    return tensors


def rgb_of(image: Image.Image) -> Image.Image:
    """An opened image in RGB; UserError for one of more than 8 bits per channel, such as a depth map.

    Pillow would set everything above 255 to white.
    """
    if image.mode.startswith(("I", "F")):
        raise UserError(f"has an image of more than 8 bits per channel (mode {image.mode}): convert it to 8 bits")
    return image if image.mode == "RGB" else image.convert("RGB")
