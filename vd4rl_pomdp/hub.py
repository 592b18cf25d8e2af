"""Encoders and data sets on the Hugging Face Hub.

A repository that `push` wrote holds a listing beside the files: their kind, and the SHA-256 of each, by which `pull`
judges what it was sent. Encoders are model repositories, OWNER/NAME; data sets are datasets/OWNER/NAME, as in the Hub's
own addresses. Endpoint and token are those of huggingface_hub: HF_ENDPOINT, HF_TOKEN, `hf auth login`.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
from huggingface_hub.errors import (
    EntryNotFoundError,
    FileMetadataError,
    GatedRepoError,
    HfHubHTTPError,
    HFValidationError,
    HTTPError,
    LocalEntryNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.hf_api import DatasetInfo, ModelInfo
from huggingface_hub.utils import disable_progress_bars, validate_repo_id

from vd4rl_pomdp import __version__
from vd4rl_pomdp.data.download import default_endpoint
from vd4rl_pomdp.data.episodes import join_shards
from vd4rl_pomdp.data.format import SUFFIXES, check_frames, read_rows, shard_paths
from vd4rl_pomdp.data.hub_card import set_card
from vd4rl_pomdp.errors import UserError, disk_errors
from vd4rl_pomdp.nn.encoder_folder import CONFIG, WEIGHTS, load_encoder, read_record
from vd4rl_pomdp.nn.model_card import CARD, LICENSE, model_card
from vd4rl_pomdp.runs.files import json_text, read_json, sha256, write_bytes
from vd4rl_pomdp.runs.outputs import kept_in, refuse_inside
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.runs.reading import build

LISTING = "vd4rl_pomdp.json"
FORMAT = 1
ENCODER, SET = "an encoder", "a data set"
"""What a repository holds, in the words of `runs.outputs.kept_in`."""
_ENCODER_FILES = {CONFIG, WEIGHTS}
_SET_SUFFIXES = (*SUFFIXES, ".json", ".md", ".png")
_TIMEOUT_S = 30.0
"""How long the Hub's first answer may take."""


@dataclass(frozen=True)
class Repository:
    """A repository by the name that the command line gives it."""

    name: str
    """OWNER/NAME."""
    kind: str
    """ENCODER or SET."""

    @classmethod
    def named(cls, text: str) -> Repository:
        """OWNER/NAME of an encoder, datasets/OWNER/NAME of a set; any other text raises UserError."""
        kind, name = (SET, text.removeprefix("datasets/")) if text.startswith("datasets/") else (ENCODER, text)
        try:
            validate_repo_id(name)
        except HFValidationError:
            name = ""
        if name.count("/") != 1:
            raise UserError(
                f"{text!r} names no repository: write OWNER/NAME for an encoder, datasets/OWNER/NAME for a data set"
            )
        return cls(name, kind)

    @property
    def type(self) -> str:
        """As the Hub calls its kind."""
        return "dataset" if self.kind == SET else "model"

    def __str__(self) -> str:
        return f"datasets/{self.name}" if self.kind == SET else self.name


@dataclass(frozen=True)
class Listing:
    """What a repository holds."""

    format: int
    kind: str
    sha256: dict[str, str]
    """Of each file by its name."""


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
    files, card = _checked(folder, repository, license)
    api = _api()
    with _answers(repository, revision):
        held = _held(api, repository, _provide(api, repository, private))
        if revision != "main":
            api.create_branch(repository.name, branch=revision, repo_type=repository.type, exist_ok=True)
            held = _held(api, repository, _info(api, repository, revision))
        listing = Listing(FORMAT, repository.kind, {file.name: sha256(file) for file in files})
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
    api = _api()
    with _answers(repository, revision):
        info = _info(api, repository, revision)
        listing = _listing(api, repository, info)
    if _is_there(folder, listing):
        return False
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise UserError(f"{folder}: is not empty and holds something else than {repository}; choose another folder")
    beside = folder.with_name(f".{folder.name}.pull")
    content = beside / "content"
    with owned(beside), disk_errors(folder):
        with _answers(repository, revision):
            for name in listing.sha256:
                api.hf_hub_download(
                    repository.name, name, repo_type=repository.type, revision=info.sha, local_dir=content
                )
        _accept(content, listing, repository)
        content.rename(folder)
    shutil.rmtree(beside, ignore_errors=True)
    return True


def _api() -> HfApi:
    endpoint = default_endpoint()
    _check_endpoint(endpoint)
    if not sys.stderr.isatty():
        disable_progress_bars()
    return HfApi(endpoint=endpoint, library_name="vd4rl-pomdp", library_version=__version__)


def _check_endpoint(endpoint: str) -> None:
    """Raise UserError unless HF_ENDPOINT is an address."""
    try:
        parts = urlsplit(endpoint)
    except ValueError:
        parts = urlsplit("")
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise UserError(f"HF_ENDPOINT {endpoint!r} is no address; it starts with https:// or http://")


def _checked(folder: Path, repository: Repository, license: str) -> tuple[list[Path], str]:
    """The files of what a folder holds, and its card; raises UserError unless it is whole and of the right kind."""
    kind = _kind(folder)
    if kind not in (ENCODER, SET):
        raise UserError(f"{folder}: holds neither an encoder nor a data set; name RUN/encoder or a folder of shards")
    if kind != repository.kind:
        form = "datasets/OWNER/NAME" if kind == SET else "OWNER/NAME"
        raise UserError(f"{folder}: holds {kind}, which goes to {form}; {repository} is the name for {repository.kind}")
    _check(folder, kind)
    if kind == ENCODER:
        card = model_card(read_record(folder), repository.name, license)
        return [folder / name for name in sorted(_ENCODER_FILES)], card
    names = sorted(path.name for path in folder.iterdir() if path.is_file() and _is_name_of_set(path.name))
    return [folder / name for name in names], set_card(folder, repository.name, license)


def _kind(folder: Path) -> str | None:
    """What a folder holds; files that are called shards make a set, so that it is told what is wrong with them."""
    kind = kept_in(folder)
    named = kind is None and folder.is_dir() and any(path.suffix in SUFFIXES for path in folder.iterdir())
    return SET if named else kind


def _check(folder: Path, kind: str) -> None:
    """Raise UserError for an encoder that does not load, or a set whose rows, frames apart, are not whole."""
    if kind == ENCODER:
        load_encoder(folder)
    else:
        shards = shard_paths(folder)
        check_frames(shards)
        join_shards(shards, [read_rows(shard) for shard in shards])


def _is_name_of_set(name: str) -> bool:
    """Whether a set may have a file of a name: no folder's, no hidden one, no README of another maker."""
    return Path(name).name == name and not name.startswith(".") and name.endswith(_SET_SUFFIXES) and name != CARD


def _info(api: HfApi, repository: Repository, revision: str | None = None) -> ModelInfo | DatasetInfo:
    info = api.repo_info(repository.name, repo_type=repository.type, revision=revision, timeout=_TIMEOUT_S)
    assert isinstance(info, ModelInfo | DatasetInfo)
    return info


def _provide(api: HfApi, repository: Repository, private: bool) -> ModelInfo | DatasetInfo:
    """What the Hub says of a repository, which is made if there is none."""
    try:
        info = _info(api, repository)
    except GatedRepoError:
        raise
    except RepositoryNotFoundError:
        api.create_repo(repository.name, repo_type=repository.type, private=private or None, exist_ok=True)
        info = _info(api, repository)
    if private and not info.private:
        raise UserError(f"{repository}: is public already; leave --private out, or choose another name")
    return info


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
        try:
            listing = build(Listing, read_json(Path(folder) / LISTING))
            _check_listing(listing, repository)
        except (UserError, TypeError, ValueError) as error:
            raise UserError(f"{repository}: its {LISTING} is of another version or damaged; ask its owner") from error
    return listing


def _check_listing(listing: Listing, repository: Repository) -> None:
    """Raise ValueError unless a listing is of this format and of a repository's kind, and names what that kind has."""
    names = listing.sha256.keys()
    if listing.kind == ENCODER:
        fits = names == _ENCODER_FILES
    else:
        fits = all(map(_is_name_of_set, names)) and any(name.endswith(SUFFIXES) for name in names)
    told = all(isinstance(digest, str) for digest in listing.sha256.values())
    if (listing.format, listing.kind) != (FORMAT, repository.kind) or not (fits and told):
        raise ValueError(json.dumps(asdict(listing)))


def _is_there(folder: Path, listing: Listing) -> bool:
    """Whether a folder holds what a listing lists, and no shard that would make it another set."""
    shards = {path.name for suffix in SUFFIXES for path in folder.glob(f"*{suffix}")}
    return shards <= listing.sha256.keys() and all(
        (folder / n).is_file() and sha256(folder / n) == digest for n, digest in listing.sha256.items()
    )


def _accept(content: Path, listing: Listing, repository: Repository) -> None:
    """Check what was sent, and complete it; files that are damaged go, so that the next pull fetches them anew."""
    wrong = [name for name, digest in listing.sha256.items() if sha256(content / name) != digest]
    for name in wrong:
        (content / name).unlink()
    if wrong:
        raise UserError(f"{repository}: {wrong[0]} has a wrong SHA-256 and was removed; pull again, or ask its owner")
    for path in list(content.iterdir()):
        if path.name not in listing.sha256:  # of huggingface_hub, or of a cut pull of another repository
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    _check(content, listing.kind)
    if listing.kind == ENCODER:
        write_bytes(content / CARD, model_card(read_record(content)).encode())


@contextmanager
def _answers(repository: Repository, revision: str) -> Iterator[None]:
    """Turn what the Hub refuses, and its absence, into one sentence."""
    try:
        yield
    except UserError:
        raise
    except GatedRepoError as error:
        raise UserError(f"{repository}: is open to those whom its owner lets in; ask there for access") from error
    except RepositoryNotFoundError as error:
        raise UserError(
            f"{repository}: no such repository, or your token gives no access; check the name, and HF_TOKEN or "
            "`hf auth login`"
        ) from error
    except RevisionNotFoundError as error:
        raise UserError(f"{repository}: has no revision {revision!r}; check --revision") from error
    except OfflineModeIsEnabled as error:
        raise UserError("HF_HUB_OFFLINE is set, so that nothing is sent or fetched; unset it") from error
    except HfHubHTTPError as error:
        raise UserError(f"{repository}: {_refusal(error)}") from error
    except (HTTPError, LocalEntryNotFoundError, FileMetadataError) as error:
        raise UserError(
            f"{repository}: {default_endpoint()} does not answer as the Hub does ({type(error).__name__}); check the "
            "network and HF_ENDPOINT, and start the same command again: it goes on where it stopped"
        ) from error
    except (RuntimeError, ValueError) as error:  # of an upload's parts, and of a card that the Hub refuses
        raise UserError(f"{repository}: {_refusal(error)}") from error


def _refusal(error: Exception) -> str:
    """What the Hub, or huggingface_hub in its place, says against something."""
    if isinstance(error, RuntimeError) and isinstance(error.__cause__, HfHubHTTPError):
        error = error.__cause__
    if not isinstance(error, HfHubHTTPError):
        return f"the Hub does not take it ({' '.join(str(error).split())})"
    status = error.response.status_code
    if status in (401, 403):
        return f"your token may not do this (status {status}); check HF_TOKEN or `hf auth login`, and its permissions"
    told = f", {error.server_message}" if error.server_message else ""
    return f"the Hub answers with status {status}{told}; try again later"
