"""Grids: axes, blocks, where tables, the testing subset, changes, and invalid input."""

import re
from pathlib import Path

import pytest

from tests.helpers_bad_input import rejection
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.mazes import PAPER_MAZES
from vd4rl_pomdp.studies.navigation.runs import condition_of, paper_rows
from vd4rl_pomdp.sweeps.grid import load_grid, names, narrow
from vd4rl_pomdp.sweeps.stages import check_cells, collection_of, recipe_of, recorded

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "sweeps.md"
COMMITTED = [str(path) for path in sorted((ROOT / "results").rglob("*.toml")) if "[testing]" in path.read_text()]
"""Grids of committed results that have a testing section."""
TOML = """
title = "a trial"
seed = [0, 1]
[collect]
task = ["walker_walk", "cheetah_run"]
quality = "expert"
[pretrain]
method = ["mik+a", "acro"]
corruption = "patch"
[finetune]
updates = 40
"""
BLOCKS = """
[[block]]
[[block]]
pretrain = { method = "acro", history = "gru" }
[testing]
seed = 7
preset = "smoke"
collect = { task = "walker_walk" }
"""


@pytest.fixture
def file(tmp_path):
    def write(text, name="mine.toml"):
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write


def test_grid_axes_blocks_and_seed_order(file):
    cells = load_grid(file(TOML + BLOCKS)).cells()
    assert len(cells) == 2 * 2 * 2 + 4
    assert [cell.seed for cell in cells] == [0] * 6 + [1] * 6
    assert cells[0].sections["collect"] == {"task": "walker_walk", "quality": "expert"}
    assert cells[0].chain == ("collect", "pretrain", "finetune")
    own = [cell for cell in cells if cell.value("history") == "gru"]
    assert {(cell.value("method"), cell.value("corruption")) for cell in own} == {("acro", "patch")}
    same = '[[block]]\n[[block]]\npretrain = { method = "acro" }\n'
    assert len(load_grid(file(TOML + same)).cells()) == 8, "duplicate cells are merged"


def test_testing_section_and_changes_override_settings(file):
    path = file(TOML + BLOCKS)
    cells = load_grid(path, testing=True).cells()
    assert {(cell.seed, cell.value("task"), cell.value("preset")) for cell in cells} == {(7, "walker_walk", "smoke")}
    assert len(cells) == 3
    changes = ["seed = 3, 4", "pretrain.steps=10", "finetune.learning_rate=1e-3", "pretrain.method = mik"]
    cells = load_grid(path, changes, testing=True).cells()
    assert {cell.seed for cell in cells} == {3, 4}
    assert {(cell.value("steps"), cell.value("learning_rate"), cell.value("method")) for cell in cells} == {
        (10, 1e-3, "mik")
    }
    with pytest.raises(UserError, match="seed is changed twice; for several values write them as in seed=0,1"):
        load_grid(path, ["seed=3", "pretrain.steps=10", "seed = 4"])


@pytest.mark.parametrize("testing", [False, True])
def test_overrides_apply_only_to_blocks_with_their_section(file, testing):
    encoders = TOML.partition("[finetune]")[0]
    blocks = '[[block]]\n[[block]]\npretrain = { history = "gru" }\nfinetune = { updates = 40 }\n'
    own, changes = ("[testing]\nfinetune = { updates = 7 }\n", []) if testing else ("", ["finetune.updates=7"])
    cells = load_grid(file(encoders + blocks + own), changes, testing).cells()
    assert {(cell.value("history"), cell.chain[1:], cell.value("updates")) for cell in cells} == {
        (None, ("pretrain",), None), ("gru", ("pretrain", "finetune"), 7),
    }  # fmt: skip
    with pytest.raises(UserError, match="no block has a section finetune"):
        load_grid(file(encoders + own), changes, testing)


def test_testing_needs_a_testing_section(file):
    assert rejection(["sweep", "run", path := file(TOML), "--testing", "--out", "out", "--dry-run"]) == (
        f"error: {path}: has no [testing] section: add one, or leave out --testing"
    )


def test_python_grid_file(file):
    python = "GRID = {'seed': [s for s in range(3)], 'collect': {'task': 'walker_walk', 'quality': 'expert'}}"
    grid = load_grid(file(python, "mine.py"))
    assert (grid.name, [cell.seed for cell in grid.cells()]) == ("mine", [0, 1, 2])


def test_only_filters_cells_by_value(file):
    cells = load_grid(file(TOML)).cells()
    kept = narrow(cells, ["task=walker_walk", "method = acro, mik+a", "seed=1"])
    assert [(cell.value("task"), cell.seed) for cell in kept] == [("walker_walk", 1)] * 2
    for only in ("method", "method=curl", "colour=red"):
        with pytest.raises(UserError, match=f"'{only}'"):
            narrow(cells, [only])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seeds = 3", "unknown section or setting 'seeds'"),
        ("pretrain = 3", "pretrain is not a table"),
        ("seed = 0", "a block needs sections of"),
        ("[pretrain]\n[navigation_train]", "a block needs sections of"),
        ("[collect]\n[finetune]", "finetune needs pretrain"),
        ('[collect]\n[pretrain]\ndata = "mine"', "pretrain.data: sweeps name their folders"),
        ('[collect]\nout = "mine"', "collect.out: sweeps name their folders"),
        ("[collect]\n[pretrain]\nseed = 3", "pretrain.seed: a cell's trainings share one seed"),
        ("seed = true\n[collect]", "seed is True: write a number, or a list of such"),
        ("seed = [0, false]\n[collect]", r"seed is \[0, False\]: write a number"),
        ("[collect]\nseed = true", r"collect\.seed is True: write a number"),
        ("[collect]\n[pretrain]\nhelp = true", r"pretrain\.help: is not a stage setting"),
        (
            "[collect]\n[pretrain]\nmax-k = 3",
            r"pretrain\.max-k: is not a stage setting; names have underscores, as in max_k",
        ),
        ("[collect]\n[pretrain]\nlog_every = [10, 20]", r"pretrain\.log_every: does not change results"),
        ("[pretrain]\nmethod = 'acro'", "a block has no dataset: add a section collect"),
        ("[collect]\n[pretrain]\nmethod = []", r"pretrain\.method is \[\]"),
        ("[collect]\n[pretrain]\nmethod = [[1]]", r"pretrain\.method is \[\[1\]\]"),
        ("block = 3", "its blocks are not a list of tables"),
        ("where = 3", "its wheres are not a list of tables"),
        ("title = ", r"is not a valid grid \(TOMLDecodeError"),
    ],
)
def test_invalid_grids_are_rejected(file, text, message):
    with pytest.raises(UserError, match=message):
        load_grid(file(text)).cells()


def test_ambiguous_setting_names_need_their_section(file):
    rates = "learning_rate = 0.001\n[finetune]\nlearning_rate = [0.001, 0.01]"
    path = file(f"[collect]\n[pretrain]\n{rates}\n[[where]]\nonly = ['finetune.learning_rate=0.01']\npreset = 'cpu'")
    cells = load_grid(path).cells()
    for rate, preset in (("0.001", None), ("0.01", "cpu")):
        (kept,) = narrow(cells, [f"finetune.learning_rate={rate}"])
        assert (kept.value("finetune.learning_rate"), kept.value("preset")) == (float(rate), preset)
    with pytest.raises(UserError, match=r"'learning_rate' means pretrain\.learning_rate and finetune\.learning_rate"):
        narrow(cells, ["learning_rate=0.001"])
    with pytest.raises(UserError, match="sets nothing of that name"):
        narrow(cells, ["collect.learning_rate=0.001"])


@pytest.mark.parametrize(
    "text",
    [
        "raise SystemExit(3)",
        "GRID = {'collect': {}, 'pretrain': {3: 4}}",
        "x = 3",
        "GRID = 3",
        "import nothing_at_all",
        "raise SystemError('no')",
    ],
)
def test_invalid_python_grids_are_rejected(file, text):
    with pytest.raises(UserError, match=r"mine\.py"):
        load_grid(file(text, "mine.py"))


WHERE = """
[[where]]
only = ["task=cheetah_run", "method=acro"]
preset = "smoke"
finetune = { updates = 80 }
"""


def test_where_applies_to_matching_cells_before_changes(file):
    path = file(TOML + WHERE + '[testing]\npreset = "cpu"\n')
    cells = load_grid(path).cells()
    assert len(cells) == 8
    for cell in cells:
        meets = (cell.value("task"), cell.value("method")) == ("cheetah_run", "acro")
        assert (cell.value("updates"), cell.value("preset")) == ((80, "smoke") if meets else (40, None))
    cells = load_grid(path, ["finetune.updates=20", "seed=0,1"], testing=True).cells()
    assert {(cell.value("updates"), cell.value("preset")) for cell in cells} == {(20, "cpu")}
    assert len(cells) == 8


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("finetune = { updates = 80 }", "has no conditions"),
        ('only = ["task"]', "'task' is not a condition"),
        ('only = ["task=humanoid_walk"]', "no cell has 'task=humanoid_walk': the grid has walker_walk, cheetah_run"),
        ('only = ["colour=red"]', "sets nothing of that name"),
        (
            'only = ["task=cheetah_run"]\nfinetune = { updates = [1, 2] }',
            r"finetune\.updates is \[1, 2\]: write a number",
        ),
        ('only = ["task=cheetah_run"]\nnavigation_train = { steps = 2 }', "not every block has"),
        ('only = ["task=cheetah_run"]\ntitle = "x"', "unknown section or setting 'title'"),
    ],
)
def test_invalid_where_tables_are_rejected(file, table, message):
    with pytest.raises(UserError, match=message):
        load_grid(file(f"{TOML}[[where]]\n{table}\n"))


def test_conditions_compare_numbers_by_value(file):
    text = TOML.replace("updates = 40", "learning_rate = [1e-3, 0.0001]\neval_clean = true")
    cells = load_grid(file(text)).cells()
    for only in ("finetune.learning_rate=1e-3", "finetune.learning_rate=0.001", "eval_clean=true"):
        assert len(narrow(cells, [only])) == len(cells) / (1 if "clean" in only else 2)
    where = '[[where]]\nonly = ["finetune.learning_rate=0.1e-2"]\nfinetune = { updates = 7 }\n'
    assert [cell.value("updates") for cell in load_grid(file(text + where)).cells()].count(7) == len(cells) / 2


@pytest.mark.parametrize("testing", [False, True])
@pytest.mark.parametrize("name", [*names(), *COMMITTED])
def test_cells_of_shipped_and_committed_grids_are_valid(name, testing):
    cells = load_grid(name, testing=testing).cells()
    assert len(cells) == len({repr((cell.shared, cell.sections)) for cell in cells}) > 0
    check_cells(cells, name)
    if testing:
        assert len(cells) <= 33
        assert {cell.value("preset") for cell in cells} == {"smoke"}


def test_paper_grids_cover_the_papers_figures():
    for name, corruption in (("paper_patch", "patch"), ("paper_patch_zero", "patch+zero_frames")):
        cells = [c for c in load_grid(name).cells() if c.value("corruption") == corruption]
        found = {(c.value("task"), c.value("quality"), c.value("method"), c.seed) for c in cells}
        assert len(found) == len(cells) == 3 * 3 * 14 * 5, "12 methods, random and supervised+a"


def test_navigation_budget_grid_differs_only_in_steps():
    cells = load_grid(str(ROOT / "results" / "navigation" / "budget" / "grid.toml")).cells()
    kept = {repr(recorded(cell, "navigation_train") | {"steps": 2500}) for cell in cells}
    usual = {repr(recorded(cell, "navigation_train")) for cell in load_grid("navigation").cells()}
    assert kept <= usual, "equal to the published cells except for steps"
    assert [cell.seed for cell in cells] == [0] * 5 + [1] * 5 + [2] * 5
    methods = {(cell.value("method"), cell.value("max_k")) for cell in cells}
    assert methods == {("ah+a", 15), ("ah+a", 1), ("mik+a", 15), ("mik+a", 1), ("ah", 15)}


def test_lead_grid_shares_its_short_pretrainings_with_the_protocol():
    def made(name, *only):
        cells = narrow(load_grid(str(ROOT / "results" / name)).cells(), only)
        return {(recipe_of(cell, "finetune"), repr(sorted(collection_of(cell).items()))) for cell in cells}

    both = ["method=mik+a,acro", "quality=medium_expert", "corruption=patch+zero_frames"]
    assert made("lead/grid.toml", "steps=3000") == made("protocol.toml", *both)
    assert len(made("lead/grid.toml", "steps=20000")) == 2 * 3 * 5


def test_memories_grid_shares_its_gru_runs_with_the_protocol():
    cells = load_grid(str(ROOT / "results" / "memories" / "grid.toml")).cells()
    protocol = {recipe_of(cell, "finetune") for cell in load_grid(str(ROOT / "results" / "protocol.toml")).cells()}
    assert [cell.value("history") for cell in cells] == [None, "transformer", "lru"] * 3
    for gru, *others in zip(cells[::3], cells[1::3], cells[2::3], strict=True):
        assert recipe_of(gru, "finetune") in protocol
        assert all(collection_of(other) == collection_of(gru) for other in others), "the same dataset"


def test_vd4rl_grid_is_a_subset_of_the_protocol():
    cells, protocol = load_grid("vd4rl").cells(), load_grid(str(ROOT / "results" / "protocol.toml")).cells()
    assert not {cell.value("method") for cell in cells} & {"state", "supervised", "supervised+a"}
    assert {cell.seed for cell in cells} == set(range(5))
    assert len({repr(collection_of(cell)) for cell in cells}) == 4, "two tasks, two qualities; seeds share datasets"
    first, theirs = ({recipe_of(c, "finetune") for c in narrow(grid, ["seed=0"])} for grid in (cells, protocol))
    assert first < theirs


def test_navigation_grid_covers_the_papers_tables():
    cells = load_grid("navigation").cells()
    held = {
        (
            cell.value("maze"),
            cell.value("method"),
            cell.value("max_k"),
            cell.value("self_prediction") == 1.0,
            cell.value("exogenous") == "textures",
        )
        for cell in cells
        if not cell.value("literal_future")
    }
    wanted = [condition_of(row, maze) for row in paper_rows() for maze in PAPER_MAZES]
    missing = [c for c in wanted if (c.maze, c.method, c.max_k, c.self_prediction, c.exogenous) not in held]
    assert missing == []


def test_documented_grid_is_valid(file):
    block, _ = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    cells = load_grid(file(block)).cells()
    assert len(cells) == 3 * 2 * 2 * 2 + 3 * 2 * 2
    check_cells([*cells, *load_grid(file(block), testing=True).cells()], "the page's")


SET = '[collect]\ntask = "walker_walk"\nquality = "expert"\n[pretrain]\n'


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ('[collect]\ntask = "walker_walk"', "mine.toml: collect: .*--quality"),
        ('[collect]\ntask = "walker_walk"\nquality = "expert"\nepisode = 3', "mine.toml: collect: .*--episode"),
        ('[navigation_collect]\nmaze = "no_curtain"\npreset = "huge"', "navigation_collect: unknown preset 'huge'"),
        (SET + 'method = "acor"', "mine.toml: pretrain: unknown method 'acor'"),
        (SET + 'steps = "many"', "mine.toml: pretrain: .*--steps.*many"),
    ],
)
def test_invalid_settings_name_their_section(file, section, message):
    path = file(section)
    with pytest.raises(UserError, match=message):
        check_cells(load_grid(path).cells(), "mine.toml")


def test_protocol_page_matches_its_grid():
    """The page's commands train every policy once, with one dataset per seed; its table counts them."""
    page = (ROOT / "results" / "protocol.md").read_text()
    cells = load_grid(str(ROOT / "results" / "protocol.toml")).cells()
    commands = re.findall(r"--only (.*(?:\n    .*)?)", page)
    layers = [narrow(cells, only.replace("\\", " ").split()) for only in commands]
    counted = [int(count) for count in re.findall(r"^\|.*\| (\d+) \|$", page, re.MULTILINE)]
    assert [len(layer) for layer in layers] == [56, 56, *(sum(counted[i:j]) for i, j in ((3, 5), (5, 6), (6, 8)))]
    assert sum(map(len, layers)) == len(cells) == sum(counted)
    assert len({id(cell) for layer in layers for cell in layer}) == len(cells)
    for cell in cells:
        collected, policy = collection_of(cell), recorded(cell, "finetune")
        assert (collected["seed"], collected["episodes"]) == (100 + cell.seed, 100)
        played = policy["eval_episodes"], policy["eval_clean_episodes"]
        assert played == ((60, 30) if cell.value("task") == "walker_walk" else (40, 20))
        assert policy["eval_every"] > policy["updates"], "evaluation only at the end"
        assert cell.value("shift_shared") == (True if cell.value("method") == "acro" else None)
    assert [cell.seed for cell in layers[0]] == sorted(cell.seed for cell in layers[0])
