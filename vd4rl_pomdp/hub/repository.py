"""Repositories of the Hugging Face Hub: their names, what the Hub says of them, and what it refuses in one sentence."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from huggingface_hub import HfApi, get_session
from huggingface_hub.errors import (
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
from vd4rl_pomdp.core.errors import UserError, in_one_line
from vd4rl_pomdp.data.download import check_endpoint, default_endpoint

ENCODER, SET = "an encoder", "a data set"
"""What a repository holds, in the words of `runs.outputs.kept_in`."""
_TIMEOUT_S, _SILENCE_S = 30.0, 60.0
"""How long the Hub's first answer may take, and how long it may be silent at whatever is asked of it then."""


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


def hub_api() -> HfApi:
    """Client of the endpoint in the environment; raises UserError if that is no address."""
    endpoint = default_endpoint()
    check_endpoint(endpoint, "HF_ENDPOINT")
    if not sys.stderr.isatty():
        disable_progress_bars()
    get_session().timeout = _SILENCE_S  # it has none of its own
    return HfApi(endpoint=endpoint, library_name="vd4rl-pomdp", library_version=__version__)


def hub_info(api: HfApi, repository: Repository, revision: str | None = None) -> ModelInfo | DatasetInfo:
    """What the Hub says of a repository at a branch, tag or commit; raises huggingface_hub's errors."""
    info = api.repo_info(repository.name, repo_type=repository.type, revision=revision, timeout=_TIMEOUT_S)
    assert isinstance(info, ModelInfo | DatasetInfo)
    return info


def provide(api: HfApi, repository: Repository, private: bool) -> ModelInfo | DatasetInfo:
    """What the Hub says of a repository, which is made if there is none."""
    try:
        info = hub_info(api, repository)
    except GatedRepoError:
        raise
    except RepositoryNotFoundError:
        api.create_repo(repository.name, repo_type=repository.type, private=private or None, exist_ok=True)
        info = hub_info(api, repository)
    if private and not info.private:
        raise UserError(f"{repository}: is public already; leave --private out, or choose another name")
    return info


@contextmanager
def hub_answers(repository: Repository, revision: str) -> Iterator[None]:
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
            "network and HF_ENDPOINT, and re-run the same command to resume"
        ) from error
    except (RuntimeError, ValueError) as error:  # of an upload's parts, and of a card that the Hub refuses
        raise UserError(f"{repository}: {_refusal(error)}") from error


def _refusal(error: Exception) -> str:
    """What the Hub, or huggingface_hub in its place, says against something."""
    if isinstance(error, RuntimeError) and isinstance(error.__cause__, HfHubHTTPError):
        error = error.__cause__
    if not isinstance(error, HfHubHTTPError):
        return f"the Hub does not take it ({in_one_line(error)})"
    status = error.response.status_code
    if status in (401, 403):
        return f"your token may not do this (status {status}); check HF_TOKEN or `hf auth login`, and its permissions"
    told = f", {error.server_message}" if error.server_message else ""
    return f"the Hub answers with status {status}{told}; try again later"
