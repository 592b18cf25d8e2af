"""Code blocks of the README and docs/: Python is executed; commands are run if that takes seconds. All are parsed, also
those in results/."""

import functools
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tyro

from finetune.algorithms import ALGORITHMS
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import write_fake_set
from tests.helpers_pages import PAGES as EXAMPLES
from tests.helpers_pages import agent_card, isolated_registries, load_example
from vd4rl_pomdp.agents import write_rounded
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.core.tasks import SET_QUALITIES, TASKS
from vd4rl_pomdp.corruptions import make_corruption
from vd4rl_pomdp.data.formats import FORMATS
from vd4rl_pomdp.envs.mazes import get_maze
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.stages import check_cells

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RESULTS = sorted((ROOT / "results").rglob("*.md"))
PROGRAMS = (["vd4rl-pomdp"], *(["python", file] for file in EXAMPLES))
"""First words of this project's commands."""
RUN = (
    "vd4rl-pomdp data check",
    "vd4rl-pomdp pretrain",
    "vd4rl-pomdp finetune",
    "vd4rl-pomdp report",
    "vd4rl-pomdp sweep run paper",
)


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[str]:
    """Lines of a page's shell blocks, with continuations joined and comments removed."""
    lines = "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    return [" ".join(re.sub(r"(^|\s)#.*", "", line).split()) for line in lines if line.strip()]


COMMANDS = [(page, line) for page in PAGES for line in commands(page)]


def is_run(page: Path, line: str) -> bool:
    return page.name == "README.md" and line.startswith(RUN) and "--data data/vd4rl" not in line


class ParsedError(Exception):
    """Ends a command after parsing."""


@pytest.fixture(autouse=True)
def _registries():
    with isolated_registries():
        yield


def test_code_blocks_have_a_tested_language():
    fences = [(page.name, tag) for page in PAGES for tag in re.findall(r"^```(\w*)$", page.read_text(), re.MULTILINE)]
    assert {tag for _, tag in fences} <= {"python", "bash", "toml", ""}
    closing = sum(tag == "" for _, tag in fences)
    assert closing == len(fences) - closing, "a block without a language"


OURS = [
    (page, line)
    for page, line in [*COMMANDS, *((page, line) for page in RESULTS for line in commands(page))]
    if line.split()[:1] in PROGRAMS or line.split()[:2] in PROGRAMS
]


@pytest.mark.parametrize(("page", "line"), OURS, ids=[f"{page.parent.name}/{page.stem}: {line}" for page, line in OURS])
def test_documented_commands_parse(page, line, tmp_path, monkeypatch):
    parsed = []
    real = tyro.cli

    def parse_alone(*arguments, **options):
        parsed.append(real(*arguments, **options))
        raise ParsedError

    monkeypatch.setattr(tyro, "cli", parse_alone)
    words = shlex.split(re.split(r" [>|] ", line)[0].replace("[SET]", "SET"))
    if words[1] in EXAMPLES:
        load_example(words[1], tmp_path, monkeypatch)
    with pytest.raises(ParsedError):
        main(words[1:] if words[0] == "vd4rl-pomdp" else words[2:])
    check_names(parsed[0])


CHECKS = {
    "method": METHODS.named,
    "methods": METHODS.named,
    "corruption": make_corruption,
    "corruptions": make_corruption,
    "algorithm": ALGORITHMS.named,
    "algorithms": ALGORITHMS.named,
    "task": TASKS.named,
    "tasks": TASKS.named,
    "maze": get_maze,
    "mazes": get_maze,
    "quality": SET_QUALITIES.index,
}


def check_names(config: object) -> None:
    """Names that a command looks up after parsing must exist."""
    if type(config).__name__ == "NavigationConfig":  # it has additional methods
        return
    values = config.keywords if isinstance(config, functools.partial) else vars(config)
    for field, check in CHECKS.items():
        value = values.get(field)
        for name in value if isinstance(value, list | tuple) else [value]:
            if name:
                check(name)


@pytest.fixture
def study(tmp_path, monkeypatch) -> Path:
    """A working folder with the datasets that pages use; `encoder` adds a pretrained encoder."""
    monkeypatch.chdir(tmp_path)
    for quality in ("expert", "expert_noisy"):
        write_fake_set(tmp_path / "data" / "walker_walk" / quality, [40, 40, 40])
    return tmp_path


@pytest.fixture
def encoder(study) -> None:
    data, out = Path("data/walker_walk/expert"), Path("runs/mik+a/pretrain")
    run_pretrain(PretrainConfig.of("smoke", data=data, out=out, method="mik+a", corruption="patch+zero_frames"))


def small(words: list[str]) -> list[str]:
    """The command at its smallest size."""
    return [{"cpu": "smoke", "paper": "smoke", "20000": "20", "20": "1"}.get(word, word) for word in words]


def test_readme_commands_run(study, capsys):
    lines = [line for page, line in COMMANDS if is_run(page, line)]
    assert {" ".join(line.split()[:2]) for line in lines} >= {"vd4rl-pomdp pretrain", "vd4rl-pomdp sweep"}
    for line in lines:
        main(small(shlex.split(line.partition(" > ")[0])[1:]))
    assert (study / "report" / "index.html").exists()
    assert "# 1449 jobs, 0 done" in capsys.readouterr().out, "the sweeps' plans"


PYTHON = [page for page in PAGES if blocks(page, "python")]


@pytest.mark.parametrize("page", PYTHON, ids=lambda page: page.stem)
def test_python_blocks_run(page, encoder):
    namespace = {"__name__": page.stem}
    if page.stem == "use_an_encoder":
        write_agent(Path("runs/mik+a/pretrain"), Path("agents/mik-walker"))
    if page.stem == "reports":
        Path("results").symlink_to(ROOT / "results")  # the repository's rows
    for number, code in enumerate(blocks(page, "python")):
        exec(compile(code, f"{page.name}, block {number}", "exec"), namespace)
    check_results(page.stem, namespace)


def test_notebook_runs_and_has_no_outputs(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.mkdtemp", lambda: str(tmp_path / "study"))
    cells = json.loads((ROOT / "docs/notebooks/tour.ipynb").read_text())["cells"]
    namespace = {"__name__": "tour"}
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            exec(compile("".join(cell["source"]), f"tour.ipynb, cell {number}", "exec"), namespace)
    assert namespace["z"].shape == (5 * 31, namespace["encoder"].dim)
    shown = [panel.get_images()[0].get_array() for panel in namespace["panels"].flat]
    assert any((clean != seen).any() for clean, seen in zip(shown[:3], shown[3:6], strict=True))
    assert (tmp_path / "study/report/index.html").exists()


def write_agent(run: Path, folder: Path) -> None:
    """Write an exported agent with an untrained policy."""
    encoder, card = load_encoder(run / "encoder")
    Policy(encoder.dim, 6, 8).save(run / "policy")
    write_rounded(run, folder)
    write_json(folder / "card.json", agent_card(card, folder))


def check_results(page: str, names: dict) -> None:
    """Check the results that a page's comments state."""
    if page == "use_an_encoder":
        assert (names["card"].method, names["card"].corruption["corruption"]) == ("mik+a", "patch+zero_frames")
        assert names["windows"].obs.shape == (2, 16, 9, 84, 84)
        assert names["z"].shape == (1, names["encoder"].dim)
        assert names["agent"].card["method"] == "mik+a"
        assert names["truncated"]
    elif page == "add_a_task":
        assert names["obs"].shape == (9, 64, 64)
        assert not names["truncated"]
    elif page in ("README", "add_a_corruption"):
        obs, info = names["env"].reset(seed=0)
        frames, clean = (pixels.reshape(3, 3, 84, 84) for pixels in (obs, info["clean"]))
        shown = [i for i in range(3) if frames[i].any()]
        assert len(shown) == 2
        rows = 16 if page == "README" else 24
        assert all((frames[i] != clean[i]).any((0, 2)).sum() == rows for i in shown), "number of black rows"


def test_toml_blocks_name_entry_point_groups():
    pages = [page for page in PAGES if page.name not in ("README.md", "sweeps.md")]  # these contain grids
    assert FORMATS in REGISTRIES.values()
    found = [tomllib.loads(code)["project"]["entry-points"] for page in pages for code in blocks(page, "toml")]
    assert sorted(group for groups in found for group in groups) == sorted(
        registry.group for registry in REGISTRIES.values()
    )


def test_readme_grid_is_valid(tmp_path):
    (block,) = blocks(ROOT / "README.md", "toml")
    (tmp_path / "grid.toml").write_text(block)
    cells = load_grid(str(tmp_path / "grid.toml")).cells()
    assert len(cells) == 5 * 4
    check_cells(cells, "README's")


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 950


LINK = re.compile(r"\]\(([^)\s]+)\)")
TEXTS = [*PAGES, *sorted((ROOT / "results").rglob("*.md")), ROOT / "CHANGELOG.md"]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as on GitHub and the site."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_relative_links_exist(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    targets = [target for target in LINK.findall(text) if not target.startswith(("http:", "https:"))]
    broken = []
    for target in targets:
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if file.is_dir() and anchor:
            file = file / "README.md"
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


def test_site_builds_without_warnings(tmp_path):
    pytest.importorskip("mkdocs", reason="mkdocs is not installed")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
