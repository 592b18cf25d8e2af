"""One dataset, encoder and finished run shared by all fine-tuning tests; tests that change a run copy it."""

import shutil
from pathlib import Path

import pytest

from tests.helpers_data import write_fake_set

BRIEF = {"updates": 2, "batch_size": 4, "eval_length": 2}


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """Folder with a dataset, an encoder pretrained on it, and a fine-tuning run."""
    from finetune.train import finetune
    from pretrain.train import pretrain
    from tests.helpers_stages import smoke_finetune, smoke_pretrain  # imported late: some tests train nothing

    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VD4RL_POMDP_CACHE", str(folder / "cache"))
        patch.setattr("sys.argv", ["vd4rl-pomdp", "test"])
        data = write_fake_set(folder / "walker_walk" / "expert", [20, 25, 30])
        encoder = pretrain(smoke_pretrain(data, folder / "pretrained")).path / "encoder"
        finetune(smoke_finetune(encoder, data, folder / "run", **BRIEF))
    return folder


@pytest.fixture
def data(trained) -> Path:
    """A small expert set of walker_walk."""
    return trained / "walker_walk" / "expert"


@pytest.fixture
def encoder(trained, own_cache) -> Path:
    """Folder of an encoder that was pretrained on `data`."""
    return trained / "pretrained" / "encoder"


@pytest.fixture
def run(trained, own_cache, tmp_path) -> Path:
    """Copy of a finished run on `encoder` and `data`."""
    return shutil.copytree(trained / "run", tmp_path / "run")
