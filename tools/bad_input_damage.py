"""Ways to damage a file, by its format."""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

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


def each_place(value: dict[str, Any]) -> Iterator[tuple[str, Damage]]:
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


TOML: dict[str, Damage] = {
    "a list": _text("[[3]]\n"),
    "another section": lambda path: path.write_text(path.read_text() + "\n[other]\nx = 1\n") and None,
    "an empty axis": _text("[collect]\ntask = []\n"),
    "a section for a value": _text("seed = { a = 1 }\n[collect]\ntask = 'walker_walk'\nquality = 'expert'\n"),
    "a word for a number": _text("seed = 'many'\n[collect]\ntask = 'walker_walk'\nquality = 'expert'\n[pretrain]\n"),
    "an unknown setting": _text("[collect]\ntask = 'walker_walk'\nquality = 'expert'\nsize = 3\n"),
}
BY_SUFFIX: dict[str, dict[str, Damage]] = {
    ".toml": TOML,
    ".json": JSON,
    ".jsonl": JSONL,
    ".csv": CSV,
    ".safetensors": SAFETENSORS,
    ".npy": NPY,
    ".npz": NPZ,
    ".hdf5": _hdf5(),
}
