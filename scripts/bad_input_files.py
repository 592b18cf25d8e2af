"""Bad files, made from valid ones: every file that a command reads, damaged in every way that its format allows."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from bad_input_flags import ENCODER, MAZE, NAVIGATED, RUN, SET, SMOKE, Case

ROWS, EPISODES = 20, 4
"""Rows of an episode of the small set, and its episodes."""
CUT: dict[str, tuple[str, list[str]]] = {
    "pretrain": ("runs-cut/pretraining", ["--data", SET, *SMOKE]),
    "finetune": ("runs-cut/finetuning", ["--encoder", ENCODER, "--data", SET, *SMOKE, "--workers", "1"]),
    "navigation train": ("runs-cut/navigating", ["--data", MAZE, *SMOKE]),
}
"""For each stage a run that was cut, and the words that go on with it, but for --out."""


def build_world(folder: Path) -> None:
    """Make the valid files that all cases start from: two sets, runs of every kind, and some that are foreign."""
    from vd4rl_pomdp.cli import run_stage
    from vd4rl_pomdp.data.collect import CollectConfig, collect

    folder.mkdir()
    before = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            config = CollectConfig("walker_walk", "random", Path(SET), EPISODES, workers=1, episodes_per_shard=2)
            collect(config, length=ROWS)
            with _keeping_all():
                for words in _stages():
                    run_stage(words)
        shutil.copytree(Path(__file__).parents[1] / "results" / "datasets", "reports/sets")
        _unfinished()
        _policy_run(Path("runs/policy"))
        _foreign()
    finally:
        os.chdir(before)


def _stages() -> Iterator[list[str]]:
    yield ["navigation", "collect", "--maze", "no_curtain", "--out", MAZE, *SMOKE, "--workers", "1"]
    yield ["pretrain", "--data", SET, "--out", "runs/pretrained", *SMOKE]
    yield ["finetune", "--encoder", ENCODER, "--data", SET, "--out", RUN, *SMOKE, "--workers", "1"]
    yield ["navigation", "train", "--data", MAZE, "--out", NAVIGATED, *SMOKE]
    yield ["navigation", "report", NAVIGATED, "--out", "reports/navigation", "--no-pictures"]
    yield ["theory", "--out", "reports/theory"]


@contextmanager
def _keeping_all() -> Iterator[None]:
    """Within, a run that ends keeps what it needs only to go on: two checkpoints and its features."""
    from finetune.features import FeatureFile
    from vd4rl_pomdp.runs.checkpoint import KEPT, Checkpoints

    prune = Checkpoints.prune
    with (
        mock.patch.object(Checkpoints, "prune", lambda self, _: prune(self, KEPT)),
        mock.patch.object(FeatureFile, "remove"),
    ):
        yield


def _unfinished() -> None:
    """Runs that were cut after their last checkpoint; the finished ones lose what they have no use for."""
    for finished, (cut, _) in zip(("pretrained", "finetuned", "navigated"), CUT.values(), strict=True):
        folder = Path("runs") / finished
        shutil.copytree(folder, cut)
        Path(cut, "timing.json").unlink()
        shutil.rmtree(folder / "checkpoints")
    for name in ("features.npy", "features.json"):
        Path(RUN, name).unlink()
    shutil.rmtree("runs-cut/pretraining/encoder")
    Path("runs-cut/navigating/results.json").unlink()


def _policy_run(folder: Path) -> None:
    """What a policy run keeps, with shipped actors for its snapshots."""
    from vd4rl_pomdp.policies.actor import load_actor
    from vd4rl_pomdp.policies.export import snapshot_path

    for step, quality in ((5000, "medium"), (10000, "expert")):
        load_actor("walker_walk", quality).save(snapshot_path(folder, step))
    shutil.copy(next((folder / "snapshots").iterdir()), "actor.safetensors")
    (folder / "config.json").write_text(json.dumps({"task": "walker_walk", "seed": 0}))
    (folder / "curve.csv").write_text("decisions,return_mean\n5000,400.0\n10000,900.0\n")


def _foreign() -> None:
    """Things that are no input of any command."""
    Path("file").write_text("not ours\n")
    for folder in ("empty", "foreign"):
        Path(folder).mkdir()
    Path("foreign/notes.txt").write_text("not ours\n")
    os.mkfifo("pipe")
    Path("dangling").symlink_to("nothing-there")
    Path("loop").symlink_to("loop")


READERS: list[tuple[str, list[str], list[str]]] = [
    ("data check", [SET], [f"{SET}/0_walker_walk_random.hdf5"]),
    ("data card", [SET], [f"{SET}/1_walker_walk_random.hdf5", f"{SET}/provenance.json"]),
    (
        "data collect",
        ["--task", "walker_walk", "--quality", "random", "--episodes", "4", "--episodes-per-shard", "2", "--out", SET],
        [f"{SET}/collection.json"],
    ),
    (
        "data collect",
        ["--task", "walker_walk", "--quality", "medium", "--actor", "actor.safetensors", "--out", "new"],
        ["actor.safetensors"],
    ),
    ("policy export", ["runs/policy", "--out", "new"], ["runs/policy/config.json", "runs/policy/curve.csv"]),
    ("policy export", ["runs/policy", "--out", "new"], ["runs/policy/snapshots/00010000.safetensors"]),
    ("pretrain", ["--data", SET, "--out", "new", *SMOKE], [f"{SET}/1_walker_walk_random.hdf5"]),
    (
        "finetune",
        ["--encoder", ENCODER, "--data", SET, "--out", "new", *SMOKE, "--workers", "1"],
        [f"{ENCODER}/config.json", f"{ENCODER}/model.safetensors"],
    ),
    *(
        (command, [*words, "--out", folder], [f"{folder}/config.json", f"{folder}/metrics.jsonl"])
        for command, (folder, words) in CUT.items()
    ),
    (
        "finetune",
        [*CUT["finetune"][1], "--out", "runs-cut/finetuning"],
        [f"runs-cut/finetuning/{name}" for name in ("episodes.csv", "features.npy", "features.json")],
    ),
    (
        "evaluate",
        [RUN, "--episodes", "1", "--workers", "1"],
        [
            f"{RUN}/{name}"
            for name in (
                *("labels.json", "episodes.csv", "encoder/config.json", "encoder/model.safetensors"),
                *("policy/config.json", "policy/model.safetensors"),
            )
        ],
    ),
    (
        "report",
        ["runs", "--out", "new"],
        [
            f"{RUN}/{name}"
            for name in (
                *("config.json", "metrics.jsonl", "timing.json", "probe.json", "film.npz", "episodes.csv"),
                *("encoder/config.json", "pretrain_timing.json"),
            )
        ],
    ),
    ("report", ["runs", "reports/theory", "--out", "new"], ["reports/theory/theory.json"]),
    ("report", ["runs-cut/finetuning", "--out", "new"], ["runs-cut/finetuning/labels.json"]),
    ("navigation train", ["--data", MAZE, "--out", "new", *SMOKE], [f"{MAZE}/0_no_curtain.hdf5"]),
    (
        "navigation report",
        [NAVIGATED, "--out", "new", "--no-pictures"],
        [
            f"{NAVIGATED}/{name}"
            for name in ("config.json", "results.json", "timing.json", "machine.json", "trajectory.csv")
        ],
    ),
    (
        "navigation report",
        ["reports/navigation", "--out", "new", "--no-pictures"],
        ["reports/navigation/rows.csv", "reports/navigation/runs.csv"],
    ),
    (
        "data table",
        ["--out", "reports/sets", "--tasks", "walker_walk", "--qualities", "random"],
        [f"reports/sets/{name}" for name in ("returns.csv", "costs.csv", "actors.json")],
    ),
]
"""Command, words that read some files, and those files."""

_LOG = "the log decides nothing, and a kill may cut it"
FINE: dict[str, str] = {
    "data table | */returns.csv | missing": "its episodes are played anew",
    "data table | */returns.csv | a dangling link": "its episodes are played anew",
    "data table | */costs.csv | missing": "they are measured anew",
    "data table | */costs.csv | a dangling link": "they are measured anew",
    **{f"data table | */costs.csv | {kind}": "the last column is a commit" for kind in ("a word*", "nan", "inf")},
    **{
        f"data table | */actors.json | {kind}": "sets whose actors are not known are played anew"
        for kind in ("missing", "a dangling link", "no key")
    },
    "report | runs-cut/finetuning/labels.json | *": "a run that has rows is named by them",
    "navigation report | */runs.csv | a word for a number": "the last column is a command",
    "navigation report | */runs.csv | nan": "the last column is a command",
    "navigation report | */runs.csv | inf": "the last column is a command",
    "report | */timing.json | missing": "a run that is not finished has none",
    "report | */timing.json | a dangling link": "a run that is not finished has none",
    "report | */probe.json | missing": "a set without states gives none",
    "report | */probe.json | a dangling link": "a set without states gives none",
    "report | */probe.json | no key": "a set without states gives none",
    "report | */pretrain_timing.json | missing": "an encoder of other origin has none",
    "report | */pretrain_timing.json | a dangling link": "likewise",
    "report | */pretrain_timing.json | no key": "what it does not say is left out of the report",
    **{
        f"report | runs/finetuned/encoder/config.json | {kind}": "the rows name their run; the rest is left out"
        for kind in ("missing", "a dangling link")
    },
    **{
        f"navigation report | */trajectory.csv | {kind}": "without pictures nothing reads it, it is copied as it is"
        for kind in ("empty", "truncated", "garbage", *("without *", "a short row", "a word*", "nan", "inf", "an*"))
    },
    "report | */theory.json | missing": "the report goes without its section",
    "report | */theory.json | a dangling link": "likewise",
    **{
        f"finetune | */features.npy | {kind}": "features that are not what was written are made anew"
        for kind in ("missing", "empty", "truncated", "garbage", "a dangling link", "another *", "objects", "nan")
    },
    **{f"finetune | */features.json | {kind}": "likewise" for kind in ("missing", "a dangling link", "no key")},
    "report | */film.npz | missing": "the report goes without",
    "report | */film.npz | a dangling link": "the report goes without",
    "policy export | */snapshots/* | missing": "a run keeps what snapshots it has",
    "policy export | */snapshots/* | a dangling link": "likewise",
    "policy export | */config.json | *seed*": "nothing reads it, and an export takes longer than the limit",
    "policy train | target_entropy | below": "an entropy may be negative",
    "policy train | stop_at | below": "a return may be",
    "demo | out | a foreign folder": "a folder of runs may hold other things",
    "sweep | out | a foreign folder": "a folder of runs may hold other things",
    "navigation grid | out | a foreign folder": "a folder of runs may hold other things",
    "evaluate | out | a dangling link": "the link's target is made, as by any program",
    "* | data/*.hdf5 | missing": "a set of fewer shards is a set",
    "data card | */provenance.json | no key": "what it does not say is left out of the card",
    "* | */metrics.jsonl | missing": _LOG,
    "* | */metrics.jsonl | empty": _LOG,
    "* | */metrics.jsonl | truncated": _LOG,
    "* | */metrics.jsonl | a dangling link": _LOG,
}
"""Patterns of titles that are no bad input, and why."""


def file_cases(world: Path) -> Iterator[Case]:
    """Every file that a command reads, damaged in every way; `world` holds the valid ones."""
    for command, words, files in READERS:
        for file in files:
            path = Path(file)
            for kind, damage in {**ANY, **BY_SUFFIX[path.suffix]}.items():
                yield Case(command, file, kind, [*command.split(), *words], partial(damage, path))
            if path.suffix == ".json":
                for kind, damage in _each_place(json.loads((world / file).read_text())):
                    yield Case(command, file, kind, [*command.split(), *words], partial(damage, path), may_pass=True)
    for command in CUT:
        yield from _checkpoint_cases(command, world)
    yield from _lock_cases()


def _lock_cases() -> Iterator[Case]:
    """What may lie in a run where its lock and its owner's name will be: no lock stays shut without an owner."""
    folder, words = CUT["pretrain"]
    for name in (".lock", ".owner.json"):
        path = Path(folder, name)
        for kind, damage in {**ANY, **(JSON if path.suffix else {})}.items():
            if kind not in ("missing", "truncated"):
                line = ["pretrain", *words, "--out", folder]
                yield Case("pretrain", str(path), kind, line, partial(_made_then, damage, path), may_pass=True)


def _made_then(damage: Damage, path: Path) -> None:
    path.touch()
    damage(path)


def _checkpoint_cases(command: str, world: Path) -> Iterator[Case]:
    """The newest checkpoint of a cut run, damaged beside an older one, damaged alone, and of another run."""
    folder, more = CUT[command]
    words = [*command.split(), *more, "--out", folder]
    step = max(int(path.name) for path in (world / folder / "checkpoints").iterdir())
    for name in ("manifest.json", "state.json", "state.safetensors"):
        path = Path(folder, "checkpoints", str(step), name)
        for kind, damage in ANY.items():
            goes_on = kind not in ("a folder", "a pipe")
            yield Case(command, str(path), f"{kind}, beside an older one", words, partial(damage, path), warns=goes_on)
        for kind, damage in (ANY | (JSON if name == "manifest.json" else {})).items():
            yield Case(command, str(path), f"{kind}, alone", words, partial(_alone, damage, path))
        of_keys = _each_place(json.loads((world / path).read_text())) if path.suffix == ".json" else ()
        if name == "manifest.json":
            for kind, damage in of_keys:
                yield Case(command, str(path), f"{kind}, alone", words, partial(_alone, damage, path))
            continue
        for kind, damage in BY_SUFFIX[path.suffix].items():
            if kind not in ("nan", "inf"):  # with its hash a run has written it, and its end says that it diverged
                yield Case(command, str(path), f"{kind}, with its hash", words, partial(_signed, damage, path))
        for kind, damage in of_keys:
            title = f"{kind}, with its hash"
            yield Case(command, str(path), title, words, partial(_signed, damage, path), may_pass=True)


Damage = Callable[[Path], None]


def _to_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _to_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _to_dangling_link(path: Path) -> None:
    path.unlink()
    path.symlink_to("nothing-there")


def _alone(damage: Damage, path: Path) -> None:
    """Damage a checkpoint and drop the older one."""
    for other in set(path.parents[1].iterdir()) - {path.parent}:
        shutil.rmtree(other)
    damage(path)


def _signed(damage: Damage, path: Path) -> None:
    """Damage a checkpoint as if another run had written it so."""
    damage(path)
    manifest = path.with_name("manifest.json")
    record = json.loads(manifest.read_text())
    record["sha256"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest.write_text(json.dumps(record))


ANY: dict[str, Damage] = {
    "missing": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b"") and None,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]) and None,
    "garbage": lambda path: path.write_bytes(b"\x80\xff\x00garbage" * 40) and None,
    "a folder": _to_folder,
    "a pipe": _to_pipe,
    "a dangling link": _to_dangling_link,
}


def _text(text: str) -> Damage:
    return lambda path: path.write_text(text) and None


PLACES = 20
"""Keys of one file that are spoilt, at most: the tree of a checkpoint has thousands alike."""


def _each_place(value: dict[str, Any]) -> Iterator[tuple[str, Damage]]:
    """For each key of a JSON object, then of the objects in it: without it, and with a value of another type."""
    for place in islice(_places(value), PLACES):
        name = ".".join(place)
        yield f"without {name}", _edit_json(place, lambda inner, key: inner.pop(key))
        yield f"{name} of another type", _edit_json(place, lambda inner, key: inner.update({key: _other(inner[key])}))


def _places(value: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Keys with those above them, the outermost first."""
    waiting: deque[tuple[tuple[str, ...], Any]] = deque([((), value)])
    while waiting:
        place, inner = waiting.popleft()
        if place:
            yield place
        if isinstance(inner, dict):
            waiting += [((*place, key), deeper) for key, deeper in inner.items()]


def _other(value: Any) -> Any:
    """A value of another JSON type."""
    return ["x"] if isinstance(value, str | dict) else "x"


def _edit_json(place: tuple[str, ...], change: Callable[[dict[str, Any], str], object]) -> Damage:
    def damage(path: Path) -> None:
        value = inner = json.loads(path.read_text())
        for key in place[:-1]:
            inner = inner[key]
        change(inner, place[-1])
        path.write_text(json.dumps(value))

    return damage


NESTED = "[" * 100_000 + "]" * 100_000
JSON: dict[str, Damage] = {
    "a list": _text("[]"),
    "a number": _text("7"),
    "no key": _text("{}"),
    "nested deeply": _text(NESTED),
    "an object nested deeply": _text('{"config": ' + NESTED + "}"),
    "a word": _text("nonsense"),
}


def _edit_lines(change: Callable[[list[str]], list[str]]) -> Damage:
    return lambda path: path.write_text("\n".join(change(path.read_text().splitlines())) + "\n") and None


JSONL: dict[str, Damage] = {
    "a line of garbage": _edit_lines(lambda lines: [lines[0], "{nonsense", *lines[1:]]),
    "a line that is a list": _edit_lines(lambda lines: [lines[0], "[]", *lines[1:]]),
    "a line without its step": _edit_lines(lambda lines: [lines[0], '{"loss": 1.0}', *lines[1:]]),
    "a step that is a word": _edit_lines(lambda lines: [lines[0], '{"step": "x"}', *lines[1:]]),
    "a line nested deeply": _edit_lines(lambda lines: [lines[0], NESTED, *lines[1:]]),
}


def _edit_cells(column: int, value: str) -> Damage:
    def change(lines: list[str]) -> list[str]:
        cells = lines[1].split(",")
        cells[column] = value
        return [lines[0], ",".join(cells), *lines[2:]]

    return _edit_lines(change)


CSV: dict[str, Damage] = {
    "without a column": _edit_lines(lambda lines: [line.rpartition(",")[0] for line in lines]),
    "a short row": _edit_lines(lambda lines: [lines[0], lines[1][:3], *lines[2:]]),
    "a word for a number": _edit_cells(-1, "many"),
    "nan": _edit_cells(-1, "nan"),
    "inf": _edit_cells(-1, "inf"),
    "an endless field": _edit_cells(-1, "9" * 200_000),
    "another table": _text("a,b\n1,2\n"),
}


def _edit_tensors(change: Callable[[dict[str, np.ndarray]], object]) -> Damage:
    def damage(path: Path) -> None:
        from safetensors import safe_open
        from safetensors.numpy import save_file

        with safe_open(path, framework="np") as file:
            metadata = file.metadata()
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        change(tensors)
        save_file(tensors, path, metadata)

    return damage


def _floating(tensors: dict[str, np.ndarray]) -> str:
    return next(name for name, value in tensors.items() if value.dtype.kind == "f" and value.size > 1)


def _fill(value: float) -> Callable[[dict[str, np.ndarray]], object]:
    return lambda tensors: tensors.update({_floating(tensors): np.full_like(tensors[_floating(tensors)], value)})


SAFETENSORS: dict[str, Damage] = {
    "without a tensor": _edit_tensors(lambda tensors: tensors.popitem()),
    "without tensors": _edit_tensors(lambda tensors: tensors.clear()),
    "another shape": _edit_tensors(lambda tensors: tensors.update({_floating(tensors): np.zeros((3, 5), np.float32)})),
    "nan": _edit_tensors(_fill(float("nan"))),
    "inf": _edit_tensors(_fill(float("inf"))),
}


def _edit_array(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda path: np.save(path, change(np.load(path)))


NPY: dict[str, Damage] = {
    "another shape": _edit_array(lambda array: array[:, :-1]),
    "another dtype": _edit_array(lambda array: array.astype("U4")),
    "objects": _edit_array(lambda array: np.array([{}, 7], object)),
    "nan": _edit_array(lambda array: np.full_like(array, np.nan)),
}


def _edit_npz(change: Callable[[dict[str, np.ndarray]], object]) -> Damage:
    def damage(path: Path) -> None:
        with np.load(path) as file:
            arrays = dict(file)
        change(arrays)
        np.savez(path, **arrays)

    return damage


NPZ: dict[str, Damage] = {
    "without an array": _edit_npz(lambda arrays: arrays.popitem()),
    "another shape": _edit_npz(lambda arrays: arrays.update({name: value[0] for name, value in arrays.items()})),
    "words": _edit_npz(lambda arrays: arrays.update({name: np.array(["x"]) for name in arrays})),
}


def _edit_hdf5(change: Callable) -> Damage:
    def damage(path: Path) -> None:
        import h5py

        with h5py.File(path, "a") as file:
            change(file)

    return damage


def _replace(key: str, make: Callable) -> Damage:
    """Put what `make(file, key, old values)` creates in a dataset's place."""

    def change(file) -> None:
        old = file[key][()]
        del file[key]
        make(file, key, old)

    return _edit_hdf5(change)


def _external_link(file, key, old) -> None:
    import h5py

    with h5py.File("elsewhere.h5", "w") as other:
        other[key] = old
    file[key] = h5py.ExternalLink(os.path.abspath("elsewhere.h5"), key)


def _soft_link(file, key, old) -> None:
    import h5py

    file[key] = h5py.SoftLink("/nothing")


def _external_storage(file, key, old) -> None:
    old.tofile("elsewhere.bin")
    file.create_dataset(key, old.shape, old.dtype, external=[(os.path.abspath("elsewhere.bin"), 0, old.nbytes)])


def _virtual(file, key, old) -> None:
    import h5py

    with h5py.File("elsewhere.h5", "w") as other:
        other[key] = old
    layout = h5py.VirtualLayout(old.shape, old.dtype)
    layout[...] = h5py.VirtualSource(os.path.abspath("elsewhere.h5"), key, old.shape)
    file.create_virtual_dataset(key, layout)


def _with_value(value: float) -> Callable:
    def make(file, key, old) -> None:
        new = old.astype(np.float64)
        new[(1, *[0] * (new.ndim - 1))] = value
        file[key] = new

    return make


def _hdf5() -> dict[str, Damage]:
    kinds: dict[str, Damage] = {}
    for key in ("observation", "action", "reward", "discount", "step_type", "physics"):
        if key != "physics":
            kinds[f"{key} missing"] = _edit_hdf5(lambda file, key=key: file.pop(key))
        kinds[f"{key} of words"] = _replace(key, lambda file, key, old: file.create_dataset(key, data=["x"] * len(old)))
        kinds[f"{key} too short"] = _replace(key, lambda file, key, old: file.create_dataset(key, data=old[:-1]))
        kinds[f"{key} with an axis more"] = _replace(
            key, lambda file, key, old: file.create_dataset(key, data=old[..., None])
        )
        kinds[f"{key} a group"] = _replace(key, lambda file, key, old: file.create_group(key))
        kinds[f"{key} a scalar"] = _replace(key, lambda file, key, old: file.create_dataset(key, data=1.0))
        kinds[f"{key} an external link"] = _replace(key, _external_link)
        kinds[f"{key} a dangling link"] = _replace(key, _soft_link)
        kinds[f"{key} in another file"] = _replace(key, _external_storage)
        kinds[f"{key} virtual"] = _replace(key, _virtual)
        if key != "observation":
            for value in ("nan", "inf", "1e300"):
                kinds[f"{key} {value}"] = _replace(key, _with_value(float(value)))
    kinds["another step type"] = _replace("step_type", _with_value(9))
    for label, text in {"a list": "[]", "nested deeply": NESTED, "garbage": "{nonsense"}.items():
        kinds[f"attributes: {label}"] = _edit_hdf5(lambda file, text=text: file.attrs.update(vd4rl_pomdp=text))
    return kinds


BY_SUFFIX: dict[str, dict[str, Damage]] = {
    ".json": JSON,
    ".jsonl": JSONL,
    ".csv": CSV,
    ".safetensors": SAFETENSORS,
    ".npy": NPY,
    ".npz": NPZ,
    ".hdf5": _hdf5(),
}
