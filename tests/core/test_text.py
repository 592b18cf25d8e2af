import io
import re

import pytest
from matplotlib import cbook
from matplotlib.figure import Figure

from vd4rl_pomdp.core.text import code, code_block, markdown, plain, write_text

HOSTILE = [
    "$\\frac$",
    "$",
    "a|b",
    "<img src=x>",
    "`x`",
    "_hidden",
    "**bold**",
    "[link](x)",
    "two\nlines",
    "a\\$b",
    "\x00",
]


@pytest.mark.parametrize("name", HOSTILE)
def test_markdown_is_escaped(name):
    for shown in (markdown(name), code(name)):
        assert len(shown.splitlines()) == 1
        assert not re.search(r"(?<!\\)\|", shown)
    assert not re.search(r"[<>$`]|(?<!\\)[*\[]", markdown(name))
    fence = re.match(r"`+", code(name)).group()
    assert code(name).endswith(fence)
    assert fence not in code(name)[len(fence) : -len(fence)]


def test_ordinary_names_are_unchanged():
    for name in ("walker_walk", "mik+a", "llvmpipe (LLVM 19.1.7, 256 bits)", "torch 2.5.1+cpu, h5py 3.12", "f00ba4"):
        assert markdown(name) == plain(name) == name
    assert code("vd4rl-pomdp data collect") == "`vd4rl-pomdp data collect`"


def test_code_block_fence_is_longer_than_its_content():
    lines = code_block(["x ```", "a\nb"], "bash")
    assert lines == ["````bash", "x ```", "a b", "````"]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", HOSTILE)
def test_figure_text_is_escaped(name):
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0], [0], label=plain(name, 30))
    axes.set_title(plain(name))
    legend = axes.legend()
    figure.savefig(io.BytesIO(), format="svg")
    assert len(legend.get_texts()) == 1
    assert not cbook.is_math_text(plain(name))


def test_long_names_are_wrapped():
    assert max(map(len, plain("acro, patch_size 48, max_k 15, steps 60000", 20).splitlines())) <= 20
    assert max(map(len, plain("x" * 100, 20).splitlines())) <= 20


def test_surrogates_are_written_as_escapes(tmp_path):
    write_text(tmp_path / "page", "μ \udcff")
    assert (tmp_path / "page").read_bytes().decode() == "μ \\udcff"
