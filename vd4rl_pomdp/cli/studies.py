"""Commands that measure or summarise: report, results, theory, bench, navigation."""

from __future__ import annotations

import json as json_library
import sys
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command, parse, parse_stage, show
from vd4rl_pomdp.cli.sweeps import carry_out
from vd4rl_pomdp.core.errors import UserError, refuse_no_folder
from vd4rl_pomdp.report import compare as comparing
from vd4rl_pomdp.report import theory as theory_page
from vd4rl_pomdp.report.load import ALL
from vd4rl_pomdp.report.page import print_summary, write_report
from vd4rl_pomdp.runs import NAVIGATION_FILE
from vd4rl_pomdp.runs.outputs import refuse_foreign, refuse_kept
from vd4rl_pomdp.runs.results import CERTIFICATES, add_results, certificate_in_words, verify_results
from vd4rl_pomdp.studies import certify as certificates
from vd4rl_pomdp.studies.navigation import collect as mazes
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.report import write_report as write_navigation_report
from vd4rl_pomdp.studies.navigation.train import train
from vd4rl_pomdp.studies.theory import theory_study
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.grid import load_grid, narrow
from vd4rl_pomdp.sweeps.members import GridMembers
from vd4rl_pomdp.sweeps.options import LocalOptions, own_program, refuse_unknown_to_jobs


@command
def report(
    runs: tyro.conf.Positional[list[Path]],
    out: Path = Path("report"),
    grid: str = "",
    only: tuple[str, ...] = (),
    change: tuple[str, ...] = (),
) -> None:
    """Write an HTML report with tables and figures about fine-tuning runs.

    `report compare A B` compares two sets of runs.

    Args:
        runs: Run folders, results folders, or folders that contain some; output of `theory --out` adds its section.
        out: Folder of the report.
        grid: Report only the cells of this grid: a shipped one (`vd4rl-pomdp sweep list`) or a TOML or Python file.
        only: Report only grid cells with these values: method=mik+a,acro seed=0.
        change: Overrides that the grid was run with: preset=cpu finetune.updates=20000.
    """
    choice = ALL
    if grid:
        choice = GridMembers(grid, narrow(load_grid(grid, list(change)).cells(), list(only)))
    elif only or change:
        raise UserError("--only and --change apply to the cells of a grid: add --grid")
    written = write_report(_named(runs), out, choice)
    print_summary(written)
    for sentence in written.unlike:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"report: {written.page}")


def _named(runs: list[Path]) -> list[Path]:
    """The folders of a command line; UserError if there are none."""
    if not runs:
        raise UserError("no runs given: name at least one folder")
    return runs


@command
def compare(a: tyro.conf.Positional[Path], b: tyro.conf.Positional[Path], out: Path | None = None) -> None:
    """Compare two sets of runs by condition: scores, their difference, n, and settings that differ.

    Args:
        a: Run folder, results folder, or folder that contains some.
        b: The same, to compare with.
        out: Also write an HTML page, CSV and LaTeX into this folder.
    """
    if out is not None:
        refuse_foreign(out, "comparison", f"{comparing.FILE}.csv")
    comparison = comparing.compare_results(a, b)
    page = None if out is None else comparing.write_comparison(comparison, out)
    comparing.print_comparison(comparison)
    if page is not None:
        print(f"comparison: {page}")


@command
def add(runs: tyro.conf.Positional[list[Path]], out: Path) -> None:
    """Append finished runs to a results folder: small files and raw evaluation rows, without weights and videos.

    A run that is already there is not changed.

    Args:
        runs: Run folders, results folders, or folders that contain some.
        out: The results folder; created if missing.
    """
    print(f"{out}: {add_results(_named(runs), out)}")


@command
def verify(folder: tyro.conf.Positional[Path], replay: Path | None = None) -> None:
    """Check the rows of a results folder against their records, and optionally replay an episode of a run.

    Args:
        folder: The results folder.
        replay: Folder of a run with encoder and policy; the first episode of its last evaluation is replayed.
    """
    from finetune import evaluation  # loads OpenGL

    runs, wrong = verify_results(folder)
    print("\n".join([*wrong, f"{len(runs)} runs, {len(wrong)} contradictions between rows and records"]))
    if replay is not None:
        row, now, where = evaluation.replay(replay, runs)
        print(f"episode 0 under {row['evaluated_under']} replays to a return of {now['return']}")
        differ = [
            f"{name} {now[name]} where it says {row[name]}" for name in evaluation.REPLAYED if now[name] != row[name]
        ]
        if differ:
            same = "digits are the same only where these are"
            raise UserError(f"{replay}: replays to {', '.join(differ)}; {where}: {same}")
    if wrong:
        raise UserError(f"{folder}: {len(wrong)} contradictions, see above; ask their author")


@command
def theory(json: bool = False, out: Path | None = None) -> None:
    """Compute the paper's claims on finite worlds by enumeration, and list where its text differs.

    Args:
        json: Print one JSON object.
        out: Also write the JSON and an HTML page with figures into this folder.
    """
    if out is not None:
        refuse_foreign(out, "study of the theory", theory_page.FILE)
        out.mkdir(parents=True, exist_ok=True)  # fail before the computation
    study = theory_study()
    if json:
        print(json_library.dumps(study))
    else:
        theory_page.print_theory(study)
    if out is not None:
        print(f"page: {theory_page.write_theory(study, out)}", file=sys.stderr if json else sys.stdout)


@command
def bench(json: bool = False, quick: bool = False, gpu: bool = False, device: str = "auto") -> None:
    """Measure speed and memory of every stage on this machine, as ratios within one run.

    Args:
        json: Print one JSON object instead of a table.
        quick: A tenth of the frames and fewer repetitions: rougher numbers, not compared with the goals.
            With --gpu only a test of the code.
        gpu: Benchmark the paper preset on one GPU instead: CUDA graphs, stacked seeds, JAX, encoding, evaluation.
            It takes under three minutes.
        device: Training device: auto, cpu or cuda. With --gpu and --quick, cpu tests the code without a GPU.
    """
    from vd4rl_pomdp.bench import gpu as on_gpu  # loads OpenGL
    from vd4rl_pomdp.bench.suite import GOALS, bench, print_table

    results = on_gpu.gpu_bench(device, quick) if gpu else bench(quick, device)
    if json:
        show(results, as_json=True)
    elif gpu:
        claims = on_gpu.AIMS if results["device"] == "cuda" and not quick else {}
        print_table(results, claims, "one GPU, medians of one run" if claims else "a trial of the code: no claims")
    else:
        print_table(results, {} if quick else GOALS, "speed and memory, ratios within one run")


@command
def certify(
    data: tyro.conf.Positional[Path],
    corruption: tyro.conf.Positional[str],
    out: Path,
    returns: bool = False,
    change: tuple[str, ...] = (),
    jobs: int = 0,
) -> None:
    """Decide with supervised encoders whether a dataset needs a memory of past observations. Re-run to resume.

    Args:
        data: Folder of a dataset with simulator states; the certificate is written there.
        corruption: The corruption that makes observations partial.
        out: Folder of the runs.
        returns: Also train and evaluate policies, in addition to linear probes.
        change: Training settings: seed=0,1,2,3,4 preset=cpu pretrain.patch_size=24 finetune.updates=60000.
        jobs: Concurrent jobs; 0: as many as the GPUs take, or one without a GPU.
    """
    refuse_no_folder(out)
    refuse_kept(out)
    options = LocalOptions(jobs=jobs)
    options.check()
    dataset, cells, trainings = certificates.planned(data, corruption, out, returns, change)
    for training in trainings:
        refuse_unknown_to_jobs(training.settings)
    folder = SweepFolder(out)
    carry_out([folder.keep_plan(certificates.GRID, trainings, own_program())], folder, "local", options)
    print(f"{corruption}: {certificate_in_words(certificates.certify(dataset, cells, out, returns))}")
    print(f"certificate: {out / CERTIFICATES}")


def navigation_collect(words: list[str], program: str) -> None:
    """Collect a maze's data."""
    config = parse_stage(mazes.MazeCollectConfig, words, program)
    print(f"shards in {config.out}: {len(mazes.collect(config))}")


def navigation_train(words: list[str], program: str) -> None:
    """Train an objective on a maze."""
    run = train(parse_stage(NavigationConfig, words, program))
    print(f"results: {run.path / NAVIGATION_FILE}")


def navigation_policy(words: list[str], program: str) -> None:
    """Train the policy that collects the first-person maze's data."""
    from vd4rl_pomdp.studies.navigation.drivers import FirstPersonConfig, train_first_person  # an extra

    config = parse(FirstPersonConfig, words, program)
    card = train_first_person(config).card
    print(f"{config.out}: {card['goals_in_20_episodes']} goals in 20 episodes")


@command
def navigation_report(
    runs: tyro.conf.Positional[list[Path]], out: Path = Path("navigation-report"), pictures: bool = True
) -> None:
    """Write the paper's navigation tables and figures for finished runs.

    Args:
        runs: Run folders, results folders, or folders that contain some.
        out: Folder of the report.
        pictures: Also draw sample observations, which needs OpenGL.
    """
    print(f"report: {write_navigation_report(_named(runs), out, mazes.sample_observations if pictures else None)}")
