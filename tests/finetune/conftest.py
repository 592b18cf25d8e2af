"""One finished run shared by all fine-tuning tests; tests that change a run copy it."""

import shutil
from pathlib import Path

import pytest

BRIEF = {"updates": 2, "batch_size": 4, "eval_length": 2}


@pytest.fixture(scope="session")
def finished(data, encoder, tmp_path_factory) -> Path:
    """A fine-tuning run on `encoder` and `data`."""
    from finetune.train import finetune
    from tests.helpers_stages import smoke_finetune  # imported late: some tests train nothing

    return finetune(smoke_finetune(encoder, data, tmp_path_factory.mktemp("finished") / "run", **BRIEF)).path


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """Copy of the finished run."""
    return shutil.copytree(finished, tmp_path / "run")
