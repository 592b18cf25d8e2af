"""Read files that may hold anything: a damaged one ends in an error with a message, and no file makes a reader hang."""

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
    from torch import Tensor

T = TypeVar("T")
_PARSING = (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, csv.Error, BadZipFile, zlib.error)
"""What those who parse a damaged file raise."""


def regular(path: Path) -> Path:
    """`path` itself; raises UserError for a pipe or a device, which may have no end, and for a folder."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: is no regular file but a folder, a pipe or a device; remove it or name another")
    return path


def read_bytes(path: Path) -> bytes:
    """A file's content; raises FileNotFoundError for a missing file, UserError for one that cannot be read.

    An error while its content is parsed then means that the file is damaged.
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
    """`json.loads`, with a ValueError for every failure."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


@contextmanager
def damaged(where: Path | str, what: str, remedy: str = "") -> Iterator[None]:
    """Within the block a file's content is read: whatever is wrong with it becomes "where: what (error); remedy"."""
    try:
        yield
    except UserError:
        raise
    except _PARSING as error:
        raise UserError(f"{where}: {what} ({error})" + (f"; {remedy}" if remedy else "")) from error


def build(kind: type[T], values: Any) -> T:
    """An instance of a dataclass from JSON values; wrong names, or a value of another type, raise TypeError."""
    made, hints = kind(**values), get_type_hints(kind)
    for field in fields(made):  # type: ignore[arg-type]
        if not fits(getattr(made, field.name), hints[field.name]):
            raise TypeError(f"{field.name} is {getattr(made, field.name)!r}")
    return made


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated type: an int is a float, too, and a bool is no int."""
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
    """What stands in the header of a safetensors file besides its tensors; raises ValueError for no such file.

    The library tells it of files alone that it opens itself, and calls every one missing that it cannot open.
    """
    header = parse_json(content[8 : 8 + int.from_bytes(content[:8], "little")])
    metadata = header.get("__metadata__", {}) if isinstance(header, dict) else None
    if not isinstance(metadata, dict):
        raise ValueError("its header is no JSON object")
    return metadata


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors of a safetensors file; a number that is not finite raises UserError.

    Raises:
        FileNotFoundError, SafetensorError: the file is missing or no such file.
    """
    import torch
    from safetensors.torch import load

    tensors = load(read_bytes(path))
    bad = next((n for n, v in tensors.items() if v.is_floating_point() and not torch.isfinite(v).all()), None)
    if bad is not None:
        raise UserError(f"{path}: {bad!r} is not finite, so the file is damaged; take another copy or train again")
    return tensors
