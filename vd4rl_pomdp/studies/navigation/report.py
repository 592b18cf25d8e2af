"""The navigation report: the paper's tables from raw rows, next to the paper's numbers, and verdicts on its claims.

OUT/report.md     tables, verdicts, figures, and the command of every run
OUT/runs.jsonl, episodes.csv, trajectories/     a results folder; `navigation report OUT` rebuilds everything from it
OUT/rows.csv      every number of every run
OUT/tables.csv    every cell: mean, interval, seeds, the paper's number
OUT/figures/      accuracy.png, accuracy_raw.png (next to the paper's numbers), trajectories.png, observations.png
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from vd4rl_pomdp.core.text import code, code_block, markdown, table_lines, write_text
from vd4rl_pomdp.envs.mazes import HARD, MAZES, PAPER_MAZES
from vd4rl_pomdp.report.stats import mean_interval
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.results import RUNS, Result
from vd4rl_pomdp.studies.navigation import figures
from vd4rl_pomdp.studies.navigation.runs import (
    METHOD_NAMES,
    OBJECTIVES,
    RAW_PREFIX,
    REFERENCES,
    UNTRAINED,
    Condition,
    Measure,
    NavigationRun,
    Numbers,
    condition_of,
    find_navigation,
    held_out_loss,
    is_missing,
    load_runs,
    numbers_of,
    online_error,
    paper_number,
    paper_rows,
    refitted_error,
    save_runs,
)

_ONLINE, _REFITTED = "training averages", "held-out trajectories"
_PROTOCOLS = {
    f"{_ONLINE}, probe trained beside the model (the paper's way)": ("training", "online"),
    f"{_REFITTED}, probe refitted on frozen states": ("held_out", "refit"),
}
"""Error protocols: split and probe."""
_LOSS_PROTOCOLS = {f"{_ONLINE} (the paper's way)": ("training", ""), _REFITTED: ("held_out", "")}
_UNITS = {False: "% of a standard deviation", True: "raw units x 100, beside the paper"}
_TITLES = {
    "state_error": "State estimation errors, K = 1 and 15",
    "position_error": "Position errors, K = 15",
    "velocity_error": "Velocity errors, K = 15",
    "action_loss": "Action prediction losses (nats x 100), K = 15",
    "self_prediction": "State estimation errors without and with self-prediction, K = 15",
    "exogenous": "State estimation errors with exogenous noise, K = 15",
    "exogenous_main": "State estimation errors with exogenous noise, two mazes (the main text's table)",
    "references": "References: untrained, trained on the true states, and MIK+A whose future holds a_{t+k-1}",
    "hidden": "Errors on steps that a curtain hides, K = 15",
    "by_k": "Action losses (nats x 100) by k, K = 15",
    "others": "State estimation errors of what no other table has",
}
_PAPER_TABLES = tuple(_TITLES)[:7]
MAIN_TEXT = ("no_curtain", "three_curtains")
"""Mazes of the tables in the paper's main text."""
LITERAL = Condition("", "mik+a", 1, literal_future=True)


def make_tables(runs: Sequence[NavigationRun]) -> pd.DataFrame:
    """Cells of the paper's six tables (position and velocity are one of them) and of four of our own.

    Returns:
        `table`, `view` and `row` where the number stands, `maze`, `mean`, `low` and `high` (95% t interval), `seeds`
        and `of_seeds`, those with which the maze was trained under any condition; the `paper`'s number; and whether it
        is `missing`, see `is_missing`.
        Rows of a table for which neither a run nor the paper has a number are left out, and tables that no run has.
    """
    trained, numbers, rows = {run.condition for run in runs}, numbers_of(runs), []
    seeds = Counter(maze for maze, _ in {(run.condition.maze, run.seed) for run in runs})
    for table, view, row, condition, measure in _layout(runs):
        values = list(numbers.get((condition, measure), {}).values())
        low, high = (mean_interval(np.array(values)[:, None]) if values else None) or (None, None)
        cell: dict[str, Any] = {"table": table, "view": view, "row": row, "maze": condition.maze}
        cell |= {"mean": np.mean(values) if values else None, "low": low, "high": high, "seeds": len(values)}
        cell |= {"of_seeds": seeds[condition.maze], "paper": paper_number(condition, measure)}
        rows.append(cell | {"missing": is_missing(condition, trained)})
    cells = pd.DataFrame(rows)
    known = (cells["seeds"] > 0) | cells["paper"].notna()
    of_row = [cells["table"], cells["view"], cells["row"]]
    return cells[known.groupby(of_row).transform("any") & (cells["seeds"].groupby(of_row[:2]).transform("max") > 0)]


def _layout(runs: Sequence[NavigationRun]) -> Iterator[tuple[str, str, str, Condition, Measure]]:
    """All cells, table by table and row by row: table, view, row, condition and measure."""
    printed, refitted = {condition_of(line, "") for line in paper_rows()}, tuple(_PROTOCOLS)[1]
    references = {method: Condition("", method) for method in REFERENCES}
    found = dict.fromkeys(run.condition._replace(maze="") for run in runs)
    others = [condition for condition in found if condition not in {*printed, *references.values(), LITERAL}]
    sections: list[tuple[str, str, list[tuple[str, Condition, Measure]]]] = []
    for name in _PAPER_TABLES:
        for protocol, (split, probe) in (_LOSS_PROTOCOLS if name == "action_loss" else _PROTOCOLS).items():
            rows = []
            for line in paper_rows():
                if line["table"] != name.removesuffix("_main"):
                    continue
                what = "action_loss" if name == "action_loss" else f"{line['component']}_error"
                options = ", self-prediction" if line["self_prediction"] == "Y" else ""
                label = f"{line['objective']}, K={line['k_max']}{options}"
                rows.append((label, condition_of(line, ""), Measure(what, split, probe)))
            sections.append((name, protocol, rows))
    errors = [(what, refitted_error(what)) for what in ("state", "position", "velocity")]
    rows = [(f"{name}, {what}", condition, error) for name, condition in references.items() for what, error in errors]
    rows += [
        ("MIK+A, literal future, K=1, state error", LITERAL, refitted_error("state")),
        ("MIK+A, literal future, K=1, action loss", LITERAL, held_out_loss()),
    ]
    sections.append(("references", refitted, rows))
    hidden = [(what, refitted_error(what, "hidden")) for what in ("position", "velocity")]
    rows = [(f"{name}, {what}", Condition("", name), error) for name in METHOD_NAMES for what, error in hidden]
    sections.append(("hidden", refitted, rows))
    rows = [(f"{name}, k={k}", Condition("", name), held_out_loss(k)) for name in OBJECTIVES for k in (1, 5, 15)]
    sections.append(("by_k", _REFITTED, rows))
    sections.append(("others", refitted, [(other.short, other, refitted_error("state")) for other in others]))
    for table, protocol, rows in sections:
        losses = table in ("action_loss", "by_k")
        for raw in (False,) if losses else (False, True):
            prefix = RAW_PREFIX if raw else ""
            trained = {run.condition.maze for run in runs if any(m.measure.startswith(prefix) for m in run.values)}
            paper = trained & set(PAPER_MAZES)  # all of the paper's mazes if any of them has runs
            mazes = [maze for maze in MAZES if maze in trained or (paper and maze in PAPER_MAZES)]
            if table == "exogenous_main":
                mazes = [maze for maze in mazes if MAZES[maze].paper in MAIN_TEXT]
            elif table == "hidden":
                mazes = [maze for maze in mazes if MAZES[maze].curtains]
            view = protocol if losses else f"{protocol}; {_UNITS[raw]}"
            for row, condition, measure in rows:
                for maze in mazes:
                    yield table, view, row, condition._replace(maze=maze), measure.raw() if raw else measure


def cell_text(cell: pd.Series) -> str:
    """Text of a cell: mean, interval, seeds and (the paper's number); "no run" if it is missing."""
    paper = "" if pd.isna(cell["paper"]) else f"({cell['paper']:.1f})"
    if not cell["seeds"]:
        return f"no run {paper}".rstrip() if cell["missing"] else paper
    spread = "" if pd.isna(cell["low"]) else f" [{cell['low']:.1f}, {cell['high']:.1f}]"
    seeds = f"n={cell['seeds']}" + (f" of {cell['of_seeds']:.0f}" if cell["seeds"] < cell["of_seeds"] else "")
    return f"**{cell['mean']:.1f}**{spread} {seeds} {paper}".rstrip()


def table_sections(cells: pd.DataFrame) -> Iterator[str]:
    """Markdown lines of all tables under their titles, one column per maze."""
    texts = cells.assign(text=cells.apply(cell_text, axis=1))
    for name, title in _TITLES.items():
        mine = texts[texts["table"] == name]
        if mine.empty and name == "others":
            continue
        yield from (f"## {title}", "", *([] if len(mine) else ["No run yet.", ""]))
        for view, table in mine.groupby("view", sort=False):
            mazes, rows = table["maze"].unique(), table["row"].unique()
            wide = table.pivot(index="row", columns="maze", values="text").loc[rows, mazes]
            cells_of_row = ((label, *row) for label, row in zip(rows, wide.to_numpy(), strict=True))
            yield from (f"*{view}*", "", *table_lines(["", *mazes], cells_of_row, range(len(mazes) + 1)), "")


NEAR_ZERO = 5.0
"""Action loss (nats x 100) that counts as near zero; random guessing among 20 codes gives 300."""
FEW = 15.0
"""State error (% of a standard deviation) below which a first-person agent counts as localised."""
_RELATIONS = {">=": operator.ge, "<=": operator.le, "<": operator.lt, ">": operator.gt}
ClaimSide = tuple[Condition, Measure]


class Claim(NamedTuple):
    """Compares `left` with `factor` times `right`, or with `factor` itself if there is no right side."""

    text: str
    left: ClaimSide
    relation: str
    factor: float
    right: ClaimSide | None = None

    def raw(self) -> Claim:
        """The claim for raw errors in the simulator's units; unchanged if it has an absolute bound."""
        if self.right is None:
            return self
        left, right = ((condition, measure.raw()) for condition, measure in (self.left, self.right))
        return self._replace(left=left, right=right)

    def holds(self, left: float, right: float) -> bool:
        """Whether two numbers satisfy the relation."""
        return bool(_RELATIONS[self.relation](left, self.factor * right))

    def words(self, left: float, right: float) -> str:
        """Two numbers as a table shows them; the second one only where there is a right side."""
        return f"{left:.1f} / {right:.1f}" if self.right else f"{left:.1f}"

    def by_seed(self, numbers: Numbers) -> list[tuple[float, float]]:
        """Both sides' numbers for every seed that has both."""
        left = numbers.get(self.left, {})
        right = numbers.get(self.right, {}) if self.right else dict.fromkeys(left, 1.0)
        return [(left[seed], right[seed]) for seed in sorted(left.keys() & right.keys())]


def claims(maze: str) -> list[Claim]:
    """Claims about one maze: first whether training is long enough for comparisons, then the paper's statements.

    Wording and bounds (half, three times) are this package's; some compare with an untrained encoder, which the paper
    does not have.
    """

    def of(method: str, measure: Measure | str, max_k: int = 15, **options: bool) -> ClaimSide:
        named = refitted_error(measure) if isinstance(measure, str) else measure
        return Condition(maze, method, max_k, **options), named

    first, last = (of("mik+a", held_out_loss(k)) for k in (1, 15))
    best, literal = of("mik+a", "state", 1), of("mik+a", "state", 1, literal_future=True)
    recorder, slow, place = of("ah+a", "state", 1), of("mik+a", "velocity"), of("mik+a", "position")
    found = [
        Claim("gate: mik+a's action loss at k=1, of that at k=15", first, "<=", 0.85, last),
        Claim("no_history's velocity error, of mik+a's", of("no_history", "velocity"), ">=", 3, slow),
        Claim("K=1: ah+a's state error, of mik+a's", recorder, ">=", 2, best),
        Claim("K=1: ah+a's action loss is near zero", of("ah+a", held_out_loss(), 1), "<=", NEAR_ZERO),
        Claim("K=1: mik+a's state error with the literal future, of the default's", literal, ">=", 2, best),
        Claim("ah+a's position error, of mik+a's", of("ah+a", "position"), ">=", 1.5, place),
    ]
    if MAZES[maze].paper == "three_curtains":
        found += [
            Claim("mik's velocity error, of mik+a's", of("mik", "velocity"), ">=", 1.5, slow),
            Claim("ah's state error, of mik+a's", of("ah", "state"), ">", 1, of("mik+a", "state")),
        ]
    if MAZES[maze].paper == "first_person":  # the position is known by far where one image does not reveal it
        for trained_so, name in ((False, "mik+a"), (True, "mik+a with self-prediction")):
            ours = of("mik+a", "state", self_prediction=trained_so)
            found += [
                Claim(f"state error of {name}, of the untrained one's", ours, "<", 0.5, of(UNTRAINED, "state")),
                Claim(f"state error of {name}", ours, "<", FEW),
                Claim(f"no_history's state error, of that of {name}", of("no_history", "state"), ">", 1, ours),
            ]
        found.append(
            Claim("ah+a's state error, of no_history's", of("ah+a", "state"), ">", 1, of("no_history", "state"))
        )
    for method in OBJECTIVES[1:]:  # those with a memory
        text = f"{method}'s position error, of the untrained one's"
        found.append(Claim(text, of(method, "position"), "<", 0.5, of(UNTRAINED, "position")))
    return found


def judge(claim: Claim, numbers: Numbers) -> tuple[bool | None, list[str]]:
    """Whether a claim holds for the means over seeds, None without any, and the cells of a table that show it."""
    if not (seeds := claim.by_seed(numbers)):
        return None, ["-", "-"]
    means = [sum(side) / len(side) for side in zip(*seeds, strict=True)]
    holds = claim.holds(*means)
    return holds, [claim.words(*means), "**yes**" if holds else "**no**"]


def verdict_lines(runs: Sequence[NavigationRun]) -> list[str]:
    """A report section: the claims about all mazes with runs, whether they hold, and the paper's numbers."""
    numbers, trained = numbers_of(runs), {run.condition.maze for run in runs}
    found = [(maze, claim) for maze in MAZES if maze in trained for claim in claims(maze)]
    rows, judged, printed, both, other = [], list[bool](), list[bool](), 0, list[str]()
    for maze, claim in found:
        raw = claim.raw()
        (holds, cells), (raw_holds, raw_cells) = judge(claim, numbers), judge(raw, numbers)
        columns = [maze, f"{claim.text} {claim.relation} {claim.factor:g}{' x' if claim.right else ''}"]
        if holds is None:
            columns += ["no run yet", "-", "-"]
        else:
            judged.append(holds)
            seeds = [claim.holds(*pair) for pair in claim.by_seed(numbers)]
            columns += [*cells, f"{sum(seeds)} of {len(seeds)}"]
        columns += ["no error", "-"] if raw == claim else raw_cells
        if raw != claim and raw_holds is not None:
            both += 1
            other += [f"{maze}: {claim.text}"] * (holds != raw_holds)
        left, right = paper_number(*raw.left), paper_number(*raw.right) if raw.right else 1.0
        if left is None or right is None:
            columns.append("none")
        else:
            columns.append(f"{claim.words(left, right)}: {'yes' if claim.holds(left, right) else 'no'}")
            printed += [] if raw_holds is None else [raw_holds]
        rows.append(columns)
    changes = f"{len(other)} change ({'; '.join(other)})" if other else "none changes"
    of_ah = {maze: paper_number(Condition(maze, "ah+a"), online_error("position").raw()) for maze in MAZES}
    recorder = ", ".join(f"{number:.1f} ({maze})" for maze, number in of_ah.items() if number is not None)
    head = ["maze", "statement", "here, % of std", "holds", "seeds", "here, raw x 100", "holds", "the paper's numbers"]
    return [
        "## Which statements hold",
        "",
        f"{sum(judged)} of {len(judged)} hold, {len(found) - len(judged)} have no runs yet. "
        f"Of {both} that are judged in both units, {changes}.",
        "Wording and bounds are this package's. "
        f"Of those for which the paper prints numbers, {sum(printed)} of {len(printed)} hold.",
        "Means over seeds, held-out trajectories, probe refitted on frozen states; `seeds`: how many it holds for.",
        "",
        *table_lines(head, rows, range(len(head))),
        "",
        "ah+a need not beat the untrained encoder: it can read an action from its record of past ones",
        f"instead of keeping the state. In the paper its position error is {recorder}.",
        "",
    ]


Samples = Callable[[], Mapping[str, np.ndarray]]
"""Renders sample observations: (n, 3, H, W) uint8 by name."""
_CAPTIONS = {
    "accuracy.png": ("Accuracy of every objective", "Bars: held-out trajectories, probe refitted on frozen states."),
    "accuracy_raw.png": ("The same in raw units", "The paper's marks are training averages."),
    "trajectories.png": (
        "True and estimated trajectories",
        "From the first row on; errors exclude the first rows, where little was seen.",
    ),
    "observations.png": ("Sample observations", "Observations along one trajectory in each maze."),
}
_HARD = """\
`hard_` mazes are variants of the paper's. Three wider curtains hide the mass 36% of the time (the paper's:
about 22%), every action is noisy (not a tenth of them zero and a tenth random), and the first person has
another camera, a black sky and other kinematics. The paper's numbers are for its mazes.
"""
_READING = """\
Errors are given in two units: percent of a standard deviation, and the simulator's own units x 100. The paper's
percentages are most likely the latter, so its numbers are compared with those only.

A cell of a table reads: **mean over seeds** [95% t interval] n=seeds (the paper's number).
Missing: "n=1 of 3" where other cells of the maze have three seeds,
"no run" where other cells of the maze, and other mazes of the row, have one.
"""
_COMMANDS = """\
## Commands

Each line computes one run, followed by its maze and wall-clock seconds; `navigation collect` makes its data, by
`collection` in runs.jsonl. Folders are those of the original commands: datasets of two mazes may have had the same
name on different machines. The grids `navigation` (the paper's own mazes) and `first_person` print the lines of all
cells: `vd4rl-pomdp sweep run GRID --out runs --dry-run`.
"""


def write_report(sources: Sequence[Path], out: Path, samples: Samples | None = None) -> Path:
    """Write the report of all runs in `sources` (run folders, results folders, or folders that contain some) to `out`;
    returns the page. Without `samples`, which need OpenGL, no sample observations are drawn."""
    refuse_foreign(out, "navigation report", RUNS)
    found = find_navigation(sources, out)
    runs, unfinished = load_runs(found), [result for result in found if not result.finished]
    drawn = samples() if samples is not None else None  # before anything is written, since OpenGL may be missing
    with owned(out):
        save_runs(runs, out)
        state, folder = refitted_error("state"), out / "figures"
        folder.mkdir(exist_ok=True)
        written = {
            "accuracy.png": figures.accuracy_bars(runs, state, folder / "accuracy.png"),
            "accuracy_raw.png": figures.accuracy_bars(runs, state.raw(), folder / "accuracy_raw.png"),
            "trajectories.png": figures.trajectories(runs, folder / "trajectories.png"),
            "observations.png": drawn and figures.observations(drawn, folder / "observations.png"),
        }
        cells = make_tables(runs)
        filled = cells[(cells["seeds"] > 0) | cells["missing"]]
        numbers = filled[["mean", "low", "high"]].map(lambda value: "" if pd.isna(value) else f"{value:.4g}")
        columns = ["table", "view", "row", "maze", "mean", "low", "high", "seeds", "paper"]
        filled.assign(**numbers)[columns].to_csv(out / "tables.csv", index=False, lineterminator="\n")
        lines = [*_head(runs, unfinished), *verdict_lines(runs)]
        for name in filter(written.get, written):
            lines += [f"![{_CAPTIONS[name][0]}](figures/{name})", "", _CAPTIONS[name][1], ""]
        lines += [*table_sections(cells), _COMMANDS]
        commands = []
        for run in runs:
            seconds = float(run.result.files["timing"]["seconds"])
            commands.append(f"{run.result.record['command']}  # {run.condition.maze}, {seconds:.0f} s")
        lines += code_block(commands, "bash")
        write_text(out / "report.md", "\n".join(lines) + "\n")
    return out / "report.md"


def _head(runs: list[NavigationRun], unfinished: list[Result]) -> list[str]:
    """Head of the page: runs, cost, differing settings, and how to read the tables."""
    seeds = sorted({run.seed for run in runs})
    timings = [run.result.files["timing"] for run in runs if run.condition.method != UNTRAINED]
    timings = timings or [run.result.files["timing"] for run in runs]
    minutes = sorted(round(float(timing["seconds"]) / 60) for timing in timings)
    took = " to ".join(dict.fromkeys(map(str, (minutes[0], minutes[-1]))))
    sets = [run.result.record.get("collection") or {} for run in runs]
    steps, samples = (
        " or ".join(f"{count:,}" for count in sorted(counts)) or "unknown"
        for counts in (
            {int(timing["steps"]) for timing in timings},
            {made["trajectories"] * made["trajectory_rows"] for made in sets if made},
        )
    )
    machines = markdown("; ".join(sorted({run.result.machine or "not recorded" for run in runs})))
    lines = [
        "# Navigation: what the objectives know of the state",
        "",
        f"Runs: {len(runs)}. Preset: {code(runs[0].preset)}. Seeds: {', '.join(map(str, seeds))}. "
        f"Budget: {steps} gradient steps on {samples} samples, {took} minute{'s' * (took != '1')} a run ({machines}). "
        "The paper's: 200,000 steps on 500,000 samples.",
        "",
    ]
    unlike = []  # one sentence per setting that differs among runs on one maze and is not part of their condition
    for maze, members in groupby(runs, key=lambda run: run.condition.maze):
        mine = list(members)
        settings = pd.DataFrame([run.settings for run in mine], index=[code(run.condition.short) for run in mine])
        for name in settings:
            is_without = np.array([not getattr(run.condition, name, True) for run in mine])  # e.g. self_prediction
            values = settings[name][~is_without].dropna().str[: 8 if name == "set" else None]
            found = list(values.value_counts().index)
            if where := [f"{one} in {', '.join(values.index[values == one].unique())}" for one in found[1:]]:
                unlike.append(f"Not alike in {code(maze)}: {name} is {found[0]}, but {'; '.join(where)}.  ")
    lines += [*unlike, ""] if unlike else []
    lines += [_HARD] if any(MAZES[run.condition.maze].style is HARD for run in runs) else []
    sources = {run.condition.maze: run.result.record["config"]["exogenous"] for run in runs if run.condition.exogenous}
    images = [f"{markdown(name)} in {code(maze)}" for maze, name in sources.items()]
    lines += [f"Exogenous noise adds {', '.join(images)}.", ""] if images else []
    for result in unfinished:
        of = result.record["config"].get("steps", "?")
        lines += [f"Unfinished, in no table: {code(str(result.path))} at {result.step} of {of} steps.", ""]
    return [*lines, _READING]
