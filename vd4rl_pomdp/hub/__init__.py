"""Encoders and data sets on the Hugging Face Hub.

A repository that `push` wrote holds a listing beside the files: their kind, their licence, and the SHA-256 of each, by
which `pull` judges what it was sent. Encoders are model repositories, OWNER/NAME; data sets are datasets/OWNER/NAME, as
in the Hub's own addresses. Endpoint and token are those of huggingface_hub: HF_ENDPOINT, HF_TOKEN, `hf auth login`.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
from huggingface_hub.hf_api import DatasetInfo, ModelInfo

from vd4rl_pomdp import __version__
from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.hub.contents import LISTING, Listing, accept, checked, is_there
from vd4rl_pomdp.hub.repository import Repository, hub_answers, hub_api, hub_info, provide
from vd4rl_pomdp.nn.model_card import CARD, LICENSE
from vd4rl_pomdp.runs.files import json_text
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.ownership import owned

__all__ = ["LISTING", "Repository", "pull", "push"]


def push(
    folder: Path, repository: Repository, private: bool = False, revision: str = "main", license: str = LICENSE
) -> str:
    """Write an encoder or a data set as one commit; returns its address.

    Args:
        folder: an encoder's or a set's folder, which is checked first.
        repository: made if there is none; one that `push` did not write is refused unless it is empty.
        private: make it private; a public one that is there already is refused.
        revision: branch to write to, made if there is none.
        license: the licence that its card names, as the Hub spells it.

    Raises:
        UserError: the folder holds neither or a damaged one, or the Hub refuses or cannot be reached.
    """
    files, card = checked(folder, repository, license)
    api = hub_api()
    with hub_answers(repository, revision):
        held = _held(api, repository, provide(api, repository, private))
        if revision != "main":
            api.create_branch(repository.name, branch=revision, repo_type=repository.type, exist_ok=True)
            held = _held(api, repository, hub_info(api, repository, revision))
        listing = Listing.of(files, repository.kind, license)
        texts = {CARD: card.encode(), LISTING: json_text(asdict(listing)).encode()}
        adds = [CommitOperationAdd(file.name, file) for file in files]
        adds += [CommitOperationAdd(name, content) for name, content in texts.items()]
        gone = [CommitOperationDelete(name) for name in sorted(held - listing.sha256.keys())]
        message = f"{repository.kind.split()[-1].capitalize()} of vd4rl-pomdp {__version__}"
        commit = api.create_commit(
            repository.name, [*adds, *gone], commit_message=message, repo_type=repository.type, revision=revision
        )
    return str(commit.commit_url)


def pull(repository: Repository, folder: Path, revision: str = "main") -> bool:
    """Fetch an encoder or a data set; returns whether anything was fetched: what is there and right is left as it is.

    A pull that was cut goes on where it was; `folder` appears when all of it is there and right.

    Args:
        repository: one that `push` wrote.
        folder: folder to make; an empty one will do.
        revision: branch, tag or commit.

    Raises:
        UserError: the folder holds something else, what was sent is damaged, or the Hub refuses or cannot be reached.
    """
    folder = Path(os.path.abspath(folder))
    refuse_inside(folder)
    api = hub_api()
    with hub_answers(repository, revision):
        info = hub_info(api, repository, revision)
        listing = _listing(api, repository, info)
    if is_there(folder, listing):
        return False
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise UserError(f"{folder}: is not empty and holds something else than {repository}; choose another folder")
    beside = folder.with_name(f".{folder.name}.pull")
    content = beside / "content"
    with owned(beside), disk_errors(folder):
        with hub_answers(repository, revision):
            for name in listing.sha256:
                api.hf_hub_download(
                    repository.name, name, repo_type=repository.type, revision=info.sha, local_dir=content
                )
        accept(content, listing, repository)
        content.rename(folder)
    shutil.rmtree(beside, ignore_errors=True)
    return True


def _held(api: HfApi, repository: Repository, info: ModelInfo | DatasetInfo) -> set[str]:
    """Files that an earlier push left; raises UserError for a repository that holds anything else."""
    names = {file.rfilename for file in info.siblings or []}
    if LISTING in names:
        return set(_listing(api, repository, info).sha256) & names
    if names - {".gitattributes", CARD}:
        raise UserError(f"{repository}: holds files that were not pushed by vd4rl-pomdp; choose another name")
    return set()


def _listing(api: HfApi, repository: Repository, info: ModelInfo | DatasetInfo) -> Listing:
    """A repository's listing; raises UserError if it has none, or a damaged one, or one of another kind."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            api.hf_hub_download(
                repository.name, LISTING, repo_type=repository.type, revision=info.sha, local_dir=Path(folder)
            )
        except EntryNotFoundError as error:
            if isinstance(error, LocalEntryNotFoundError):
                raise
            raise UserError(
                f"{repository}: holds nothing that `vd4rl-pomdp hub push` wrote, it has no {LISTING}; check the name"
            ) from error
        return Listing.read(Path(folder) / LISTING, repository)
