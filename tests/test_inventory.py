"""inventory.tsv lists the interface before a reorganisation: each entry is kept, renamed, or dropped with a reason."""

import contextlib
import csv
import importlib
import io
from collections import defaultdict
from dataclasses import fields
from pathlib import Path

import gymnasium
import pytest

import finetune.algorithms  # noqa: F401 (registers its kind of part)
import pretrain.objectives  # noqa: F401
import vd4rl_pomdp.data.formats
import vd4rl_pomdp.envs
import vd4rl_pomdp.nn.frame  # noqa: F401 (registers its kind of part)
from finetune.config import FinetuneConfig
from pretrain.config import PretrainConfig
from tests.helpers_stages import option_names
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.nn.action_target import ACTION_TARGETS
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.sweeps.grid import load_grid

with Path(__file__).with_name("inventory.tsv").open(newline="", encoding="utf-8") as file:
    ROWS = list(csv.DictReader(file, delimiter="\t"))
KEPT = defaultdict(list)
for row in ROWS:
    if row["status"] == "kept":
        KEPT[row["kind"]].append(row["name"])
CHOSEN = {"pretrain": PretrainConfig, "finetune": FinetuneConfig, "navigation train": NavigationConfig}
"""Stages whose help shows only the options of selected plug-ins."""


def test_removed_entries_have_a_reason():
    assert {row["status"] for row in ROWS} <= {"kept", "renamed", "dropped"}
    assert [row["name"] for row in ROWS if row["status"] != "kept" and not row["reason"]] == []


@pytest.mark.parametrize("command", KEPT["command"])
def test_commands_have_their_flags(command):
    known = set(_help(command.split()))
    if command == "sweep run":
        known |= {word for name in ("slurm", "ray") for word in _help([*command.split(), "--executor", name])}
    if command in CHOSEN:
        names = {field.name for field in fields(CHOSEN[command])} | option_names()
        known |= {f"--{name}".replace("_", "-") for name in names}
    flags = [name.rpartition(" ")[2] for name in KEPT["flag"] if name.rpartition(" ")[0] == command]
    assert [flag for flag in flags if not {flag, flag.replace("--no-", "--")} & known] == []


def _help(words: list[str]) -> list[str]:
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return shown.getvalue().replace("│", " ").replace(",", " ").split()


def test_plugins_grids_ids_and_import_paths_exist():
    names = {f"{kind} {name}" for kind, registry in REGISTRIES.items() for name in registry}
    names |= {f"action_target {name}" for name in ACTION_TARGETS}
    assert [name for name in KEPT["part"] if name not in names] == []
    assert [name for name in KEPT["gymnasium id"] if name not in gymnasium.registry] == []
    for grid in KEPT["grid"]:
        load_grid(grid)
    for path in KEPT["import"]:
        module, _, name = path.rpartition(".")
        try:
            importlib.import_module(path)
        except ModuleNotFoundError:
            assert hasattr(importlib.import_module(module), name), path
