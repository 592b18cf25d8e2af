"""Fetch the published 84-pixel sets: resumed after an interruption, checked by SHA-256, equal files stored once.

They lie on the Hugging Face Hub. Where, and as whom to ask, is huggingface_hub's: address, HF_ENDPOINT, token. The
bytes are received here: its own downloads ask a mirror for more than files, try no status of 500 and above again, wait
for an address where nobody is, and lose up to 10 MB with every connection that breaks.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import requests
from huggingface_hub import hf_hub_url
from huggingface_hub.utils import build_hf_headers
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn
from urllib3.exceptions import NewConnectionError

from vd4rl_pomdp import __version__
from vd4rl_pomdp.core.errors import UserError, disk_error, disk_errors, refuse_unknown
from vd4rl_pomdp.core.tasks import QUALITIES
from vd4rl_pomdp.data.manifest import RemoteFile, manifest
from vd4rl_pomdp.runs.files import replacing_file, sha256
from vd4rl_pomdp.runs.outputs import refuse_kept
from vd4rl_pomdp.runs.ownership import owned

HUB = "https://huggingface.co"
REPOSITORY = "conglu/vd4rl"
_ATTEMPTS = 5
_FIRST_WAIT_S = 1.0
_TIMEOUT_S = (10.0, 60.0)
_BLOCK = 1 << 16
"""Bytes read at once: what a cut connection loses at most."""


def default_endpoint() -> str:
    """The Hub, or the mirror of it that HF_ENDPOINT names, as for everything that uses huggingface_hub."""
    return os.environ.get("HF_ENDPOINT") or HUB


def check_endpoint(endpoint: str, name: str) -> None:
    """Raise UserError unless what a mirror is called, by the flag or variable `name`, is an address."""
    try:
        parts = urlsplit(endpoint)
    except ValueError:
        parts = urlsplit("")
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise UserError(f"{name} {endpoint!r} is no address; it starts with https:// or http://")


def download(
    task: str, quality: str, destination: Path, endpoint: str | None = None, verify: bool = False
) -> list[Path]:
    """Download one set into `destination/{task}/{quality}/84px`; what is there already is not fetched again.

    Args:
        task: task name.
        quality: one of `tasks.QUALITIES`.
        destination: folder that holds all downloaded sets; a file that another set in it has is linked, not fetched.
        endpoint: address of the mirror, up to and without `/datasets`; None: `default_endpoint`.
        verify: also compute the SHA-256 of files that are at their places; otherwise their size is enough there.

    Returns:
        The set's shards, all of them verified.

    Raises:
        UserError: unknown task or quality, no answer from the mirror, a wrong checksum, a full disk, or a set that
            another process downloads.
    """
    published = list(dict.fromkeys(file.path.split("/")[2] for file in manifest()))
    refuse_unknown("task of published sets", task, published)
    refuse_unknown("quality", quality, QUALITIES)
    endpoint = default_endpoint() if endpoint is None else endpoint
    check_endpoint(endpoint, "endpoint")
    refuse_kept(destination)
    wanted = [file for file in manifest() if file.path.split("/")[2:4] == [task, quality]]
    if lacking := [file for file in wanted if not _is_settled(file, file.target(destination), verify)]:
        with _owning(_part(lacking[-1].target(destination))), _progress_bar() as bar:
            total = bar.add_task(f"{task} {quality}", total=sum(file.size for file in lacking))
            for file in lacking:
                _provide(file, destination, endpoint.rstrip("/"), bar)
                _part(file.target(destination)).unlink(missing_ok=True)
                bar.advance(total, file.size)
    return [file.target(destination) for file in wanted]


def _part(target: Path) -> Path:
    """Where a file grows; while it is there, nothing opens the set."""
    return target.with_name(f"{target.name}.part")


@contextmanager
def _owning(last: Path) -> Iterator[None]:
    """Own a set's folder; what was made for that goes again if nothing has come into it.

    Args:
        last: part of the file that comes last: from the first on it says that the set is not whole.
    """
    folder = last.parent
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        with owned(folder), _marking(last):
            yield
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()


@contextmanager
def _marking(last: Path) -> Iterator[None]:
    """Keep the part that says so while a set is not whole; it goes again if nothing but it has come."""
    try:
        with disk_errors(last):
            last.touch()
        yield
    finally:
        with suppress(OSError):
            if not _size(last) and [f for f in last.parent.iterdir() if not f.name.startswith(".")] == [last]:
                last.unlink()


def _progress_bar() -> Progress:
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn()
    return Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal)


def _provide(file: RemoteFile, destination: Path, endpoint: str, bar: Progress) -> None:
    """Make sure that one file is at its place: it is there, an equal one is linked, or it is fetched; verified."""
    target = file.target(destination)
    if _is_complete(file, target, verify=True):
        return
    try:
        twins = (other.target(destination) for other in manifest() if other.sha256 == file.sha256)
        twin = next((path for path in twins if path != target and _is_complete(file, path, verify=True)), None)
        if twin:
            _link(twin, target)
        else:
            _fetch(file, target, _address(file, endpoint), bar)
    except OSError as error:
        raise disk_error(target, error) from error


def _address(file: RemoteFile, endpoint: str) -> str:
    return hf_hub_url(REPOSITORY, file.path, repo_type="dataset", endpoint=endpoint)


def _headers(url: str) -> dict[str, str]:
    """What huggingface_hub tells of itself, and its user's token if that is meant for an address."""
    token = None if url.startswith(f"{default_endpoint().rstrip('/')}/") else False
    return build_hf_headers(token=token, library_name="vd4rl-pomdp", library_version=__version__)


def _is_settled(file: RemoteFile, path: Path, verify: bool) -> bool:
    """Whether nothing is left to do for a file: it is at its place, and no part of it lies beside it."""
    return not _part(path).exists() and _is_complete(file, path, verify)


def _is_complete(file: RemoteFile, path: Path, verify: bool) -> bool:
    """Only verified files get their final name, so the size suffices unless asked otherwise."""
    if not path.is_file() or path.stat().st_size != file.size:
        return False
    return not verify or sha256(path) == file.sha256


def _link(source: Path, target: Path) -> None:
    """Give an existing file a second name: a hard link, a symbolic one, or where neither works a copy."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing_file(target) as fresh:
        fresh.unlink(missing_ok=True)
        try:
            os.link(source.resolve(), fresh)
        except OSError:
            try:
                fresh.symlink_to(os.path.relpath(source, target.parent.resolve()))
            except OSError:
                shutil.copyfile(source, fresh)


def _fetch(file: RemoteFile, target: Path, url: str, bar: Progress) -> None:
    part = _part(target)
    row = bar.add_task(file.path.split("/")[-1], total=file.size)
    start = furthest = _size(part)
    failures, problem = 0, ""
    while _size(part) < file.size:
        try:
            for done in _receive(url, part, _size(part)):
                bar.update(row, completed=done)
        except requests.RequestException as error:
            problem = _describe(error)
            if furthest == _size(part) == start and _is_nobody(error):
                failures = _ATTEMPTS
        if _size(part) > furthest:
            failures, furthest = 0, _size(part)
            continue
        failures += 1
        if failures >= _ATTEMPTS:
            reason = problem or "it sent nothing"
            raise UserError(
                f"{url}: cannot be fetched ({reason}); check the network or choose another --endpoint, and re-run "
                "the same command to resume"
            )
        time.sleep(_FIRST_WAIT_S * 2 ** (failures - 1))
    bar.remove_task(row)
    if _size(part) != file.size or sha256(part) != file.sha256:
        part.unlink()
        raise UserError(
            f"{url}: has a wrong SHA-256 and was removed; re-run the same command or choose another --endpoint"
        )
    part.replace(target)


def _receive(url: str, part: Path, offset: int) -> Iterator[int]:
    """Append to `part` from `offset`, or from the start where the server ignores ranges; yields the bytes there."""
    headers = _headers(url) | {"Accept-Encoding": "identity"} | ({"Range": f"bytes={offset}-"} if offset else {})
    with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as response:
        if 400 <= response.status_code < 500 and response.status_code not in (408, 429):
            raise UserError(f"{url}: the mirror answers {response.status_code} {response.reason}; check --endpoint")
        response.raise_for_status()
        resumed = response.status_code == 206
        done = offset if resumed else 0
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab" if resumed else "wb") as file:
            for block in response.iter_content(_BLOCK):
                file.write(block)
                done += len(block)
                yield done


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _is_nobody(error: requests.RequestException) -> bool:
    """Whether there is no mirror at an address, so that waiting for it is in vain."""
    if isinstance(error, requests.exceptions.InvalidURL | requests.exceptions.SSLError):
        return True
    return bool(error.args) and isinstance(getattr(error.args[0], "reason", None), NewConnectionError)


def _describe(error: requests.RequestException) -> str:
    if error.response is not None:
        return f"status {error.response.status_code}"
    return type(error).__name__
