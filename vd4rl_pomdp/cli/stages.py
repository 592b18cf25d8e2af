"""Commands of the experiment stages: pretrain, finetune, evaluate; and `list`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from vd4rl_pomdp.cli.parsing import command, show
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_number
from vd4rl_pomdp.core.options import LABELS, Options, flat
from vd4rl_pomdp.core.parsing import chosen_by, parse, parse_stage
from vd4rl_pomdp.core.registry import REGISTRIES, Registry
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.runs import EPISODES_FILE


def pretrain(words: list[str], program: str) -> None:
    """Train an encoder."""
    from pretrain.config import PretrainConfig
    from pretrain.train import pretrain

    run = pretrain(parse_stage(PretrainConfig, words, program))
    print(f"encoder: {run.path / 'encoder'}")


def finetune(words: list[str], program: str) -> None:
    """Train a policy, or a stack of several: WORDS + WORDS, or one per seed of `--seeds`."""
    from finetune.config import FinetuneConfig
    from finetune.train import finetune_all

    runs = [one for part in _between(words, "+") for one in _of_seeds(part)]
    configs = [parse_stage(FinetuneConfig, one, program) for one in runs]
    for run in finetune_all(configs, runs if len(runs) > 1 else None):
        print(f"episodes: {run.path / EPISODES_FILE}")


def _between(words: list[str], mark: str) -> list[list[str]]:
    """Split words at each `mark`."""
    ends = [number for number, word in enumerate(words) if word == mark]
    return [words[first:end] for first, end in zip([0, *(e + 1 for e in ends)], [*ends, len(words)], strict=True)]


def _of_seeds(words: list[str]) -> list[list[str]]:
    """One list of words per seed of `--seeds`, with `--seed N --out OUT/seedN`; without the flag, the words as
    given."""
    reader = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    reader.add_argument("--seeds", nargs="?", const="")
    seeds, rest = reader.parse_known_args(words)
    if seeds.seeds is None:
        return [words]
    numbers = seeds.seeds.split(",")
    if not all(number.isdecimal() for number in numbers) or len(set(numbers)) < len(numbers):
        raise UserError(f"--seeds is {seeds.seeds!r}: give different whole numbers, as in --seeds 0,1,2")
    reader = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    reader.add_argument("--out")
    reader.add_argument("--seed")
    told, rest = reader.parse_known_args(rest)
    if told.seed is not None:
        raise UserError("--seed and --seeds are both given: leave one out")
    if told.out is None:
        raise UserError("--seeds needs --out OUT: its runs are OUT/seed0 and so on")
    return [[*rest, "--seed", number, "--out", str(Path(told.out) / f"seed{number}")] for number in numbers]


@dataclass(frozen=True)
class Evaluation:
    """Evaluate a fine-tuned run again, as trained and uncorrupted, or under one --corruption (named before --help)."""

    run: tyro.conf.Positional[Path]
    """Folder of a fine-tuning run."""
    corruption: str | None = None
    """Corruption at evaluation; its options default to the run's own. Default: the training corruption, then none."""
    stages: tuple[Options, ...] = ()
    """Options of the corruption."""
    episodes: int = 10
    """Episodes per corruption."""
    parts: int = 1
    """Also report reward and action error for this many equal parts of an episode."""
    workers: int = 0
    """Worker processes; 0 uses every core."""
    out: Path | None = None
    """Append the raw rows to this CSV file."""
    keep: bool = False
    """Append the rows under the given corruption to the run's own episodes.csv, where reports find them."""
    json: bool = False
    """Print one JSON object."""


def _evaluation(words: list[str], program: str, own: dict[str, Any]) -> Evaluation:
    """Parse the command line; options of the corruption that are not given default to `own`."""
    name = chosen_by(words, ["corruption"]).get("corruption")
    stages = CorruptionConfig.fill(own | {"corruption": name}).stages if name else ()
    asked: Evaluation = parse(Evaluation, words, program, Evaluation(tyro.MISSING, name, stages))
    return asked


def evaluate(words: list[str], program: str) -> None:
    """Evaluate a fine-tuned run again, as trained and without corruption, or under a given corruption only."""
    from finetune.evaluation import another, by_part, evaluate_run, refuse_kept
    from vd4rl_pomdp.data.reference import Reference, summarise
    from vd4rl_pomdp.nn.encoder_folder import read_record
    from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
    from vd4rl_pomdp.runs.files import flatten
    from vd4rl_pomdp.runs.outputs import refuse_inside

    asked = _evaluation(words, program, {})
    run, out, parts, json = asked.run, asked.out, asked.parts, asked.json
    refuse_number("parts", parts, 1)
    there = read_episodes(run / EPISODES_FILE)  # a folder without a run is rejected below
    trained = read_record(run / "encoder").pretrain.corruption if there else {}
    asked = _evaluation(words, program, trained)
    if out is not None:
        refuse_inside(out)
        if there:
            append_episodes(out, [])  # fail before playing if the file cannot be written
    options = {name: value for stage in asked.stages for name, value in flat(stage).items()}
    if asked.keep and asked.corruption is None:
        raise UserError("--keep needs --corruption: a run's own evaluations are kept already")
    if asked.keep and there:
        refuse_kept(run, another(trained, asked.corruption or "", options)[1])
    rows, played = evaluate_run(run, asked.corruption, asked.episodes, asked.workers, **options)
    if asked.keep:
        refuse_kept(run, rows[0]["evaluated_under"])  # again: another process may have kept the same meanwhile
    for file in [*([out] if out else []), *([run / EPISODES_FILE] if asked.keep else [])]:
        append_episodes(file, rows)
    reference = Reference.read(run)
    labels = {k: rows[0][k] for k in (*LABELS, "step")}
    known = {"data_return": reference.data_return, "path_error": reference.path_error}
    under: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(row["evaluated_under"] for row in rows):
        mine = [row for row in rows if row["evaluated_under"] == name]
        under[name] = summarise(mine, reference) | {"episodes": mine if json else len(mine)}
        if parts > 1:
            under[name]["parts"] = by_part([e for e in played if e.evaluated_under == name], parts)
    result = labels | known | {"under": under}
    told = {name: "unknown" if value is None else value for name, value in flatten(result).items()}
    show(result if json else told, json)


@command
def list_parts() -> None:
    """List methods, corruptions, algorithms, frame encoders, memories and tasks, one line each."""
    import finetune.algorithms  # noqa: F401 (importing the parts fills the registries)
    import pretrain.objectives  # noqa: F401
    import vd4rl_pomdp.core.tasks
    import vd4rl_pomdp.data.formats  # noqa: F401

    for setting, registry in sorted(REGISTRIES.items()):
        print(f"{flag_of(setting)}   (entry point group {registry.group})")
        print("\n".join(_lines(registry)), end="\n\n")


def _lines(registry: Registry[Any]) -> Iterator[str]:
    """One line per part of a kind, including parts of installed packages that cannot be loaded."""
    names = [*registry, *registry.broken]
    width = max(map(len, names))
    for name, part in registry.items():
        origin = f"   [{registry.origin(name)}]" if registry.origin(name) else ""
        text = getattr(part, "summary", "") or getattr(part, "build", part).__doc__ or ""
        yield f"  {name:<{width}}  {text.strip().partition(chr(10))[0].removesuffix('.')}{origin}".rstrip()
    for name, reason in registry.broken.items():
        yield f"  {name:<{width}}  cannot be loaded: {reason}"
