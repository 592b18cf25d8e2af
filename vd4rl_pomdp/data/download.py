"""Download V-D4RL's 84-pixel data sets with huggingface_hub: resumable, SHA-256 verified, equal files hard-linked."""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

from huggingface_hub import hf_hub_download, hf_hub_url
from huggingface_hub.errors import HTTPError

from vd4rl_pomdp.core.errors import UserError, disk_errors, in_one_line, refuse_unknown
from vd4rl_pomdp.core.tasks import QUALITIES
from vd4rl_pomdp.data.folder import RemoteFile, manifest
from vd4rl_pomdp.runs.files import sha256
from vd4rl_pomdp.runs.outputs import owned, refuse_kept

REPOSITORY = "conglu/vd4rl"


def default_endpoint() -> str:
    """Address of the Hub: HF_ENDPOINT if set, as in huggingface_hub, else https://huggingface.co."""
    return os.environ.get("HF_ENDPOINT") or "https://huggingface.co"


def check_published(tasks: Iterable[str], qualities: Iterable[str]) -> None:
    """Raise UserError for a task or quality without a published data set."""
    published = list(dict.fromkeys(file.path.split("/")[2] for file in manifest()))
    for task in tasks:
        refuse_unknown("task of published sets", task, published)
    for quality in qualities:
        refuse_unknown("quality", quality, QUALITIES)


def download(
    task: str, quality: str, destination: Path, endpoint: str | None = None, verify: bool = False
) -> list[Path]:
    """Download one data set into `destination/{task}/{quality}/84px`; returns its shards.

    Existing files are not downloaded again; files equal to another data set's below `destination` are hard-linked.

    Args:
        endpoint: address of the Hub or a mirror, without `/datasets`; None: `default_endpoint`.
        verify: also check the SHA-256 of existing files; by default only their size is checked.
    """
    check_published([task], [quality])
    endpoint = default_endpoint() if endpoint is None else endpoint
    if not re.match(r"https?://(\w|\[[0-9a-fA-F:]+\])", endpoint):
        raise UserError(f"endpoint {endpoint!r} is not an address; it must start with https:// or http://")
    refuse_kept(destination)
    published = [file for file in manifest() if file.path.split("/")[2:4] == [task, quality]]
    if missing := [file for file in published if not _is_there(file, file.target(destination), verify)]:
        scratch = destination / f".{task}_{quality}.download"
        with owned(scratch), disk_errors(destination):
            for file in missing:
                target = file.target(destination)
                others = (other.target(destination) for other in manifest() if other.sha256 == file.sha256)
                twin = next((path for path in others if path != target and _is_there(file, path, verify=True)), None)
                fresh = scratch / target.name if twin else _fetch(file, scratch, endpoint.rstrip("/"))
                if twin:
                    fresh.unlink(missing_ok=True)
                    try:
                        os.link(twin.resolve(), fresh)
                    except OSError:  # not every file system supports hard links
                        shutil.copyfile(twin, fresh)
                target.parent.mkdir(parents=True, exist_ok=True)
                fresh.replace(target)
        shutil.rmtree(scratch, ignore_errors=True)
    return [file.target(destination) for file in published]


def _is_there(file: RemoteFile, path: Path, verify: bool) -> bool:
    """Whether a file is complete. Only verified files get their final name, so by default the size suffices."""
    return path.is_file() and path.stat().st_size == file.size and (not verify or sha256(path) == file.sha256)


def _fetch(file: RemoteFile, folder: Path, endpoint: str) -> Path:
    """Download a file into a folder, resuming an interrupted download, and verify it."""
    url = hf_hub_url(REPOSITORY, file.path, repo_type="dataset", endpoint=endpoint)
    logging.getLogger("huggingface_hub.utils._http").setLevel(logging.ERROR)  # hide retries; failures are raised
    try:
        fetched = hf_hub_download(
            REPOSITORY,
            file.path,
            repo_type="dataset",
            local_dir=folder,
            endpoint=endpoint,
            token=None if endpoint == default_endpoint().rstrip("/") else False,  # never send a token to other hosts
            library_name="vd4rl-pomdp",  # for the Hub's download statistics
        )
    except (HTTPError, OSError) as error:
        if isinstance(error, OSError) and error.errno:  # from the disk; huggingface_hub's OSErrors have no errno
            raise
        reason = in_one_line(error.__cause__ or error)
        raise UserError(
            f"{url}: cannot be fetched ({reason}); check the network or choose another --endpoint, and re-run the same "
            "command to resume"
        ) from error
    path = Path(fetched)
    if not _is_there(file, path, verify=True):
        path.unlink()
        raise UserError(
            f"{url}: has a wrong SHA-256 and was removed; re-run the same command or choose another --endpoint"
        )
    return path
