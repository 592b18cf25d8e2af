"""The examples of the documentation's pages on plug-ins, as scripts and modules."""

import importlib.util
import re
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import finetune.algorithms  # noqa: F401 (a kind's registry is made where its parts are)
import pretrain.objectives  # noqa: F401
from vd4rl_pomdp.agents import checksums
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.nn.encoder import EncoderCard

DOCS = Path(__file__).parents[1] / "docs"
PAGES = {f"my_{page.stem.split('_', 2)[2]}.py": page for page in sorted(DOCS.glob("add_a*.md"))}
"""File name and page; the file is the page's first block."""


def write_example(file: str, folder: Path) -> Path:
    """Write a page's example into a folder."""
    script = folder / file
    script.write_text(re.findall(r"```python\n(.*?)```", PAGES[file].read_text(), re.DOTALL)[0])
    return script


def load_example(file: str, folder: Path, patch: pytest.MonkeyPatch) -> ModuleType:
    """Import a page's example, which registers its plug-ins; help texts are read from its source."""
    name = file.removesuffix(".py")
    spec = importlib.util.spec_from_file_location(name, write_example(file, folder))
    module = importlib.util.module_from_spec(spec)
    patch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@contextmanager
def isolated_registries() -> Iterator[None]:
    """Plug-ins registered within the block are removed afterwards."""
    with ExitStack() as stack:
        for registry in REGISTRIES.values():
            stack.enter_context(registry.isolated())
        yield


def agent_card(encoder: EncoderCard, folder: Path) -> dict[str, Any]:
    """A card of the agent in a folder, without episodes."""
    card = {name: getattr(encoder, name) for name in ("task", "quality", "method", "corruption", "data")}
    card |= {"algorithm": "td3_bc", "seed": 0, "length": 20, "budget": {"pretraining": {"seed": encoder.seed}}}
    return card | {"sha256": checksums(folder)}
