"""Decides which runs belong to a grid, whatever folder they are in and whichever command made them."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LABELS
from vd4rl_pomdp.data.collect import set_quality
from vd4rl_pomdp.report.load import Choice, unusual
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.results import Result
from vd4rl_pomdp.sweeps.grid import GridCell
from vd4rl_pomdp.sweeps.plan import DataSet, set_of, with_collections
from vd4rl_pomdp.sweeps.stages import check_cells, config_of, recipe_of, recorded


class GridMembers(Choice):
    """The pretraining and fine-tuning runs that a grid's cells ask for."""

    def __init__(self, name: str, cells: list[GridCell]) -> None:
        """Work out what some cells of the grid `name` compute; UserError if one is invalid, or trains in a maze."""
        self._what = f"one of the {len(cells)} cells of {name} that are asked for"
        self._sets: dict[str, list[DataSet]] = defaultdict(list)
        self.wanted: list[Row] = []
        check_cells(cells, name)
        for cell in cells:
            if "navigation_train" in cell.chain:
                raise UserError(f"{name}: its cells are mazes; `vd4rl-pomdp navigation report` reports them")
            data = set_of(cell, Path())  # matched by its collection settings, not its path
            for section in cell.chain[1:]:
                self._sets[recipe_of(cell, section)].append(data)
            if "finetune" in cell.chain:
                settings = recorded(cell, "pretrain") | recorded(cell, "finetune")
                quality = set_quality(config_of(cell, data.section))
                labels = settings | {"task": data.wanted["task"], "quality": quality, "seed": cell.seed}
                experiment = recipe_of(cell, "finetune", seeds=False)
                named = {"variant": unusual(settings), "experiment": experiment}
                self.wanted.append({name: labels[name] for name in LABELS} | named)

    def among(self, results: list[Result]) -> list[Result]:
        """The runs that belong to the grid, in order; UserError if none does."""
        found = [run for run in with_collections(results) if self._has(run)]
        if not found:
            raise UserError(f"none of {len(results)} runs is {self._what}; `sweep run --dry-run` lists the cells")
        return found

    def _has(self, run: Result) -> bool:
        """Whether some cell asks for this run. Without collection settings (imported data), task and quality decide."""
        sets = self._sets.get(run.recipe, ())
        collection = run.record.get("collection")
        if collection and "format" not in collection:
            return run.on_one_set and any(data.alike(run.record) for data in sets)
        labels = {name: run.labels[name] for name in ("task", "quality")}
        return run.on_one_set and any(labels.items() <= data.wanted.items() for data in sets)
