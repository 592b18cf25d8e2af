"""Commands that read a damaged file either succeed or end with one line and exit code 2."""

import contextlib
import shutil

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers_bad_input import ENCODER, FINETUNE, PRETRAIN, RUN, SET, build_world, end_of

OUT = ["--out", "new"]
READERS = [
    (["data", "check", SET], f"{SET}/*"),
    (["data", "card", SET], f"{SET}/*"),
    (["data", "view", SET, *OUT], f"{SET}/*"),
    (["report", "runs", *OUT], f"{RUN}/*.*"),
    (["report", "runs", *OUT], "runs/pretrained/*.*"),
    (["report", "compare", "runs", "results", *OUT], "results/*"),
    (["results", "add", "runs", "--out", "results"], "results/*"),
    (["results", "verify", "results"], "results/*"),
    (["results", "verify", "results", "--replay", RUN], f"{RUN}/**/*.*"),
    (["evaluate", RUN, "--episodes", "1", "--workers", "1"], f"{RUN}/**/*.*"),
    (["finetune", "--encoder", ENCODER, "--data", SET, *OUT, *FINETUNE], f"{ENCODER}/*"),
    (["pretrain", "--data", SET, "--out", "cut/pretrained", *PRETRAIN], "cut/pretrained/**/*.*"),
]
"""Command lines and the files they read."""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    build_world(folder)
    return folder


def _truncated(draw, whole: bytes) -> bytes:
    return whole[: draw(st.integers(0, max(len(whole) - 1, 0)))]


def _flipped(draw, whole: bytes) -> bytes:
    place, bit = draw(st.integers(0, max(len(whole) - 1, 0))), draw(st.integers(0, 7))
    return whole[:place] + bytes(byte ^ 1 << bit for byte in whole[place : place + 1]) + whole[place + 1 :]


def _replaced(draw, whole: bytes) -> bytes:
    place, garbage = draw(st.integers(0, len(whole))), draw(st.binary(min_size=1, max_size=64))
    return whole[:place] + garbage + whole[place + len(garbage) :]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_damaged_files_are_read_or_rejected_in_one_line(world, tmp_path_factory, data):
    words, pattern = data.draw(st.sampled_from(READERS))
    name = data.draw(st.sampled_from(sorted(p.relative_to(world) for p in world.glob(pattern) if p.is_file())))
    damaged = data.draw(st.sampled_from([_truncated, _flipped, _replaced]))(data.draw, (world / name).read_bytes())
    folder = tmp_path_factory.mktemp("case")
    shutil.copytree(world, folder, symlinks=True, dirs_exist_ok=True)
    (folder / name).write_bytes(damaged)
    with contextlib.chdir(folder):
        code, stderr = end_of(words)
    shutil.rmtree(folder)
    if code:
        assert code == 2, stderr
        assert [line[:7] for line in stderr.splitlines() if not line.startswith("warning: ")] == ["error: "], stderr
