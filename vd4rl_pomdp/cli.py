"""The command line: one subcommand a stage. Bad input ends with one line and exit code 2, never with a traceback."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from vd4rl_pomdp.errors import UserError, disk_error
from vd4rl_pomdp.runs.folder import flatten

Arguments = list[str]
REPLAY_TOLERANCE = 1e-6
"""Largest difference between a stored and a replayed reward; on the machine that collected it is 0."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vd4rl-pomdp`."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _dispatch(COMMANDS, words, "vd4rl-pomdp")
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except FloatingPointError as error:
        print(f"error: training diverged, {error}; lower --learning-rate or use --precision fp32", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(141)
    except OSError as error:
        print(f"error: {disk_error(error.filename, error)}", file=sys.stderr)
        sys.exit(2)


def _dispatch(table: dict[str, Command | dict[str, Command]], words: Arguments, program: str) -> None:
    """Run the subcommand that `words` name, or print what there is."""
    if not words or words[0] in ("-h", "--help"):
        print(_overview(table, program))
        return
    if words[0] == "--version":
        from vd4rl_pomdp import __version__

        print(__version__)
        return
    if words[0] not in table:
        raise UserError(f"unknown command '{program} {words[0]}': choose one of {', '.join(table)}")
    entry = table[words[0]]
    program = f"{program} {words[0]}"
    if isinstance(entry, dict):
        _dispatch(entry, words[1:], program)  # type: ignore[arg-type]
    else:
        entry.run(words[1:], program)


def _overview(table: dict[str, Command | dict[str, Command]], program: str) -> str:
    width = max(map(len, table))
    lines = [f"usage: {program} COMMAND [--flags]   ({program} COMMAND --help says more)", ""]
    for name, entry in table.items():
        text = ", ".join(entry) if isinstance(entry, dict) else entry.summary
        lines.append(f"  {name:<{width}}  {text}")
    return "\n".join(lines)


@dataclass(frozen=True)
class Command:
    """One subcommand."""

    summary: str
    run: Callable[[Arguments, str], None]


def _parse(config: Any, words: Arguments, program: str, default: Any = None) -> Any:
    """Arguments as an instance of a config class; `--preset`-like defaults come in as `default`."""
    options = {} if default is None else {"default": default}
    shown = io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            return tyro.cli(config, args=words, prog=program, description=config.__doc__, **options)
    except SystemExit as end:
        if end.code in (0, None):
            raise
        raise UserError(_one_line(shown.getvalue(), program)) from None


def _one_line(box: str, program: str) -> str:
    """tyro's boxed message, without its title and frame, as one sentence."""
    text = " ".join(line for line in box.splitlines() if not line.startswith(("╭", "╰")))
    text = re.sub(r"[\u2500-\u257f]+|-{5,}", " ", text.partition("For full helptext")[0])
    return f"{' '.join(text.split())} (see `{program} --help`)"


def _with_presets(config: type, presets: dict[str, Any], words: Arguments, program: str, flag: str = "--preset") -> Any:
    """Parse a stage's config one of whose flags, `--preset`, chooses the defaults of all others."""
    name = next(iter(presets))
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == flag:
            name = following
        elif word.startswith(f"{flag}="):
            name = word.partition("=")[2]
    if name not in presets:
        raise UserError(f"unknown {flag.removeprefix('--')} {name!r}: choose one of {', '.join(presets)}")
    default = presets[name]
    required = [f for f in ("encoder", "data", "out", "maze") if getattr(default, f, None) in (Path(), "")]
    missing = {f: tyro.MISSING for f in required}
    from dataclasses import replace

    return _parse(config, words, program, replace(default, **missing))


def _pretrain(words: Arguments, program: str) -> None:
    from pretrain.config import PRESETS, PretrainConfig
    from pretrain.train import pretrain

    run = pretrain(_with_presets(PretrainConfig, PRESETS, words, program))
    print(f"encoder: {run.path / 'encoder'}")


def _finetune(words: Arguments, program: str) -> None:
    from finetune.config import PRESETS, FinetuneConfig
    from finetune.train import finetune

    run = finetune(_with_presets(FinetuneConfig, PRESETS, words, program))
    print(f"episodes: {run.path / 'episodes.csv'}")


def _collect(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.collect import CollectConfig, collect

    config = _parse(CollectConfig, words, program)
    shards = collect(config)
    print(f"{len(shards)} shards in {config.out}, described in {config.out / 'card.md'}")
    print(f"check them with `vd4rl-pomdp data check {config.out}`")


@dataclass(frozen=True)
class CardCommand:
    """Write a set's data card, card.md and card.png, into its folder; `data collect` does so itself."""

    path: tyro.conf.Positional[Path]
    """Folder of shards."""


def _card(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.card import write_card

    print(f"card: {write_card(_parse(CardCommand, words, program).path)}")


def _names(table: str) -> list[str]:
    """Names in a table of `tasks`, which needs numpy: not imported before a command does."""
    from vd4rl_pomdp import tasks

    return list(getattr(tasks, table))


@dataclass(frozen=True)
class TableCommand:
    """Tabulate all sets: returns of their 200 episodes, played by physics alone, and what collecting them costs."""

    out: Path = Path("results/datasets")
    """Folder of the table; sets that are in it already, by the same actors, are not played again."""
    tasks: list[str] = field(default_factory=lambda: _names("TASKS"))
    """Tasks."""
    qualities: list[str] = field(default_factory=lambda: _names("QUALITIES"))
    """Qualities; one whose actor does not ship is left out."""
    timed_episodes: int = 4
    """Episodes of the short rendered collection that is timed for each task."""
    workers: int = 0
    """Processes that play; 0 uses every core."""


def _table(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.datasets import tabulate

    command = _parse(TableCommand, words, program)
    rows = tabulate(command.out, command.tasks, command.qualities, command.timed_episodes, command.workers)
    for row in rows:
        print("  ".join(f"{value!s:<14}" for value in row.values()).rstrip())
    print(f"table: {command.out / 'sets.csv'}")


@dataclass(frozen=True)
class CheckCommand:
    """Validate a set: format, episodes, checksums, and that its actions replay to its rewards."""

    path: tyro.conf.Positional[Path]
    """Folder of shards."""
    json: bool = False
    """Print one JSON object."""


def _check(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.check import check_dataset

    command = _parse(CheckCommand, words, program)
    result = check_dataset(command.path)
    _show(result, command.json)
    error = result["replay_max_error"]
    if error is not None and error > REPLAY_TOLERANCE:
        raise UserError(
            f"{command.path}: stored actions do not replay to what is stored (largest difference {error:.3g})"
        )


@dataclass(frozen=True)
class ParityCommand:
    """Compare rendered canary frames with golden ones, and a data set's background with the environment's."""

    path: tyro.conf.Positional[Path | None] = None
    """A data set; without one only the canaries are compared."""
    json: bool = False
    """Print one JSON object."""


def _parity(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.envs.parity import check_parity

    command = _parse(ParityCommand, words, program)
    result = check_parity(command.path)
    _show(result, command.json)
    if not result["equal"]:
        raise UserError("the environment shows other pixels than the data: see the comparison that is not equal")


@dataclass(frozen=True)
class DownloadCommand:
    """Fetch published V-D4RL 84-pixel sets: checked by SHA-256, resumable, each unique file once."""

    task: str
    """walker_walk, cheetah_run or humanoid_walk."""
    quality: str
    """random, medium_replay, medium, medium_expert or expert."""
    out: Path = Path("data/vd4rl")
    """Folder to keep sets in, as OUT/TASK/QUALITY/84px."""
    endpoint: str = "https://huggingface.co"
    """The mirror's address."""
    verify: bool = False
    """Compute the SHA-256 of files that are already there, too."""


def _download(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.download import download

    command = _parse(DownloadCommand, words, program)
    shards = download(command.task, command.quality, command.out, command.endpoint, command.verify)
    print(f"{len(shards)} shards in {shards[0].parent}; check them with `vd4rl-pomdp data check {shards[0].parent}`")


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate a fine-tuned run again, also under another corruption; prints the rows' summary."""

    run: tyro.conf.Positional[Path]
    """A fine-tuning run's folder."""
    corruption: str | None = None
    """Corruption at evaluation; default: the one it was trained under."""
    episodes: int = 10
    """Episodes."""
    workers: int = 0
    """Processes; 0 uses every core."""
    out: Path | None = None
    """Append the raw rows to this CSV file."""
    json: bool = False
    """Print one JSON object."""


def _evaluate(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.evaluation import append_rows, evaluate_run

    command = _parse(EvaluateCommand, words, program)
    if command.out is not None:
        append_rows(command.out, [])  # before any episode is played
    rows = evaluate_run(command.run, command.corruption, command.episodes, command.workers)
    if command.out is not None:
        append_rows(command.out, rows)
    scores = [row["score"] for row in rows]
    labels = {k: rows[0][k] for k in ("method", "task", "quality", "corruption", "algorithm", "seed", "step")}
    summary = {"score_mean": sum(scores) / len(scores), "score_min": min(scores), "score_max": max(scores)}
    _show(labels | summary | {"episodes": rows if command.json else len(rows)}, command.json)


def _policy_train(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.policies.config import RECIPES, PolicyConfig
    from vd4rl_pomdp.policies.train import decisions_made, train_policy
    from vd4rl_pomdp.runs.progress import ProgressLine

    if not any(word.split("=")[0] in ("--task", "--help", "-h") for word in words):
        raise UserError(f"--task is missing: choose one of {', '.join(RECIPES)}")
    config = _with_presets(PolicyConfig, RECIPES, words, program, flag="--task")
    done = decisions_made(config.out)
    with ProgressLine(f"train {config.task}", config.decisions, "decisions", done) as progress:
        files = train_policy(config, lambda decisions, mean: progress.reach(decisions, ret=mean))
    for quality, path in files.items():
        print(f"{quality}: {path}")


@dataclass(frozen=True)
class PolicyExportCommand:
    """Choose a run's expert, medium and medium_replay actors and write them with their cards; it may still go on."""

    run: tyro.conf.Positional[Path]
    """Folder of a policy training run."""
    out: Path
    """Folder for the files."""


def _policy_export(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.policies.export import export_run

    command = _parse(PolicyExportCommand, words, program)
    for quality, path in export_run(command.run, command.out).items():
        print(f"{quality}: {path}")


@dataclass(frozen=True)
class ReportCommand:
    """Write an HTML page and CSV files about fine-tuning runs."""

    runs: tyro.conf.Positional[list[Path]]
    """Run folders, or folders that contain some; a folder that `theory --out` wrote adds its section."""
    out: Path = Path("report")
    """Folder of the report."""


def _report(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.report import print_summary, write_report

    command = _parse(ReportCommand, words, program)
    page, summary = write_report(command.runs, command.out)
    print_summary(summary)
    print(f"report: {page}")


@dataclass(frozen=True)
class SweepCommand:
    """Run methods x seeds through pretraining and fine-tuning, one after the other; finished runs are skipped."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the runs: OUT/METHOD/CORRUPTION/seedN/{pretrain,finetune-ALGORITHM}."""
    methods: list[str] = field(default_factory=lambda: ["mik+a", "acro", "random"])
    """Pretraining methods."""
    corruptions: list[str] = field(default_factory=lambda: ["patch+zero_frames"])
    """Corruptions."""
    algorithms: list[str] = field(default_factory=lambda: ["td3_bc"])
    """Fine-tuning algorithms."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """Training seeds."""
    preset: str = "paper"
    """paper, cpu or smoke."""
    pretrain: str = ""
    """More flags for every pretraining, with an equals sign: --pretrain="--steps 1000 --shift 0"."""
    finetune: str = ""
    """More flags for every fine-tuning, likewise."""
    dry_run: bool = False
    """Print the commands only, one line a run, which other machines or a cluster's queue can take in any order."""


def _sweep(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.runs.sweep import sweep_runs

    command = _parse(SweepCommand, words, program)
    _check_names(command)
    for run in sweep_runs(command):
        _run_stages(run, command.dry_run)


def _check_names(sweep: SweepCommand) -> None:
    """Find a misspelt name before the first run, not after the hours that the runs before it take."""
    from finetune.algorithms import get_algorithm
    from pretrain.objectives import get_method
    from vd4rl_pomdp.corruptions import make_corruption

    for check, names in (
        (get_method, sweep.methods),
        (make_corruption, sweep.corruptions),
        (get_algorithm, sweep.algorithms),
    ):
        for name in names:
            check(name)


def _run_stages(stages: list[Arguments], dry_run: bool) -> None:
    """Print the stages of a run as one line of shell, and execute them unless `dry_run`."""
    line = " && ".join(f"vd4rl-pomdp {shlex.join(stage)}" for stage in stages)
    print(line, file=sys.stdout if dry_run else sys.stderr)
    if not dry_run:
        for stage in stages:
            _dispatch(COMMANDS, stage, "vd4rl-pomdp")


def _navigation_collect(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.navigation.collect import PRESETS, CollectConfig, collect

    config = _with_presets(CollectConfig, PRESETS, words, program)
    print(f"{len(collect(config))} shards in {config.out}")


def _navigation_train(words: Arguments, program: str) -> None:
    from pretrain.navigation.config import PRESETS, NavigationConfig
    from pretrain.navigation.train import train

    run = train(_with_presets(NavigationConfig, PRESETS, words, program))
    print(f"results: {run.path / 'results.json'}")


def _navigation_policy(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.navigation.policy import MazePolicyConfig, train_policy

    config = _parse(MazePolicyConfig, words, program)
    card = train_policy(config).card
    print(f"{config.out}: {card['goals_in_20_episodes']} goals in 20 episodes")


@dataclass(frozen=True)
class NavigationReportCommand:
    """Write the paper's navigation tables and figures about finished runs."""

    runs: tyro.conf.Positional[list[Path]]
    """Run folders, folders that contain some, or a folder that holds an earlier report's rows.csv."""
    out: Path = Path("navigation-report")
    """Folder of the report."""
    pictures: bool = True
    """Also draw sample observations, which needs OpenGL."""


def _navigation_report(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.navigation.report import write_report

    command = _parse(NavigationReportCommand, words, program)
    print(f"report: {write_report(command.runs, command.out, command.pictures)}")


@dataclass(frozen=True)
class NavigationGridCommand:
    """Train all runs of a grid, seed by seed; finished runs are skipped, a cut one goes on."""

    grid: str = "evidence"
    """evidence: all objectives at K=15, and K=1 comparisons; options: self-prediction, noise; paper: every table."""
    mazes: list[str] = field(default_factory=lambda: ["no_curtain", "three_curtains"])
    """Mazes."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    """Training seeds."""
    preset: str = "cpu"
    """paper, cpu or smoke."""
    data: Path = Path("data")
    """Folder of the mazes' sets, DATA/MAZE."""
    out: Path = Path("runs/navigation")
    """Folder of the runs."""
    dry_run: bool = False
    """Print the commands only."""


def _navigation_grid(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.navigation.grid import grid_commands

    command = _parse(NavigationGridCommand, words, program)
    where = (tuple(command.mazes), tuple(command.seeds), command.preset, command.data, command.out)
    for stage in grid_commands(command.grid, *where):
        _run_stages([stage], command.dry_run)


@dataclass(frozen=True)
class DemoCommand:
    """Every stage on a small walker_walk set with real rendering, in minutes, ending with a table and a report."""

    out: Path = Path("runs/demo")
    """Folder of the demo's data and runs; the same command continues where it was cut."""
    workers: Annotated[int, tyro.conf.arg(help="Processes; 0 uses every core.")] = 0


def _demo(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.demo import demo

    command = _parse(DemoCommand, words, program)
    demo(command.out, command.workers, lambda stage: _dispatch(COMMANDS, stage, "vd4rl-pomdp"))


@dataclass(frozen=True)
class BenchCommand:
    """Measure speed and memory of every stage on this machine, as ratios within one run."""

    json: bool = False
    """Print one JSON object instead of a table."""
    quick: bool = False
    """A tenth of the frames and fewer repetitions: rougher numbers, and a peak memory that fixed costs dominate."""


def _bench(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.bench import bench, print_table

    command = _parse(BenchCommand, words, program)
    results = bench(command.quick)
    if command.json:
        _show(results, as_json=True)
    else:
        print_table(results)


@dataclass(frozen=True)
class TheoryCommand:
    """Compute the paper's claims on finite worlds by enumeration, and list where its text differs."""

    json: bool = False
    """Print one JSON object."""
    out: Path | None = None
    """Also write an HTML page with figures, and the JSON, into this folder."""


def _theory(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.report.theory import print_theory, write_theory
    from vd4rl_pomdp.theory import theory_study

    command = _parse(TheoryCommand, words, program)
    if command.out is not None:
        command.out.mkdir(parents=True, exist_ok=True)  # before anything is computed
    study = theory_study()
    if command.json:
        print(json.dumps(study))
    else:
        print_theory(study)
    if command.out is not None:
        print(f"page: {write_theory(study, command.out)}", file=sys.stderr if command.json else sys.stdout)


def _show(result: dict[str, Any], as_json: bool) -> None:
    """Print a result as one JSON object, or as an aligned list."""
    if as_json:
        print(json.dumps(result))
        return
    for name, value in flatten(result).items():
        print(f"{name:<40} {value:.6g}" if isinstance(value, float) else f"{name:<40} {value}")


COMMANDS: dict[str, Command | dict[str, Command]] = {
    "demo": Command("every stage on a small set, in minutes", _demo),
    "data": {
        "collect": Command("render a set in V-D4RL's format from the shipped actors", _collect),
        "download": Command("fetch a published V-D4RL set", _download),
        "card": Command("describe a set: returns, origin, film strip", _card),
        "table": Command("tabulate the returns and the cost of all sets", _table),
        "check": Command("validate a set and replay its actions", _check),
        "parity": Command("compare rendered pixels with the data's", _parity),
    },
    "policy": {
        "train": Command("train the state-based actors that collect data", _policy_train),
        "export": Command("choose a run's actors and write them with their cards", _policy_export),
    },
    "pretrain": Command("train an encoder", _pretrain),
    "finetune": Command("TD3+BC on a frozen encoder", _finetune),
    "evaluate": Command("evaluate a fine-tuned run again", _evaluate),
    "navigation": {
        "collect": Command("a maze's data, with true states", _navigation_collect),
        "train": Command("an objective on a maze, beside a state probe", _navigation_train),
        "policy": Command("train the first-person policy (PPO) that ships", _navigation_policy),
        "grid": Command("the runs behind the tables, one after the other", _navigation_grid),
        "report": Command("the paper's tables and figures about runs", _navigation_report),
    },
    "sweep": Command("methods x corruptions x seeds", _sweep),
    "report": Command("an HTML page and CSV files about runs", _report),
    "theory": Command("the paper's claims on finite worlds, by enumeration", _theory),
    "bench": Command("speed and memory on this machine", _bench),
}

if __name__ == "__main__":
    main()
