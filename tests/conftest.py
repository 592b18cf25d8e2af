"""Global settings of the test session.

Each process uses one thread, since tests run in several processes on small tensors. JAX compiles without most
optimisations, because tests compile much and run little. SIGINT gets its default handler, which background jobs of a
shell ignore. Submitit is imported before any test captures stderr: its logging setup closes the stream of absl's
handler unless that is stderr.

GPUs are hidden unless `-m gpu` selects the tests that need one. Tracebacks of crashed processes are printed at the end.
"""

import faulthandler
import os
import shutil
import signal
from contextlib import suppress
from pathlib import Path

import pytest
import sklearn.cluster  # noqa: F401  imported once, and not by a subprocess for each codebook
import torch

from tests.helpers_data import write_fake_set

with suppress(ImportError):
    import submitit  # noqa: F401

os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")
torch.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)

CRASHES = Path(__file__).parents[1] / ".pytest_cache" / "crashes"
"""A file for each process of the tests, empty unless it crashed."""


def pytest_configure(config):
    """Tests need bit-exact results, which a GPU does not give."""
    if config.option.markexpr != "gpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="needs a GPU, and -m gpu"))


def pytest_sessionstart(session):
    if not hasattr(session.config, "workerinput"):
        shutil.rmtree(CRASHES, ignore_errors=True)
        CRASHES.mkdir(parents=True)
    faulthandler.enable((CRASHES / str(os.getpid())).open("w"))


def pytest_terminal_summary(terminalreporter):
    for crash in CRASHES.iterdir():
        if text := crash.read_text():
            terminalreporter.section(f"process {crash.name} crashed")
            terminalreporter.write(text)


@pytest.fixture(autouse=True, scope="session")
def _cache_and_command(tmp_path_factory):
    """Decode sets into a cache of this session, and record no path of pytest as the command of runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VD4RL_POMDP_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setattr("sys.argv", ["vd4rl-pomdp", "test"])
        yield


@pytest.fixture
def compiled_anew(monkeypatch):
    """Compile all functions again, so that a test on a GPU reaches compiled code. By default, a function that was
    compiled for eight kinds of arguments silently runs eagerly for others."""
    torch.compiler.reset()
    monkeypatch.setattr("torch._dynamo.config.fail_on_recompile_limit_hit", True)


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """A small expert set of walker_walk, shared by all tests."""
    return write_fake_set(tmp_path_factory.mktemp("set") / "walker_walk" / "expert", [20, 25, 30])


@pytest.fixture(scope="session")
def encoder(data, tmp_path_factory) -> Path:
    """Folder of an encoder pretrained on `data`, shared by all tests."""
    from pretrain.train import pretrain
    from tests.helpers_stages import smoke_pretrain  # imported late: most tests train nothing

    return pretrain(smoke_pretrain(data, tmp_path_factory.mktemp("pretrained") / "run")).path / "encoder"
