"""`vd4rl-pomdp certify`: does a dataset under a corruption need a memory of past observations?

The grid `certify` trains on the simulator's states, with:

    supervised+a          a memory of observations and actions
    supervised_picture    one observation, no memory
    integrator            the first observation, all actions since and the time
    state                 the state itself: whether data and budget suffice

Each is scored by R^2 of the states in episodes held out from encoder and probe, and optionally by the returns of a
policy. Such a memory is needed if the first scores above the second, the third and 0 (R^2 of predicting the mean).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from finetune.features import FrozenEncoder
from finetune.histories import read_whole
from vd4rl_pomdp import __version__
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.hardware import pick_device
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.core.reading import damaged
from vd4rl_pomdp.core.tasks import UNKNOWN_QUALITY
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.data.card import write_card
from vd4rl_pomdp.nn.encoder_folder import load_encoder, read_record
from vd4rl_pomdp.nn.probes import probe_r2
from vd4rl_pomdp.report.gates import STATE_SHARE, converged, episodes_of
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.report.stats import difference_interval, mean_interval, with_interval
from vd4rl_pomdp.runs.files import Row, groups, read_json, write_json
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.runs.provenance import git_commit
from vd4rl_pomdp.runs.results import CERTIFICATES, certificate_id, keep_certificates
from vd4rl_pomdp.sweeps.grid import GridCell, load_grid
from vd4rl_pomdp.sweeps.plan import Job, training_job
from vd4rl_pomdp.sweeps.stages import check_cells, recorded

GRID = "certify"
MEMORY, FLOORS, STATE = "supervised+a", ("supervised_picture", "integrator"), "state"
NEEDS, NEEDS_NOT, OPEN = "needs a memory of what was seen", "needs no memory of what was seen", "undecided"
MARGIN = 0.05
"""Memory is not needed if it surely adds less than this, in R^2 or as a fraction of the data's mean return."""
ENOUGH = 0.5
"""Minimum score of the memory itself for that verdict, in the same units; below, the budget may be too small."""
R2_FILE = "r2.json"
"""R^2 per held-out episode, in a pretraining run's folder."""


def planned(
    data: Path, corruption: str, out: Path, returns: bool, changes: Sequence[str]
) -> tuple[Dataset, list[GridCell], list[Job]]:
    """The dataset, its cells of the grid, and their jobs in dependency order, OUT/METHOD/seedN/STAGE.

    With `returns`, policies are trained as well; `changes` override the grid: "pretrain.steps=100" or "seed=0,1".
    """
    dataset = open_dataset(data)
    dataset.require_states()
    about = [
        f"collect.task={dataset.task}",
        f"collect.quality={dataset.quality or UNKNOWN_QUALITY}",
        f"pretrain.corruption={corruption}",
    ]
    cells = load_grid(GRID, [*about, *changes]).cells()
    if not returns:
        if any(change.startswith("finetune.") for change in changes):
            raise UserError("--change finetune.* is for policies, which are trained with --returns: add it")
        without = [replace(c, sections={n: s for n, s in c.sections.items() if n != "finetune"}) for c in cells]
        cells = [cell for cell in without if cell.value("method") != STATE]
    check_cells(cells, GRID)
    jobs: list[Job] = []
    for cell in cells:
        before, values = list[Job](), dict[str, object]()
        for section in cell.chain[1:]:
            name = f"{_place(cell)}/{section}"
            values |= recorded(cell, section)
            job = training_job(cell, section, name, out / name, data, before, values)
            before.append(replace(job, content=dataset.fingerprint))  # finished runs on other data do not count
        jobs += before
    if len({job.name for job in jobs}) < len(jobs):
        raise UserError("--change lists several values of a setting: only seed may have several")
    return dataset, cells, jobs


def _place(cell: GridCell) -> str:
    """Folder of a cell's runs, below the common one."""
    return f"{cell.value('method')}/seed{cell.seed}"


def certify(dataset: Dataset, cells: Sequence[GridCell], out: Path, returns: bool) -> Row:
    """Make the certificate of finished runs; it is saved in their folder and in the dataset's."""
    by_method = groups(cells, lambda cell: str(cell.value("method")))
    runs = {method: [out / _place(cell) for cell in mine] for method, mine in by_method.items()}
    measured = {"R2": judge({method: _r2(dataset, runs[method]) for method in (MEMORY, *FLOORS)}, 1, 2)}
    if returns:
        measured["returns"] = _returns([run / "finetune" for mine in runs.values() for run in mine])
    record = read_record(runs[MEMORY][0] / "pretrain" / "encoder")
    hidden, usual = record.pretrain.corruption, flat(CorruptionConfig.of(record.pretrain.corruption["corruption"]))
    options = (f"{name} {value}" for name, value in hidden.items() if usual.get(name) != value)
    budget = {"steps": record.pretrain.steps, "updates": measured.get("returns", {}).get("updates", 0)}
    certificate = {
        "data": dataset.fingerprint,
        **{"task": dataset.task, "quality": dataset.quality, "corruption": hidden},
        "name": ", ".join([hidden["corruption"], *options]),
        **_whole(measured, budget),
        "budget": budget,
        "measured": measured,
        "seeds": sorted({cell.seed for cell in cells}),
        **{"version": __version__, "commit": git_commit(), "made": datetime.now(UTC).isoformat(timespec="seconds")},
    }
    made = {certificate_id(dataset.fingerprint, hidden): certificate}
    keep_certificates(out, made)
    place = dataset.path if dataset.path.is_dir() else dataset.path.parent
    try:
        with owned(place):  # another process may add a certificate at the same time
            keep_certificates(place, made)
            if (place / "card.md").exists():
                write_card(place)
    except UserError as error:  # a shared dataset may be read-only
        print(f"warning: {error}; the certificate is only in {out}", file=sys.stderr)
    return certificate


def _whole(measured: Mapping[str, Row], budget: Mapping[str, int]) -> Row:
    """Verdict over all measures, and why."""
    verdicts = {row["verdict"] for row in measured.values()}
    policies = f"{budget['updates']:,} updates" if "returns" in measured else "no returns"
    why = [*(f"{kind}: {row['why']}" for kind, row in measured.items()), f"{budget['steps']:,} steps, {policies}"]
    return {"verdict": verdicts.pop() if len(verdicts) == 1 else OPEN, "why": "; ".join(why)}


def contradictions(folder: Path) -> list[str]:
    """A sentence for each certificate of a folder whose id or verdict contradicts its own record.

    UserError if the file is damaged.
    """
    file, found = folder / CERTIFICATES, []
    for name, one in read_json(file).items() if file.exists() else ():
        with damaged(f"{file}: {name}", "is damaged", "remove it, or write it again with `vd4rl-pomdp certify`"):
            measured = {
                kind: _gated(row) if kind == "returns" else _verdict(row, 1, 2) for kind, row in one["measured"].items()
            }
            rows = [
                (one, _whole(measured, one["budget"])),
                *((one["measured"][kind], measured[kind]) for kind in measured),
            ]
            if (computed := certificate_id(one["data"], one["corruption"])) != name:
                found.append(f"certificate {name}: its record computes {computed}")
            for stored, row in rows:
                wrong = [(stored[key], value) for key, value in row.items() if stored[key] != value]
                found += [f"certificate {name}: says {says!r}, its numbers {value!r}" for says, value in wrong]
    return found


def _r2(dataset: Dataset, runs: Sequence[Path]) -> np.ndarray:
    """(seeds, held-out episodes): R^2 of poses and velocities by a linear probe on the encoders' states.

    The encoders were pretrained on the dataset with `hold_out`. Saved in each run's R2_FILE.
    """
    for file in (run / "pretrain" / R2_FILE for run in runs):
        if file.exists():
            continue
        encoder, card = load_encoder(file.parent / "encoder", dataset.task, dataset.action_dim, dataset.frame_size)
        device = pick_device("auto")
        corruption, precision = CorruptionConfig.fill(card.corruption), card.settings["precision"]
        frozen = FrozenEncoder(encoder.to(device), dataset.to(device), corruption, 0, precision, card.seed)
        view = frozen.view(0)
        with torch.no_grad():
            parts = [read_whole(encoder, frozen.frames(some, view), dataset, some).cpu() for some in frozen.groups()]
        features, states = torch.cat(parts).numpy(), dataset.states().cpu().numpy()
        write_json(file, {"r2": probe_r2(features, states, dataset.episode.cpu().numpy())})
    return np.array([read_json(run / "pretrain" / R2_FILE)["r2"] for run in runs])


def _returns(folders: Sequence[Path]) -> Row:
    """Verdict from the policies' returns, undecided if `state` returns too little or critics have not converged."""
    runs = load_runs(folders)
    data = np.mean([run.reference.data_return for run in runs])
    found = {method: episodes_of(mine) for method, mine in groups(runs, lambda run: run.method).items()}
    row = judge({name: found[name] for name in (MEMORY, *FLOORS)}, float(data), 0)
    share = float(found[STATE].mean() / data)
    row |= {"data_return": float(data), "state_share": share, "converged": converged(runs)}
    row["updates"] = min(run.result.record["config"]["updates"] for run in runs)
    return row | _gated(row)


def _gated(row: Row) -> Row:
    """Verdict and reason of returns: undecided if they miss a gate."""
    found, missed = _verdict(row, row["data_return"], 0), []
    if not row["state_share"] >= STATE_SHARE:
        missed.append(f"state returns {row['state_share']:.2f} of the data's return, less than {STATE_SHARE}")
    if not row["converged"]:
        missed.append(f"critics are {'not known to have' if row['converged'] is None else 'not'} converged")
    return {"verdict": OPEN, "why": "; ".join([*missed, found["why"]])} if missed else found


def judge(values: Mapping[str, np.ndarray], unit: float, digits: int) -> Row:
    """Verdict: whether the memory scores above both floors; (seeds, episodes) by method, `unit` that of MARGIN and
    ENOUGH, `digits` for the text."""
    methods: dict[str, Any] = {
        name: (float(scores.mean()), *(mean_interval(scores) or (None, None))) for name, scores in values.items()
    }
    above: dict[str, Any] = {}
    for floor in FLOORS:
        ends = difference_interval(values[MEMORY], values[floor]) or (None, None)
        above[floor] = (float(values[MEMORY].mean() - values[floor].mean()), *ends)
    row = {"methods": methods, "above": above}
    return row | _verdict(row, unit, digits)


def _verdict(row: Row, unit: float, digits: int) -> Row:
    """Verdict and reason of the means and differences that `judge` has found."""
    methods, above = row["methods"], row["above"]
    known = all(low is not None for _, low, _ in above.values())
    weak = methods[MEMORY][0] < ENOUGH * unit
    mean, low, high = methods[MEMORY]
    # a floor below 0, R^2 of the mean, shows an overfitted probe: to be above it is not enough
    least = (low, *(low for _, low, _ in above.values()))
    verdict = NEEDS if known and all(end is not None and end > 0 for end in least) else OPEN
    if known and any(high < MARGIN * unit for *_, high in above.values()):
        verdict = OPEN if weak else NEEDS_NOT
    why = [f"{MEMORY} {with_interval(mean, low, high, digits)}"]
    why += [f"less {floor} {with_interval(mean, low, high, digits)}" for floor, (mean, low, high) in above.items()]
    why += ["too few seeds"] * (not known) + ["itself too low to judge"] * (weak and verdict == OPEN)
    return {"verdict": verdict, "why": ", ".join(why)}
