"""Read and write whole files atomically, with the permissions given by the umask."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import os
import secrets
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.reading import damaged, parse_json, read_bytes

Row = dict[str, Any]  # one row of a table: values by column
Member = TypeVar("Member")
Key = TypeVar("Key", bound=Hashable)


def jsonable(value: Any) -> Any:
    """Config values as JSON types: paths become strings, tuples become lists."""
    if isinstance(value, dict):
        return {k: jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; UserError if it is missing, unreadable or damaged."""
    with damaged(path, "cannot be read as JSON"):
        value = parse_json(read_bytes(path))
    if not isinstance(value, dict):
        raise UserError(f"{path}: is not a JSON object")
    return value


def write_json(path: Path, value: Any, shared: bool = False) -> None:
    """Write a JSON file atomically; `shared` as in `replacing_file`."""
    with replacing_file(path, shared) as fresh:
        fresh.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write a CSV file with a header, atomically."""
    with replacing_file(path) as fresh, fresh.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def content_hash(value: Any) -> str:
    """Hash of anything JSON-serialisable, 24 hex characters."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=12).hexdigest()


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file, read in chunks."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    with replacing_file(path) as fresh:
        fresh.write_bytes(content)


@contextmanager
def replacing_file(path: Path, shared: bool = False) -> Iterator[Path]:
    """Yield a hidden temporary path next to `path`, renamed to `path` when the block ends and deleted if it fails.

    Its folder is created if needed. If several processes may write it at once (`shared`), each has its own temporary
    name, which is left behind if the process is killed. UserError if the disk is full, or the system refuses for
    another reason.
    """
    own = f".{secrets.token_hex(4)}" if shared else ""
    fresh = path.with_name(f".{path.name}{own}.tmp")
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh.unlink(missing_ok=True)  # a link of that name would be followed
        try:
            yield fresh
            # Flush the content before renaming, or a power cut could leave the name with an empty file.
            synchronise(fresh)
            fresh.replace(path)
        finally:
            fresh.unlink(missing_ok=True)


@contextmanager
def appending(path: Path) -> Iterator[IO[str]]:
    """Append the text written within the block to a file, and flush it to disk since checkpoints rely on it.

    Concurrent writers wait for each other where the file system supports locks. UserError if the system refuses; the
    file is then as before.
    """
    with disk_errors(path), path.open("ab", buffering=0) as file:
        with suppress(OSError):  # some file systems have no locks
            fcntl.flock(file.fileno(), fcntl.LOCK_EX)
        text = io.StringIO(newline="")
        yield text
        content, size = text.getvalue().encode(), os.fstat(file.fileno()).st_size
        try:
            while content:  # a full disk takes a part, and refuses the next one
                content = content[file.write(content) :]
            os.fsync(file.fileno())
        except BaseException:
            file.truncate(size)
            raise


def synchronise(path: Path) -> None:
    """fsync a file, or a folder's directory entries."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def files_below(folder: Path, name: str) -> list[Path]:
    """Every file of that name at or below a folder, sorted. Follows symlinks; visits each folder once."""
    found, seen, starts = [], set[str](), [folder]
    for start in starts:  # links are visited after the real folders
        for place, folders, names in os.walk(start):
            real = os.path.realpath(place)
            if real in seen:
                folders.clear()
                continue
            seen.add(real)
            starts += [path for inner in sorted(folders) if (path := Path(place, inner)).is_symlink()]
            found += [Path(place, name)] if name in names else []
    return sorted(found)


def holds_anything(folder: Path) -> bool:
    """Whether a folder exists and holds anything but hidden files, which interrupted commands leave behind."""
    with disk_errors(folder):
        return folder.is_dir() and any(not file.name.startswith(".") for file in folder.iterdir())


def groups(members: Iterable[Member], key: Callable[[Member], Key]) -> dict[Key, list[Member]]:
    """Members grouped by key; keys in order of first occurrence."""
    found: dict[Key, list[Member]] = {}
    for member in members:
        found.setdefault(key(member), []).append(member)
    return found


def flatten(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested dicts into one, with keys joined by dots."""
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}{key}.") if isinstance(item, dict) else {f"{prefix}{key}": item}
    return flat
